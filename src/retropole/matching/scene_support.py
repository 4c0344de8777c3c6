"""What the scene must say for a choice of poles of which some are doubtful.

Sure poles leave the scene to tell a few poses apart; doubtful ones need it as a witness of its own
(docs/detection.md, Doubtful poles).
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Hypothesis

MIN_CONFIRMED_OVERLAP = 0.4
"""Share of the points that must find a neighbour; sure poles need 0.25."""

MIN_CONFIRMED_COVISIBLE, LEAST_CONFIRMED_OVERLAP = 0.45, 0.2
"""Or so much of the points that both LiDARs could see, and of all; sure poles need 0.35, 0.15."""

MAX_CONFIRMED_VIOLATION = 0.05
"""Largest share of the points that stand where the other LiDAR looked through."""

MIN_CONFIRMED_LEAD, MIN_LEAD_SHARE = 0.3, 0.7
"""By so much the score leads that of every other hypothesis, the inexact ones included; or by so
much of itself, where the overlap is small."""

CERTAIN_LEAD, MIN_CONTRADICTED = 0.15, 0.03
"""By so much it leads, in score, a hypothesis with so much that stands where the other LiDAR looked
through, where the scene is certain of the first, or where it is settled and next to nothing speaks
against it; …"""

MIN_OVERLAP, MIN_COVISIBLE, LEAST_OVERLAP = 0.25, 0.35, 0.2
"""… where it is settled, also one in which less of the points has a neighbour than the first, and
less than the others of those that both LiDARs could see, or of all: alone it would be refused. Of a
settled hypothesis that next to nothing speaks against, so much is enough."""

MAX_ICP_ROTATION, MAX_ICP_TRANSLATION = float(np.radians(7.0)), 0.4
"""ICP of the scenes moves the pose by no more, rad and m, …"""

MIN_CERTAIN_COVISIBLE, MAX_CERTAIN_VIOLATION = 0.75, 0.005
"""… unless so much of what both LiDARs could see coincides, and so little contradicts it: ICP of
coarse scans wanders along floors and walls. Wrong hypotheses contradicted 1.3 % and more."""

MAX_SETTLED_VIOLATION = 0.01
"""Share of the points up to which next to nothing speaks against a settled hypothesis. Of nine
right ones in hard scenes (seeds below 1000) that need the two rules above, 0.6 % at most did."""


def lead_needed(best: Hypothesis, other: Hypothesis) -> float:
    """By how much the score of a choice must lead another's."""
    is_contradicted = other.free_space_violation >= MIN_CONTRADICTED
    is_undenied = _is_settled_undenied(best)
    if (is_contradicted and (is_undenied or _is_certain(best))) or (
        is_undenied and not _overlaps(other)
    ):
        return CERTAIN_LEAD
    return min(MIN_CONFIRMED_LEAD, MIN_LEAD_SHARE * best.score)


def scene_agrees(best: Hypothesis) -> bool:
    """Whether the scenes overlap enough under a choice, and nothing contradicts it."""
    covisible = best.covisible_overlap or 0.0
    is_covisible = covisible >= MIN_CONFIRMED_COVISIBLE and best.overlap >= LEAST_CONFIRMED_OVERLAP
    overlaps = best.overlap >= MIN_CONFIRMED_OVERLAP or is_covisible
    return (
        (overlaps or (_is_settled_undenied(best) and _overlaps(best)))
        and best.free_space_violation <= MAX_CONFIRMED_VIOLATION
        and (best.match.settled or _is_certain(best) or _icp_stays(best))
    )


def _is_certain(best: Hypothesis) -> bool:
    """Whether nearly all that both LiDARs could see coincides, and next to nothing contradicts."""
    return (
        best.covisible_overlap is not None
        and best.covisible_overlap >= MIN_CERTAIN_COVISIBLE
        and best.free_space_violation <= MAX_CERTAIN_VIOLATION
    )


def _is_settled_undenied(best: Hypothesis) -> bool:
    """Whether the scenes registered to where the poles fit, and next to nothing contradicts."""
    return best.match.settled and best.free_space_violation <= MAX_SETTLED_VIOLATION


def _overlaps(hypothesis: Hypothesis) -> bool:
    """Whether as much overlaps as is asked of sure poles."""
    covisible = hypothesis.covisible_overlap or 0.0
    is_covisible = covisible >= MIN_COVISIBLE and hypothesis.overlap >= LEAST_OVERLAP
    return hypothesis.overlap >= MIN_OVERLAP or is_covisible


def _icp_stays(best: Hypothesis) -> bool:
    """Whether ICP stays; a settled hypothesis is where a sharper registration ended."""
    if best.icp_rotation is None or best.icp_translation is None:
        return False
    return best.icp_rotation <= MAX_ICP_ROTATION and best.icp_translation <= MAX_ICP_TRANSLATION
