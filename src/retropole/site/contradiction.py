"""A pole that moved, where poles do not check each other: the surroundings coincide without it.

Two poles fit each other wherever one of them is pushed within the freedom that the other leaves,
and the surfaces, weighed by how far they lie apart, follow. Of three poles any two may be the pair
that fits. But under the pose that a moved pole gives fewer surfaces coincide.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .. import se3
from ..errors import Refusal
from ..scene.patch_pairs import pair_patches
from .adjustment import Adjusted
from .datum import Datum, without_poles
from .links import links
from .refinement import SceneTerm, SiteEnd
from .state import POSE

MORE = 1.1
"""So many times as much of the surroundings coincides without a pole that moved. Without one that
stood still it was as much within 0.2 %, and 2 to 11 times as much without one that was displaced by
0.4 m and more where the poles' own tests did not show it (tests/site/test_contradiction.py)."""

CLOSE = 0.02
"""Patches that lie so far apart count by half, metres: twice what the range offset of a LiDAR is
taken for where nothing is known of it, and a tenth of what a pose is off by that a moved pole makes
wrong."""


def coinciding(end: SiteEnd, near: frozenset[int] | None = None) -> float:
    """Count the patches of the surroundings that coincide under the answer.

    Each counts by how small its distance is, less what the estimated errors of both LiDARs make of
    it. How certain the answer is has no part in it: neither in how far a patch looks for another,
    nor in what is small.

    Parameters
    ----------
    end
        The answer.
    near
        LiDARs on one side of a link: only pairs across it count then.
    """
    counts = _by_pair(end)
    return sum(counts.values()) if near is None else _across(counts, near)


def _by_pair(end: SiteEnd) -> dict[tuple[int, int], float]:
    """Count the patches that coincide, pair by pair: a pair lies across several links."""
    return {term.lidars: _coinciding(end, term) for term in end.scene}


def _across(counts: dict[tuple[int, int], float], near: frozenset[int]) -> float:
    """Add up what coincides between LiDARs on one side of a link and those on the other."""
    return sum(count for lidars, count in counts.items() if len(near & set(lidars)) == 1)


def _coinciding(end: SiteEnd, term: SceneTerm) -> float:
    i, j = term.lidars
    T = se3.inverse(end.T[i]) @ end.T[j]
    patches = pair_patches(term.sets, T, np.zeros((POSE, POSE)), False)
    if patches is None:
        return 0.0
    errors = end.errors[term.place[2 * POSE :] - POSE * len(end.T)]
    left = patches.residuals + patches.by_error @ errors
    return float(np.sum(patches.agreement / (1.0 + (left / CLOSE) ** 2)))


def denied_poles(
    adjusted: Adjusted, adjust: Callable[[Datum], Adjusted]
) -> Iterator[tuple[int, Adjusted, float]]:
    """Find the poles without which far more of the surroundings coincides.

    Only where two poles alone link some LiDARs to all others: more check each other.

    Parameters
    ----------
    adjusted
        What fits by its own tests.
    adjust
        Adjusts what is left.

    Yields
    ------
    int, Adjusted, float
        Index of the pole, everything adjusted without it, and how many times as much coincides.
    """
    counts = _by_pair(adjusted.end)
    # Where nothing coincides across a link, its surroundings do not tell.
    weak = [
        (link, before)
        for link in links(adjusted)
        if len(link.poles) == 2 and (before := _across(counts, link.near))
    ]
    for k in sorted({k for link, _ in weak for k in link.poles}):
        try:
            rest = adjust(without_poles(adjusted.datum, {k}))
        except Refusal:
            continue
        left = _by_pair(rest.end)
        more = max(_across(left, link.near) / before for link, before in weak if k in link.poles)
        if more > MORE:
            yield k, rest, more
