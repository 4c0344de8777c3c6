"""Ok, warn or refused, and why: the rules that stand between an estimate and an answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .alignment.adjustment import BeamAlignment
from .datatypes import Hypothesis, Pole, Reason, WeakDirection
from .errors import Refusal
from .matching.correspondence import widest_angle
from .scene.refinement import Refinement
from .sensors import Sensor

RIVAL_OVERLAP = 0.62
RIVAL_FREE_SPACE_VIOLATION = 0.025
"""A hypothesis is a rival of the best where it has so much of its overlap, and where no more than
this share of the points beyond the best's own speaks against it. The score alone does not do: it
favours, by up to 0.2, whatever brings the LiDARs near each other, since near each other they see
the same things (see docs/hypotheses.md)."""

WARN_MARGIN = 0.1
"""Below this margin the answer stands, but a person should look at the hypotheses."""

MIN_OVERLAP = 0.25
"""Share of the points that must find a neighbour in the other cloud."""

WEAK_ANGLE = np.radians(15.0)
"""Poles nearer to parallel than this make a weak answer."""

MAX_MAHALANOBIS_SQ = 30.0
"""Squared Mahalanobis distance of the refined pose from the poles' own: χ² with 6 degrees of
freedom exceeds it once in 25,000 times."""

FEW_POINTS = 12
"""Returns on a pole below which its line is weak."""

FEW_RINGS = 3
"""Beams on a pole up to which its direction is weak."""

NOISE_RATIO, ANY_NOISE = 3.0, 0.03
"""Returns on poles scatter no more than this many times the noise that the sensor's maker states,
or, of a sensor not known, than this, metres."""

WEAK_SIGMA = 0.05
"""1 σ of the poles' place above which a direction is called weak, metres."""

OFFSET_SHARE = 2.0
"""By this factor a range offset or the radius, were they known, would sharpen the pose, before it
is said that they are what limits it."""


def margin_of(hypotheses: Sequence[Hypothesis]) -> float | None:
    """Score of the first hypothesis over the next best; None where there is only one."""
    if len(hypotheses) < 2:
        return None
    return hypotheses[0].score - max(h.score for h in hypotheses[1:])


def check_choice(hypotheses: Sequence[Hypothesis]) -> None:
    """Refuse where the scene does not decide between the hypotheses, or denies them all.

    Raises
    ------
    Refusal
        ``no_overlap`` or ``ambiguous``.
    """
    best = hypotheses[0]
    if best.overlap < MIN_OVERLAP:
        raise Refusal(
            "no_overlap",
            f"under the best hypothesis only {best.overlap:.0%} of the points have a neighbour in "
            f"the other cloud, {MIN_OVERLAP:.0%} are needed: do both LiDARs see the same place, "
            "and the same two poles?",
            {"overlap": best.overlap, "needed": MIN_OVERLAP},
        )
    rivals = [h for h in hypotheses[1:] if _is_rival(h, best)]
    if rivals:
        rival = max(rivals, key=lambda h: h.score)
        raise Refusal(
            "ambiguous",
            f"the scene does not tell {1 + len(rivals)} hypotheses apart (overlap "
            f"{best.overlap:.2f} and {rival.overlap:.2f}, contradicted {best.free_space:.3f} and "
            f"{rival.free_space:.3f}): add a third pole, or move the poles, a car or a box so "
            "that the surroundings are not symmetric about the poles",
            {
                "rivals": len(rivals),
                "overlap": best.overlap,
                "rival_overlap": rival.overlap,
                "free_space": best.free_space,
                "rival_free_space": rival.free_space,
            },
        )


def _is_rival(hypothesis: Hypothesis, best: Hypothesis) -> bool:
    return (
        hypothesis.match.exact
        and hypothesis.overlap >= RIVAL_OVERLAP * best.overlap
        and hypothesis.free_space <= best.free_space + RIVAL_FREE_SPACE_VIOLATION
    )


def weaknesses(
    paired: Sequence[tuple[Sequence[Pole], Sequence[Pole]]],
    hypotheses: Sequence[Hypothesis],
    aligned: BeamAlignment,
    sensors: Sequence[Sensor | None],
    weakest: WeakDirection,
    refined: Refinement | None,
) -> list[Reason]:
    """Say what makes an answer weak that is good enough to give.

    Parameters
    ----------
    paired
        Per placement, the poles of the target and of the source that the choice pairs.
    hypotheses
        All hypotheses, the chosen one first.
    aligned
        The poles' pose.
    sensors
        What the target and the source are; None where not known.
    weakest
        The direction in which the answer is least sure.
    refined
        The pose of poles and scene; None where the scene was not asked, or had nothing to say.
    """
    return [
        *_weak_choice(hypotheses),
        *_weak_poles(paired),
        *_noisy_poles(aligned, sensors),
        *_weak_pose(aligned, weakest),
        *check_agreement(refined),
    ]


def _weak_choice(hypotheses: Sequence[Hypothesis]) -> Iterator[Reason]:
    margin = margin_of(hypotheses)
    if margin is not None and margin < WARN_MARGIN:
        yield Reason(
            "small_margin",
            f"the chosen hypothesis leads by {margin:.3f} only (comfortable: {WARN_MARGIN:g}); "
            "look at the hypotheses in the report before you use the transform",
            {"margin": margin, "comfortable": WARN_MARGIN},
        )


def _weak_poles(paired: Sequence[tuple[Sequence[Pole], Sequence[Pole]]]) -> Iterator[Reason]:
    angle = widest_angle([pole for target, _ in paired for pole in target])
    if angle < WEAK_ANGLE:
        degrees = float(np.degrees(angle))
        yield Reason(
            "nearly_parallel_poles",
            f"the poles are {degrees:.1f}° apart, which leaves height weak; lean one by 15° "
            "or more",
            {"angle_deg": degrees},
        )
    for side, name in enumerate(("target", "source")):
        poles = [pole for pair in paired for pole in pair[side]]
        points, rings = min(len(p.xyz) for p in poles), min(p.rings for p in poles)
        if points < FEW_POINTS:
            yield Reason(
                "few_points",
                f"a pole has {points} returns from the {name} LiDAR; move it nearer or record "
                "more frames",
                {"lidar": name, "points": points},
            )
        elif rings <= FEW_RINGS:
            yield Reason(
                "few_rings",
                f"a pole meets {rings} beams of the {name} LiDAR; move it nearer, or take a longer "
                "one",
                {"lidar": name, "rings": rings},
            )


def _noisy_poles(aligned: BeamAlignment, sensors: Sequence[Sensor | None]) -> Iterator[Reason]:
    for name, noise, sensor in zip(("target", "source"), aligned.noise, sensors, strict=True):
        expected = ANY_NOISE if sensor is None else sensor.range_noise
        allowed = ANY_NOISE if sensor is None else NOISE_RATIO * sensor.range_noise
        if noise > allowed:
            yield Reason(
                "noisy_poles",
                f"the {name}'s returns on the poles scatter by {1000 * noise:.0f} mm along the "
                f"beam, {1000 * allowed:.0f} mm are the most to expect: is --radius right, and "
                "did the poles stand still?",
                {"lidar": name, "noise_m": noise, "expected_m": expected},
            )


def _weak_pose(aligned: BeamAlignment, weakest: WeakDirection) -> Iterator[Reason]:
    if weakest.sigma > WEAK_SIGMA:
        yield Reason(
            "weak_direction",
            f"least sure is {weakest.words} (1 σ); lean the poles more against each other, move "
            "them nearer, or add a placement",
            {"sigma_m": weakest.sigma, "allowed_m": WEAK_SIGMA, "condition": weakest.condition},
        )
        assert aligned.stage.covariance is not None
        with_offset, without = (
            float(np.sqrt(np.trace(c[3:, 3:])))
            for c in (aligned.stage.covariance, aligned.covariance_sure)
        )
        if with_offset > OFFSET_SHARE * without:
            yield Reason(
                "offset_not_separable",
                "the returns cannot tell the pose from a range offset that the tape may cause, or "
                f"from an error of the radius: with these known the poles' pose would be sure to "
                f"{100 * without:.1f} cm, so it is to {100 * with_offset:.1f} cm; put poles on "
                "different sides of the LiDARs",
                {"sigma_m": with_offset, "sigma_if_known_m": without},
            )


def check_agreement(refined: Refinement | None) -> list[Reason]:
    """Warn where the scene draws the pose further away than the poles' uncertainty allows."""
    if refined is None or refined.pull <= MAX_MAHALANOBIS_SQ:
        return []
    return [
        Reason(
            "poles_and_scene_disagree",
            f"the scene draws the pose {1000 * refined.moved:.0f} mm and "
            f"{np.degrees(refined.turned):.2f}° away from the poles, "
            f"{np.sqrt(refined.pull / 6):.1f} times what their uncertainty allows: did "
            "something move between the two recordings, or is --radius wrong?",
            {"pull": refined.pull, "moved_m": refined.moved, "turned_rad": refined.turned},
        )
    ]
