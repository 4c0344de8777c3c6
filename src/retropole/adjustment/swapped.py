"""Recordings that are not what the site file states: of another LiDAR, or of another placement.

A LiDAR does not move, so that all its recordings show the same surroundings; and the poles of a
placement are the same for all LiDARs. A recording that nothing agrees with is tried instead of
another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeVar

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.description import Site
from ..base.errors import Refusal
from ..base.quantities import error
from ..hypotheses.joint_choice import Choice, choose_poses, linked_groups
from ..hypotheses.pairs import Pair, find_pairs, poles_of
from ..hypotheses.scans import Recording, SiteScans, Views
from ..surfaces.standing import Moved, elsewhere, shows_same
from .shared import shared_poles

T = TypeVar("T")
Rows = tuple[tuple[T, ...], ...]
"""Something of every recording: for each LiDAR and placement."""


def check_places(site: Site, views: Views) -> None:
    """Refuse recordings of one LiDAR that do not all show one place.

    Raises
    ------
    Refusal
        ``recordings_exchanged`` where two LiDARs' recordings of a placement show each other's
        place, ``lidar_moved`` otherwise.
    """
    names = [lidar.name for lidar in site.lidars]
    displaced = {i: away for i in range(len(names)) if (away := elsewhere(views.every[i]))}
    for i, j in combinations(displaced, 2):
        both = [
            p
            for p in sorted(displaced[i].keys() & displaced[j].keys())
            if _show_each_other(views, i, j, p)
        ]
        if both:
            # Of two LiDARs with two placements it may have been in either.
            where = " or ".join(site.placements[p] for p in both)
            first, second = (f"{names[k]} in placement {where}" for k in (i, j))
            raise _swap_refusal(first, second, "show each other's place")
    for i, away in displaced.items():
        raise _moved_refusal(names[i], [site.placements[p] for p in sorted(away)], away)


def _moved_refusal(name: str, placements: Sequence[str], away: dict[int, Moved | None]) -> Refusal:
    """Report that a LiDAR is not where it was, by how much, or that the surroundings differ."""
    which = ", ".join(placements)
    values: dict[str, float | int | str] = {"lidar": name, "placements": which}
    steps = [step for step in away.values() if step is not None]
    if len(steps) < len(away):
        return Refusal(
            "lidar_moved",
            f"the recordings of {name} do not all show one place, placement {which} does not: "
            "did it move, or is the file another LiDAR's? Give it another name after a move",
            values,
        )
    most = max(steps, key=lambda step: step.rotation + step.translation)
    turned = float(np.degrees(most.rotation))
    return Refusal(
        "lidar_moved",
        f"{name} moved between its recordings, by {turned:.1f}° and {error(most.translation)} "
        f"(placement {which}): they show one place from two positions; give it "
        "another name after the move",
        values | {"turned_deg": turned, "moved_m": most.translation},
    )


def _show_each_other(views: Views, i: int, j: int, p: int) -> bool:
    """Whether two LiDARs' recordings of a placement fit the other's other recordings."""
    found = []
    for own, other in ((i, j), (j, i)):
        here = views.every[own][p]
        there = [view for q, view in enumerate(views.every[other]) if q != p and view is not None]
        found.append(here is not None and any(shows_same(here, view) for view in there))
    return all(found)


def _swap_refusal(first: str, second: str, why: str) -> Refusal:
    return Refusal(
        "recordings_exchanged",
        f"the recordings of {first} and of {second} are swapped: they {why}; swap them in "
        "the site file",
        {"first": first, "second": second},
    )


@dataclass(frozen=True, eq=False)
class Supported:
    """How much of a choice each recording supports.

    Attributes
    ----------
    met, possible
        For each recording: pairs with others of the same placement that agree, and those that
        could, since both see two poles.
    """

    met: dict[Recording, int]
    possible: dict[Recording, int]

    def unsupported(self) -> list[Recording]:
        """Recordings that no other of their placement agrees with, though some could."""
        return [each for each, count in self.possible.items() if count and not self.met[each]]


def support_of(
    choice: Choice, scans: SiteScans, pairs: Sequence[Pair], poles: Sequence[Array]
) -> Supported:
    """Count what supports each recording under a choice."""
    recordings = [
        (i, p)
        for i, row in enumerate(scans.by_lidar)
        for p, scan in enumerate(row)
        if scan is not None
    ]
    matched, possible = dict.fromkeys(recordings, 0), dict.fromkeys(recordings, 0)
    for pair in pairs:
        i, j = pair.lidars
        placed = i in choice.poses and j in choice.poses
        found = None
        # Where the scenes hardly overlap, poles of one shape may match by chance.
        if placed and pair.overlaps:
            found = pair.at(se3.inverse(choice.poses[i]) @ choice.poses[j], poles[j])
        for p in range(len(scans.by_lidar[0])):
            if min(len(scans.poles(i, p)), len(scans.poles(j, p))) < 2:
                continue
            agrees = found is not None and p in found.poles
            for each in ((i, p), (j, p)):
                possible[each] += 1
                matched[each] += agrees
    return Supported(matched, possible)


def check_swapped(
    site: Site,
    scans: SiteScans,
    views: Views,
    pairs: Sequence[Pair],
    choice: Choice,
    poles: Sequence[Array],
) -> None:
    """Refuse where recordings that nothing agrees with fit in each other's place.

    Raises
    ------
    Refusal
        ``recordings_exchanged``.
    """
    unsupported = support_of(choice, scans, pairs, poles).unsupported()
    mended: list[tuple[Recording, Recording]] = []
    for one, other in combinations(unsupported, 2):
        if one[0] != other[0] and one[1] != other[1]:
            continue
        tried = replace(scans, by_lidar=_swapped(scans.by_lidar, one, other))
        seen = Views(_swapped(views.every, one, other))
        if any(elsewhere(seen.every[lidar]) for lidar in {one[0], other[0]}):
            # Exchanged, they would not show the surroundings of those LiDARs.
            continue
        if _share_poles(tried, choice, site.radius, one, other):
            if not _share_poles(scans, choice, site.radius, one, other):
                mended.append((one, other))
            continue
        found = find_pairs(tried, seen)
        group = next((g for g in linked_groups(len(site.lidars), found) if one[0] in g), [])
        if len(group) < 2:
            continue
        at = [poles_of(tried, i) for i in range(len(site.lidars))]
        again = choose_poses(group, found, at, group[0]).best
        left = support_of(again, tried, found, at).unsupported()
        if one not in left and other not in left:
            mended.append((one, other))
    if not mended:
        return
    # Where two LiDARs alone share the poles of two placements, it may be either's files.
    first, second = (
        " or ".join(
            f"{site.lidars[i].name} in placement {site.placements[p]}"
            for i, p in dict.fromkeys(each[k] for each in mended)
        )
        for k in (0, 1)
    )
    raise _swap_refusal(first, second, "fit all others in each other's place")


def _share_poles(
    scans: SiteScans, choice: Choice, radius: float, one: Recording, other: Recording
) -> bool:
    """Whether both of two recordings show two poles or more where others of the placement do."""
    shared = [pole for pole in shared_poles(scans, choice.poses, radius) if len(pole.seen) > 1]
    return all(
        sum(lidar in pole.seen and pole.placement == placement for pole in shared) > 1
        for lidar, placement in (one, other)
    )


def _swapped(rows: Rows[T], one: Recording, other: Recording) -> Rows[T]:
    """Swap two recordings."""
    kept = [list(row) for row in rows]
    (i, p), (j, q) = one, other
    kept[i][p], kept[j][q] = kept[j][q], kept[i][p]
    return tuple(tuple(row) for row in kept)
