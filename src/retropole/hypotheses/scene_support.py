"""What the scene must say for a choice of poles of which some are doubtful.

Confirmed poles leave the scene to tell a few poses apart; candidates need it as evidence of its
own (docs/detection.md, Candidate poles).
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Hypothesis

MIN_CONFIRMED_OVERLAP = 0.4
"""Share of the points that must find a neighbour; confirmed poles need 0.25."""

MIN_CONFIRMED_COVISIBLE = 0.45
"""Or so much of the points that both LiDARs could see; confirmed poles need 0.35."""

MAX_CONFIRMED_VIOLATION = 0.05
"""Largest share of the points that stand where the other LiDAR looked through."""

MIN_CONFIRMED_MARGIN, MIN_MARGIN_SHARE = 0.3, 0.7
"""By so much the score leads that of every other hypothesis, the inexact ones included; or by so
much of itself, where the overlap is small."""

CERTAIN_MARGIN, MIN_CONTRADICTED = 0.15, 0.03
"""By so much a certain hypothesis leads, in score, one with so much that stands where the other
LiDAR looked through; …"""

SUPPORT_OVERLAP, SUPPORT_COVISIBLE, SUPPORT_LEAST_OVERLAP = 0.25, 0.35, 0.2
"""… or one in which less of the points has a neighbour than the first, and less than the second of
those that both LiDARs could see, or than the last of all: alone it would be refused. Of a certain
hypothesis so much is enough."""

MAX_ICP_ROTATION, MAX_ICP_TRANSLATION = float(np.radians(7.0)), 0.4
"""ICP of the scenes moves the pose by no more, rad and m, unless it is settled or certain: ICP of
coarse scans wanders along floors and walls."""

MIN_CERTAIN_COVISIBLE, MAX_CERTAIN_VIOLATION = 0.75, 0.01
"""A hypothesis is certain where it is settled, or so much of what both LiDARs could see coincides,
and so little contradicts it. Wrong hypotheses contradicted 1.3 % and more; of nine right ones in
hard scenes (seeds below 1000) that need it, 0.6 % at most did."""


def margin_needed(best: Hypothesis, other: Hypothesis) -> float:
    """By how much the score of a choice must lead another's."""
    is_contradicted = other.free_space_violation >= MIN_CONTRADICTED
    if _is_certain(best) and (is_contradicted or not _overlaps(other)):
        return CERTAIN_MARGIN
    return min(MIN_CONFIRMED_MARGIN, MIN_MARGIN_SHARE * best.score)


def scene_agrees(best: Hypothesis) -> bool:
    """Whether the scenes overlap enough under a choice, and nothing contradicts it."""
    is_certain = _is_certain(best)
    overlaps = _overlaps(best, MIN_CONFIRMED_OVERLAP, MIN_CONFIRMED_COVISIBLE)
    return (
        (overlaps or (is_certain and _overlaps(best)))
        and best.free_space_violation <= MAX_CONFIRMED_VIOLATION
        and (best.match.icp_refined or is_certain or _icp_stays(best))
    )


def _is_certain(best: Hypothesis) -> bool:
    """Whether the scenes registered to where the poles fit, or nearly all that both LiDARs could
    see coincides, and next to nothing contradicts.
    """
    coincides = (best.covisible_overlap or 0.0) >= MIN_CERTAIN_COVISIBLE
    return (
        best.match.icp_refined or coincides
    ) and best.free_space_violation <= MAX_CERTAIN_VIOLATION


def _overlaps(
    hypothesis: Hypothesis, least: float = SUPPORT_OVERLAP, covisible: float = SUPPORT_COVISIBLE
) -> bool:
    """Whether so much of all overlaps, or of what both LiDARs could see and `SUPPORT_LEAST_OVERLAP`
    of all; as much as confirmed poles need where nothing else is said.
    """
    is_covisible = (hypothesis.covisible_overlap or 0.0) >= covisible
    return hypothesis.overlap >= least or (
        is_covisible and hypothesis.overlap >= SUPPORT_LEAST_OVERLAP
    )


def _icp_stays(best: Hypothesis) -> bool:
    """Whether ICP stays; an ICP-refined hypothesis is where a sharper registration ended."""
    if best.icp_rotation is None or best.icp_translation is None:
        return False
    return best.icp_rotation <= MAX_ICP_ROTATION and best.icp_translation <= MAX_ICP_TRANSLATION
