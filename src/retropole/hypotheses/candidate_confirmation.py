"""Candidate poles count only where the other LiDAR and the scene confirm them.

A candidate pole alone says nothing. Two lines that one LiDAR sees at the same angle and distance as
the other, laid on each other by a pose under which the two scenes coincide, and by no other pose
nearly as well: that does not happen by chance (docs/detection.md, Candidate poles).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import Hypothesis, Placement, Pole
from ..base.errors import Reason
from ..extraction.beams import RMS_PER_RADIUS, beam_scatter, beams_by
from .line_pairs import direction_sigma, line_pair
from .placements import PairedPlacement
from .scene_support import margin_needed, scene_agrees

FACING_SIDES, CONFIRMED_NOISE = float(np.pi / 2), 0.01
"""Residual of the poles under the pose, at most: the lines of facing sides lie π r/2 apart, returns
scatter by `RMS_PER_RADIUS` about their line, and by noise, metres. That is 35 mm for r = 20 mm;
wrong answers had 38 mm and more. Wide beams add their scatter."""

CONFIRMED_ANGLE = float(np.radians(1.5))
CONFIRMED_DISTANCE = 0.05
"""The two LiDARs agree on the angle and the distance of two lines within this, rad and m, beyond
two sigma of what their returns fix."""

CONFIRMED_COUNT = 3
"""So many poles need not meet the limits above where they fit under the pose that the scenes
register to: two lines have two measures of their own, the angle and the distance, and by chance
some agree in both. Of a third pole's four numbers none is left free."""


def counts_candidates(placement: Placement) -> bool:
    """Whether candidate poles are among those of a placement."""
    return any(
        pole is own for scan in placement.scans for pole in scan.poles for own in scan.candidates
    )


def is_confirmed(
    paired: Sequence[PairedPlacement], hypotheses: Sequence[Hypothesis], radius: float
) -> bool:
    """Whether both LiDARs and the scene confirm a choice that rests on candidate poles.

    Parameters
    ----------
    paired
        Every placement, its poles paired by the choice.
    hypotheses
        All hypotheses, the chosen one first.
    radius
        Of the poles, metres.
    """
    best, *others = hypotheses
    return (
        all(best.score - other.score >= margin_needed(best, other) for other in others)
        and scene_agrees(best)
        and all(
            each.hypothesis.match.exact and (_several_refined(each) or _two_agree(each, radius))
            for each in paired
        )
    )


def _two_agree(each: PairedPlacement, radius: float) -> bool:
    """Whether the poles fit each other as closely as two must."""
    limit = np.hypot(np.hypot(FACING_SIDES, RMS_PER_RADIUS) * radius, CONFIRMED_NOISE)
    is_near = each.hypothesis.match.pole_rms <= np.hypot(limit, _beam_scatter(each, radius))
    return bool(is_near and _lines_agree(each))


def _several_refined(each: PairedPlacement) -> bool:
    match = each.hypothesis.match
    return match.icp_refined and len(match.pairs) >= CONFIRMED_COUNT


def _beam_scatter(each: PairedPlacement, radius: float) -> float:
    """What wide beams of the source add to the residual of its poles, metres."""
    scan = each.placement.source
    beams = beams_by(scan.sensor)
    squares = [
        beam_scatter(float(np.linalg.norm(pole.point - scan.cloud.origin)), radius, beams) ** 2
        for pole in each.source_poles
    ]
    return float(np.sqrt(np.mean(squares)))


def _lines_agree(each: PairedPlacement) -> bool:
    """Whether any two of the paired poles lie to each other as the other LiDAR sees them."""
    target, source = each.target_poles, each.source_poles
    for i in range(len(target)):
        for j in range(i):
            four = (target[i], target[j], source[i], source[j])
            one = line_pair(four[0].point, four[0].direction, four[1].point, four[1].direction)
            other = line_pair(four[2].point, four[2].direction, four[3].point, four[3].direction)
            sigma = float(np.linalg.norm([direction_sigma(pole) for pole in four]))
            lever = max(
                float(np.linalg.norm(pair.frame[:3, 3] - pole.point))
                for pair, poles in ((one, four[:2]), (other, four[2:]))
                for pole in poles
            )
            if abs(one.angle - other.angle) > CONFIRMED_ANGLE + 2 * sigma:
                return False
            if abs(one.distance - other.distance) > CONFIRMED_DISTANCE + 2 * sigma * lever:
                return False
    return True


def candidates_in(each: PairedPlacement) -> tuple[list[Pole], list[Pole]]:
    """The paired poles of the target and of the source that are doubtful."""
    target, source = (
        [pole for pole in poles if any(pole is own for own in scan.candidates)]
        for scan, poles in zip(
            each.placement.scans, (each.target_poles, each.source_poles), strict=True
        )
    )
    return target, source


def candidate_reasons(
    paired: Sequence[PairedPlacement], hypotheses: Sequence[Hypothesis]
) -> list[Reason]:
    """Warn where an answer rests on candidate poles; nothing where all are confirmed."""
    target, source = 0, 0
    for each in paired:
        of_target, of_source = candidates_in(each)
        target, source = target + len(of_target), source + len(of_source)
    if target + source == 0:
        return []
    best = hypotheses[0]
    return [
        Reason(
            "doubtful_poles",
            f"{target} of the target's poles and {source} of the source's are doubtful by "
            f"themselves, near a wall, beside something bright, with few returns or dim tape; both "
            f"LiDARs agree on them to {1000 * best.match.pole_rms:.0f} mm, and {best.overlap:.0%} "
            "of the points have a neighbour under this pose only",
            {
                "target": target,
                "source": source,
                "pole_rms_m": best.match.pole_rms,
                "overlap": best.overlap,
                "free_space": best.free_space_violation,
            },
        )
    ]
