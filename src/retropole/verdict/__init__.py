"""The verdict ok, warn or refused, and its reasons: the rules by which an estimate becomes an
answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..adjustment.agreement import (
    RECORD_MORE,
    check_agreement,
    check_decisive,
    check_minima,
    check_radius,
)
from ..adjustment.refinement import Refinement
from ..alignment.adjustment import BeamAlignment
from ..base import quantities
from ..base.datatypes import Array, Hypothesis, Pole, Scan
from ..base.errors import Reason
from ..base.sensors import Sensor
from ..base.uncertainty import WeakDirection
from ..base.uncertainty.confirmation import Confirmation
from ..extraction.acceptance_shape import MAX_CONFIRMED_RMS, MIN_POLE_RINGS
from ..extraction.sensor_pattern import sensor_doubt
from ..hypotheses.by_place import LEAN_ANOTHER, SET_UP_TWO
from ..hypotheses.candidate_confirmation import candidate_reasons
from ..hypotheses.choice import WARN_MARGIN, margin_of
from ..hypotheses.correspondence import left_out, widest_angle
from ..hypotheses.evidence import check_unconfirmed
from ..hypotheses.placements import PairedPlacement, is_by_place
from ..surfaces.static import other_times
from .map import MORE_OF_MAP

WEAK_ANGLE = np.radians(15.0)
"""Below this angle between the poles, the answer is weak."""

FEW_POINTS = 12
"""Returns on a pole below which its line is weak."""

NOISE_RATIO = 3.0
"""Limit of the scatter of returns on poles, in multiples of the noise that the manufacturer
states."""

WEAK_SIGMA = 0.05
"""1 σ of the position at the poles above which a direction is called weak, metres."""

OFFSET_SHARE = 2.0
"""A range offset or the radius is reported as the limit of the accuracy if knowing it would reduce
1 σ of the pose by this factor."""


def weaknesses(
    paired: Sequence[PairedPlacement],
    hypotheses: Sequence[Hypothesis],
    aligned: BeamAlignment,
    weakest: WeakDirection,
    refined: Refinement | None,
    confirmation: Confirmation,
) -> list[Reason]:
    """Report the weaknesses of an accepted answer.

    Parameters
    ----------
    paired
        Every placement, its poles paired by the choice.
    hypotheses
        All hypotheses, the chosen one first.
    aligned
        The pose from the poles.
    weakest
        The direction in which the answer is least certain.
    refined
        The pose from poles and scene; None if the scene was not used, or gave no information.
    confirmation
        Agreement of the objects in the scene with the answer.
    """
    is_map = paired[0].placement.target.cloud.is_map
    return [
        *check_unconfirmed(confirmation),
        *other_times([each.placement for each in paired]),
        *candidate_reasons(paired, hypotheses),
        *_left_out(paired),
        *(() if is_by_place(paired) else _weak_choice(hypotheses)),
        *check_sensor("target", paired[0].placement.target),
        *check_sensor("source", paired[0].placement.source),
        *check_sway("target", [each.placement.target for each in paired]),
        *check_sway("source", [each.placement.source for each in paired]),
        *_angles(paired, confirmation),
        *check_returns("target", [pole for each in paired for pole in each.target_poles]),
        *check_returns("source", [pole for each in paired for pole in each.source_poles]),
        *check_noise("target", paired[0].placement.target.sensor, aligned.noise[0]),
        *check_noise("source", paired[0].placement.source.sensor, aligned.noise[1]),
        *_weak_pose(aligned, weakest),
        *check_radius(aligned.radius, aligned.radius_conflict),
        *check_agreement(refined, is_map=is_map),
        *check_minima(refined),
        *check_decisive(refined, MORE_OF_MAP if is_map else RECORD_MORE),
        *_not_converged(aligned, refined),
    ]


def _angles(paired: Sequence[PairedPlacement], confirmation: Confirmation) -> Iterator[Reason]:
    """Report that a part of the pose is from the surroundings, or that the poles are nearly
    parallel."""
    poles = [pole for each in paired for pole in each.target_poles]
    if not is_by_place(paired):
        yield from check_angles([pole.direction for pole in poles])
        return
    lead = confirmation.z_margin or 0.0
    if not poles and paired[0].placement.target.cloud.is_map:
        return
    if not poles:
        yield Reason(
            "without_poles",
            "without poles the surroundings determine the whole pose, and there is no check; the "
            f"pose is better than other angles and shifts by {lead:.1f} σ. Look at the clouds, "
            f"or {SET_UP_TWO}",
            {"lead": lead},
        )
        return
    are = "one pole does" if len(poles) == 1 else f"{len(poles)} poles, all parallel, do"
    yield Reason(
        "by_place",
        f"{are} not determine the whole pose, the rest is from the surroundings: it is better "
        f"than other angles and shifts by {lead:.1f} σ; to check it, {LEAN_ANOTHER}",
        {"poles": len(poles), "lead": lead},
    )


def check_sway(lidar: str, scans: Sequence[Scan]) -> Iterator[Reason]:
    """Report that a LiDAR swayed while it recorded: the worst of its recordings."""
    found = [scan.sway for scan in scans if scan.sway is not None]
    if not found:
        return
    worst = max(found, key=lambda each: each.left_rad)
    yield Reason(
        "sways",
        f"{lidar} swayed while it recorded: {worst.text}",
        {
            "lidar": lidar,
            "angle_rad": worst.angle_rad,
            "frequency_hz": worst.frequency or 0.0,
            "left_rad": worst.left_rad,
        },
    )


def _weak_choice(hypotheses: Sequence[Hypothesis]) -> Iterator[Reason]:
    margin = margin_of(hypotheses)
    if margin is not None and margin < WARN_MARGIN:
        yield Reason(
            "small_margin",
            f"the score of the chosen hypothesis is higher by only {margin:.3f} ({WARN_MARGIN:g} "
            "or more is clear); look at the hypotheses in the report before you use the transform",
            {"margin": margin, "comfortable": WARN_MARGIN},
        )


def _left_out(paired: Sequence[PairedPlacement]) -> Iterator[Reason]:
    """Report the poles that were left out since they contradict the others."""
    for k, each in enumerate(paired, 1):
        target, source = each.placement.target.poles, each.placement.source.poles
        of = "" if len(paired) == 1 else f" of placement {k}"
        for i, j, distance in left_out(target, source, each.hypothesis.match):
            yield Reason(
                "pole_left_out",
                f"pole T{i} of the target and pole S{j} of the source{of} lie "
                f"{quantities.error(distance)} apart, whereas the {len(each.target_poles)} others "
                "agree, and were left out: did it move between the recordings?",
                {"placement": k, "target": i, "source": j, "apart_m": distance},
            )


def check_sensor(lidar: str, scan: Scan) -> Iterator[Reason]:
    """Report that a cloud shows more than the given sensor can see, or is computed with angles
    that are not those of the unit.
    """
    doubt = sensor_doubt(scan.cloud, scan.sensor)
    if doubt and scan.sensor is not None:
        yield Reason("sensor_doubtful", doubt, {"lidar": lidar, "sensor": scan.sensor.name})
    if model := scan.cloud.nominal_angles:
        low, high = (np.degrees(angle) for angle in UNITS_DIFFER)
        yield Reason(
            "nominal_angles",
            f"the points of {lidar} are computed with the angles of an example of the {model}: "
            f"units differ by {low:.2f}° to {high:.1f}° in elevation, {30 * UNITS_DIFFER[0]:.2f} "
            f"to {30 * UNITS_DIFFER[1]:.1f} m at 30 m, which the stated error does not include; "
            "give the angles of the unit with --angles FILE",
            {"lidar": lidar, "model": model, "differ_rad": float(UNITS_DIFFER[1])},
        )


UNITS_DIFFER = np.radians([0.02, 0.4])
"""By how much the channels of one unit look higher than those of another, in the mean of all: least
and most of five models, of which the maker and a driver (Nebula) publish an example each. Pandar40P
0.42°, Pandar64 0.19°, OT128 0.10°, XT32 0.04°, XT32M 0.02°."""


def check_angles(directions: Sequence[Array], lidars: str = "") -> Iterator[Reason]:
    """Report that poles (3,) each that link two LiDARs, of a site by name, are nearly parallel."""
    angle = widest_angle(directions)
    if angle < WEAK_ANGLE:
        degrees = float(np.degrees(angle))
        of = lidars and f" that link {lidars}"
        yield Reason(
            "nearly_parallel_poles",
            f"the poles{of} differ by {degrees:.1f}°, so that the height is weakly determined; "
            "lean one by 15° or more",
            {"angle_deg": degrees},
        )


def check_returns(lidar: str, poles: Sequence[Pole]) -> Iterator[Reason]:
    """Report that a LiDAR has few returns on its poles; two determine a pose: the second best is
    used."""
    if not poles:
        return
    points, rings = (
        sorted(of_poles)[-2:][0]
        for of_poles in ([len(p.xyz) for p in poles], [p.rings for p in poles])
    )
    if points < FEW_POINTS:
        yield Reason(
            "few_points",
            f"a pole has {quantities.counted(points, 'return')} from the {lidar} LiDAR; move it "
            "nearer or record more frames",
            {"lidar": lidar, "points": points},
        )
    elif rings <= MIN_POLE_RINGS:
        yield Reason(
            "few_rings",
            f"a pole is hit by {quantities.counted(rings, 'ring')} of the {lidar} LiDAR; move "
            "it nearer, or use a longer one",
            {"lidar": lidar, "rings": rings},
        )


def check_noise(lidar: str, sensor: Sensor | None, noise: float) -> Iterator[Reason]:
    """Report that a LiDAR's returns on the poles scatter more than its manufacturer's figure
    allows.

    Parameters
    ----------
    lidar, sensor
        Its name, and what it is.
    noise
        1 σ of its returns along the beam, metres.
    """
    expected = MAX_CONFIRMED_RMS if sensor is None else sensor.range_noise
    allowed = MAX_CONFIRMED_RMS if sensor is None else NOISE_RATIO * sensor.range_noise
    if noise > allowed:
        yield Reason(
            "noisy_poles",
            f"the {lidar}'s returns on the poles scatter by {1000 * noise:.0f} mm along the "
            f"beam, {1000 * allowed:.0f} mm is the largest expected: is --radius right, and did "
            "the poles not move?",
            {"lidar": lidar, "noise_m": noise, "expected_m": expected},
        )


def _weak_pose(aligned: BeamAlignment, weakest: WeakDirection) -> Iterator[Reason]:
    if weakest.sigma > WEAK_SIGMA:
        yield Reason(
            "weak_direction",
            f"least certain is {weakest.words} (1 σ); lean the poles more against each other, move "
            "them nearer, or add a placement",
            {"sigma_m": weakest.sigma, "allowed_m": WEAK_SIGMA, "condition": weakest.condition},
        )
        assert aligned.pose.covariance is not None
        with_offset, without = (
            float(np.sqrt(np.trace(c[3:, 3:])))
            for c in (aligned.pose.covariance, aligned.covariance_if_known)
        )
        if with_offset > OFFSET_SHARE * without:
            yield Reason(
                "offset_not_separable",
                "the returns do not distinguish the pose from a range offset of the tape or an "
                "error of the radius: if these were known, the pose from the poles would have 1 "
                f"σ of {quantities.error(without)}, otherwise {quantities.error(with_offset)}; "
                "put poles on different sides of the LiDARs",
                {"sigma_m": with_offset, "sigma_if_known_m": without},
            )


def _not_converged(aligned: BeamAlignment, refined: Refinement | None) -> Iterator[Reason]:
    if not aligned.converged:
        yield Reason(
            "not_converged",
            f"the pose from the poles still moved after {aligned.iterations} iterations; record "
            "more frames, or check which objects were detected as poles",
            {"stage": "poles", "iterations": aligned.iterations},
        )
    if refined is not None and not refined.converged:
        yield Reason(
            "not_converged",
            f"the refinement by the scene still moved after {refined.iterations} iterations; "
            "compare with --no-refine",
            {"stage": "refined", "iterations": refined.iterations},
        )
