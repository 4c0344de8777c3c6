"""A pole that moved, where poles do not check each other: the surroundings coincide without it.

Two poles fit each other wherever one of them is pushed within the freedom that the other leaves,
and the surfaces, weighed by how far they lie apart, follow. Of three poles any two may be the pair
that fits. But under the pose that a moved pole gives walls do not coincide that do without it. Most
of what is seen is ground, which coincides with itself wherever it slides to: only what two answers
place differently tells between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..alignment.unknowns import POSE
from ..base import se3
from ..base.errors import Reason, Refusal
from ..hypotheses.by_place import LEAN_ANOTHER, is_held
from ..surfaces.patch_pairs import pair_patches
from .datum import Datum, without_poles
from .descent import End
from .hanging import Hanging
from .links import find_links
from .site import Adjusted, Recorded, adjust
from .terms import FEW, SceneTerm

CLOSE = 0.02
"""Patches that lie so far apart count by half, metres: twice what the range offset of a LiDAR is
taken for where nothing is known of it, and a tenth of what a pose is off by that a moved pole makes
wrong."""

PLACED_APART = 2 * CLOSE
"""Answers place a patch differently that they move by more than this across its surface, metres."""

MORE_PATCHES, TIMES_PATCHES = 5.0, 2.0
"""So many more patches must coincide under another answer, and so many times as many. Without a
pole that stood still no patch was placed differently, and of every fourth up to 32 where none
coincided either way (tuning seeds 3 to 40 of tests/adjustment/test_contradiction.py, 30 to 90 of
benchmarks/site.py). Without one that made 33 answers of the former wrong by 0.15 m or more, and
passed its own tests, 9 to 716 more coincided, 19 times as many or more."""


def more_coincide(before: End, after: End, near: frozenset[int] | None = None) -> float:
    """Count how many more patches coincide under another answer, of those it places differently.

    Each counts by how small its distance is, less what the estimated errors of both LiDARs make of
    it. How certain the answers are has no part in it: neither in how far a patch looks for another,
    nor in what is small.

    Parameters
    ----------
    before, after
        The answer, and the other one; the patches that the other one took are counted under both.
    near
        LiDARs on one side of a link: only pairs across it count then.

    Returns
    -------
    float
        0 where they are not `TIMES_PATCHES` times as many.
    """
    sets = {term.lidars: term.sets for term in after.scene}
    was = [replace(term, sets=sets.get(term.lidars, term.sets)) for term in before.scene]
    count = _coinciding(before, was, after, near)
    left = _coinciding(after, after.scene, before, near)
    return left - count if left > TIMES_PATCHES * count else 0.0


def _coinciding(
    end: End, terms: Sequence[SceneTerm], other: End, near: frozenset[int] | None
) -> float:
    """Count what coincides under an answer of what another one places differently."""
    count = 0.0
    for term in terms:
        i, j = term.lidars
        if near is not None and len(near & {i, j}) != 1:
            continue
        T, T_other = (se3.inverse(each.T[i]) @ each.T[j] for each in (end, other))
        patches = pair_patches(term.sets, T, np.zeros((POSE, POSE)), False)
        if patches is None:
            continue
        errors = end.errors[term.place[2 * POSE :] - POSE * len(end.T)]
        apart = patches.residuals + patches.by_error @ errors
        weights = patches.agreement / (1.0 + (apart / CLOSE) ** 2)
        differ = np.abs(patches.jacobian @ se3.local(T, T_other)) > PLACED_APART
        count += float(np.sum(weights[differ]))
    return count


def least_conflicting(ends: Sequence[End]) -> int:
    """Find the answer that the surroundings conflict with least; of equals the first."""
    against = [
        max((more_coincide(one, other) for other in ends if other is not one), default=0.0)
        for one in ends
    ]
    # Less than a patch tells nothing.
    return int(np.argmin(np.floor(against)))


def conflicting_poles(
    recorded: Recorded, adjusted: Adjusted
) -> Iterator[tuple[int, Adjusted, float]]:
    """Find the poles without which far more of the surroundings coincides.

    Only where two poles alone link some LiDARs to all others: more check each other.

    Parameters
    ----------
    recorded, adjusted
        What was recorded, and what fits by its own tests.

    Yields
    ------
    int, Adjusted, float
        Index of the pole, everything adjusted without it, and how many more patches coincide.
    """
    weak = [link for link in find_links(adjusted) if len(link.poles) == 2]
    for k in sorted({k for link in weak for k in link.poles}):
        across = [link.near for link in weak if k in link.poles]
        found = _contradicted(recorded, adjusted, without_poles(adjusted.datum, {k}), across)
        if found is not None:
            yield k, *found


def check_poles_of_hanging(recorded: Recorded, adjusted: Adjusted) -> Iterator[Reason]:
    """Refuse what hangs on poles without which far more of the surroundings coincides.

    One pole conflicts with nothing across itself, where it alone decides and surfaces look for
    their partners no farther than it allows. So it is parted: each side has it at a place of its
    own, and the place holds the pose.

    Yields
    ------
    Reason
        ``not_checked`` where the surroundings alone do not hold the pose, and no push of the pole
        would show.

    Raises
    ------
    Refusal
        ``site_inconsistent``.
    """
    datum, site = adjusted.datum, recorded.site
    for each in datum.hanging:
        across = each.across(datum.poles)
        others = tuple(one for one in datum.hanging if one is not each)
        parted = replace(datum, hanging=others, poles=each.parted(datum.poles))
        some = _without(recorded, adjusted, parted, [each.lidars], few=True)
        if some is not None and some[1] < MORE_PATCHES / FEW and _is_held(each, some[0]):
            continue
        every = _without(recorded, adjusted, parted, [each.lidars], few=False)
        names = ", ".join(datum.poles[k].name(site) for k in across)
        if every is not None and every[1] >= MORE_PATCHES:
            raise Refusal(
                "site_inconsistent",
                f"{names} moved between the recordings of {each.names(site)}, which nothing else "
                f"links: without it {every[1]:.0f} more patches of their surroundings coincide; "
                "record the placement again",
                {"poles": names, "more": every[1], "allowed": MORE_PATCHES},
            )
        if every is None or not _is_held(each, every[0]):
            yield Reason(
                "not_checked",
                f"{names} alone holds a part of the pose between {each.names(site)}, and the "
                f"surroundings do not check it: a push of it would not show; {LEAN_ANOTHER}",
                {"lidar": site.lidars[each.far].name, "poles": names},
            )


def _is_held(hanging: Hanging, found: Adjusted) -> bool:
    return is_held(hanging.covariance(found.end.T, found.covariance))


def _contradicted(
    recorded: Recorded, adjusted: Adjusted, datum: Datum, across: Sequence[frozenset[int]]
) -> tuple[Adjusted, float] | None:
    """Adjust without some poles, and count how many more patches coincide; None where few do."""
    # A part of the patches is enough to see that nothing moved, but may hold too little.
    some = _without(recorded, adjusted, datum, across, few=True)
    if some is not None and some[1] < MORE_PATCHES / FEW:
        return None
    every = _without(recorded, adjusted, datum, across, few=False)
    return every if every is not None and every[1] >= MORE_PATCHES else None


def _without(
    recorded: Recorded,
    adjusted: Adjusted,
    datum: Datum,
    across: Sequence[frozenset[int]],
    *,
    few: bool,
) -> tuple[Adjusted, float] | None:
    """Adjust what is left, and count how many more patches coincide; None where it is refused."""
    try:
        rest = adjust(recorded, datum, few=few)
    except Refusal:
        return None
    return rest, max(more_coincide(adjusted.end, rest.end, near) for near in across)
