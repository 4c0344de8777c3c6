"""Candidate poles are used only if the other LiDAR and the scene confirm them.

A candidate pole alone gives no information. But two lines with the same angle and distance for
both LiDARs, which coincide under a pose that also makes the two scenes coincide, and under no
other pose nearly as well, do not occur by chance (docs/evidence/detection.md, Candidate poles).

If some of the chosen poles are doubtful, more is required of the scene. With confirmed poles
the scene only has to distinguish a few poses; with candidates it must be separate evidence
(docs/evidence/detection.md, Candidate poles).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import Hypothesis, Pole
from ..base.errors import Reason
from ..extraction.sensor_pattern import RMS_PER_RADIUS, beam_scatter, beams_by
from .choice import MIN_COVISIBLE_OVERLAP, MIN_OVERLAP, RIVAL_FREE_SPACE_VIOLATION
from .correspondence import EXACT_RMS, direction_sigma, line_pair
from .evidence import REDUNDANT_POLES
from .placements import PairedPlacement

MIN_CONFIRMED_OVERLAP = 0.4
"""Share of the points that must find a neighbour; confirmed poles need 0.25."""

MIN_CONFIRMED_COVISIBLE = 0.45
"""Or this share of the points that both LiDARs could see; confirmed poles need 0.35."""

MAX_CONFIRMED_VIOLATION = 0.05
"""Largest share of the points in space that the other LiDAR saw to be empty. No loop is
closed with a hypothesis that exceeds the best by this much: on bare ground the right one, 0.3°
off, had up to 0.046 more than one that puts the scenes next to each other, in eight of 130 rings
(benchmarks/site.py rings, seeds 0 to 129)."""

MIN_CONFIRMED_MARGIN, MIN_MARGIN_SHARE = 0.3, 0.7
"""Margin of the score over every other hypothesis, the inexact ones included; or as a part of
the score, if the overlap is small."""

CERTAIN_MARGIN = 0.15
"""Margin in score of a certain hypothesis over one that the scene contradicts so that it
is not a rival (`RIVAL_FREE_SPACE_VIOLATION`); …"""

SUPPORT_LEAST_OVERLAP = 0.2
"""… or one that overlaps less than confirmed poles need (`MIN_OVERLAP`), and in which
either less than `MIN_COVISIBLE_OVERLAP` of what both LiDARs could see has a neighbour or
less than this of all: alone it would be refused. The limits for confirmed poles are enough for a
certain hypothesis."""

MAX_ICP_ROTATION, MAX_ICP_TRANSLATION = float(np.radians(7.0)), 0.4
"""Limit of the movement of the pose by ICP of the scenes, rad and m, unless it is confirmed or
certain: ICP of coarse scans drifts along floors and walls."""

MIN_CERTAIN_COVISIBLE, MAX_CERTAIN_VIOLATION = 0.75, 0.01
"""A hypothesis is certain if it is confirmed, or if at least this share of what both LiDARs could
see coincides, and at most this share contradicts it. Wrong hypotheses contradicted 1.3 % and more;
of nine right ones in hard scenes (seeds below 1000) that need it, 0.6 % at most did."""


def margin_needed(best: Hypothesis, other: Hypothesis) -> float:
    """Margin by which the score of a choice must exceed that of another."""
    is_contradicted = other.free_space_violation >= RIVAL_FREE_SPACE_VIOLATION
    if _is_certain(best) and (is_contradicted or not _overlaps(other)):
        return CERTAIN_MARGIN
    return min(MIN_CONFIRMED_MARGIN, MIN_MARGIN_SHARE * best.score)


def scene_agrees(best: Hypothesis) -> bool:
    """Whether the scenes overlap enough under a choice, without a contradiction."""
    is_certain = _is_certain(best)
    overlaps = _overlaps(best, MIN_CONFIRMED_OVERLAP, MIN_CONFIRMED_COVISIBLE)
    return (
        (overlaps or (is_certain and _overlaps(best)))
        and best.free_space_violation <= MAX_CONFIRMED_VIOLATION
        and (best.match.icp_refined or is_certain or _icp_stays(best))
    )


def _is_certain(best: Hypothesis) -> bool:
    """Whether the registration of the scenes ended where the poles fit, or nearly all that both
    LiDARs could see coincides and hardly anything contradicts.
    """
    coincides = (best.covisible_overlap or 0.0) >= MIN_CERTAIN_COVISIBLE
    return (
        best.match.icp_refined or coincides
    ) and best.free_space_violation <= MAX_CERTAIN_VIOLATION


def _overlaps(
    hypothesis: Hypothesis, least: float = MIN_OVERLAP, covisible: float = MIN_COVISIBLE_OVERLAP
) -> bool:
    """Whether a given share of all points overlaps, or of what both LiDARs could
    see and `SUPPORT_LEAST_OVERLAP` of all; by default the share that confirmed poles need.
    """
    is_covisible = (hypothesis.covisible_overlap or 0.0) >= covisible
    return hypothesis.overlap >= least or (
        is_covisible and hypothesis.overlap >= SUPPORT_LEAST_OVERLAP
    )


def _icp_stays(best: Hypothesis) -> bool:
    """Whether ICP does not move the pose; an ICP-refined hypothesis is where a more precise
    registration ended."""
    if best.icp_rotation is None or best.icp_translation is None:
        return False
    return best.icp_rotation <= MAX_ICP_ROTATION and best.icp_translation <= MAX_ICP_TRANSLATION


FACING_SIDES, CONFIRMED_NOISE = float(np.pi / 2), 0.01
"""Largest residual of the poles under the pose, metres: the distance between the lines of facing
sides is π r/2, returns scatter by `RMS_PER_RADIUS` about their line, and by noise. That is 35 mm
for r = 20 mm; wrong answers had 38 mm and more. Wide beams add their scatter."""

CONFIRMED_ANGLE = float(np.radians(1.5))
"""The two LiDARs agree on the angle of two lines within this, rad, and on their distance within
`EXACT_RMS`, beyond two sigma of their returns."""


def is_confirmed(
    paired: Sequence[PairedPlacement], hypotheses: Sequence[Hypothesis], radius: float
) -> bool:
    """Whether both LiDARs and the scene confirm a choice based on candidate poles.

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
        and poles_agree(paired, radius)
    )


def poles_agree(paired: Sequence[PairedPlacement], radius: float) -> bool:
    """Whether the poles of every placement fit each other as candidates must; radius in metres."""
    return all(
        each.hypothesis.match.exact and (_several_refined(each) or _two_agree(each, radius))
        for each in paired
    )


def _two_agree(each: PairedPlacement, radius: float) -> bool:
    """Whether the poles fit each other as closely as two must."""
    limit = np.hypot(np.hypot(FACING_SIDES, RMS_PER_RADIUS) * radius, CONFIRMED_NOISE)
    is_near = each.hypothesis.match.pole_rms <= np.hypot(limit, _beam_scatter(each, radius))
    return bool(is_near and _lines_agree(each))


def _several_refined(each: PairedPlacement) -> bool:
    match = each.hypothesis.match
    return match.icp_refined and len(match.pairs) >= REDUNDANT_POLES


def _beam_scatter(each: PairedPlacement, radius: float) -> float:
    """Addition by wide beams of the source to the residual of its poles, metres."""
    scan = each.placement.source
    beams = beams_by(scan.sensor)
    squares = [
        beam_scatter(float(np.linalg.norm(pole.point - scan.cloud.origin)), radius, beams) ** 2
        for pole in each.source_poles
    ]
    return float(np.sqrt(np.mean(squares)))


def _lines_agree(each: PairedPlacement) -> bool:
    """Whether any two of the paired poles have the same relative pose for both LiDARs."""
    target, source = each.target_poles, each.source_poles
    for i in range(len(target)):
        for j in range(i):
            four = (target[i], target[j], source[i], source[j])
            one, other = (
                line_pair(a.inner_point, a.direction, b.inner_point, b.direction)
                for a, b in (four[:2], four[2:])
            )
            sigma = float(np.linalg.norm([direction_sigma(pole) for pole in four]))
            lever = max(
                float(np.linalg.norm(pair.frame[:3, 3] - pole.inner_point))
                for pair, poles in ((one, four[:2]), (other, four[2:]))
                for pole in poles
            )
            if abs(one.angle - other.angle) > CONFIRMED_ANGLE + 2 * sigma:
                return False
            if abs(one.distance - other.distance) > EXACT_RMS + 2 * sigma * lever:
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
    """Warn if an answer is based on candidate poles; nothing if all are confirmed."""
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
            f"{target} of the target's poles and {source} of the source's are doubtful, near "
            f"a wall, next to a bright object, with few returns or dim tape; both "
            f"LiDARs agree on them to {1000 * best.match.pole_rms:.0f} mm, and {best.overlap:.0%} "
            "of the points have a neighbour under this pose and no other",
            {
                "target": target,
                "source": source,
                "pole_rms_m": best.match.pole_rms,
                "overlap": best.overlap,
                "free_space": best.free_space_violation,
            },
        )
    ]
