"""Whether a LiDAR was still: all its recordings show one place as they are.

What is of another place has little in common. What a turn of a degree or a push of a decimetre
leaves has most in common as it is; registered to each other, its recordings differ by as much as it
moved, since one LiDAR errs the same in all recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import Refusal
from .registration import MIN_CLOUD_POINTS, Surface, register, surface_of
from .visibility import ICP_CORRESPONDENCE_DISTANCE, View, compare_views

SAME_PLACE = 0.5
"""Least share of points that two recordings of one LiDAR have in common if it was still."""

TURNED, PUSHED = float(np.radians(0.5)), 0.1
"""A LiDAR moved that turned or was pushed by more, rad and m. A mast sways by up to 0.1°. 207 pairs
of recordings of still LiDARs came to 0.02° and 6 mm, on bare ground to 0.04° and 44 mm;
13 of LiDARs that turned by 1.0 to 4.5° to 0.01° of that (benchmarks/contradictions.py, seeds 400 to
465, and sites of all kinds from seeds 600 to 629)."""

WITHIN, MORE_COINCIDES = 0.1, 0.05
"""Points with a neighbour within this distance, metres, coincide; and at least this much more do
after the registration, as a part of all. Where nothing but ground is seen it may slide anywhere,
and no more coincides: up to 0.005 (the same seeds). Of those that turned 0.16 and more did."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Displacement of a recording from the first that shows the same place, rad and m."""

    rotation: float
    translation: float


def same_place(one: View, other: View) -> float:
    """Share of points, in both directions, that two recordings have in common as they are."""
    return compare_views(one, other, np.eye(4), within=0.5, limit=0.5).overlap


def shows_same(one: View, other: View) -> bool:
    """Whether two recordings are of one place, seen by a LiDAR that did not move between them."""
    return same_place(one, other) >= SAME_PLACE and moved(one, other) is None


def moved(one: View, other: View) -> Moved | None:
    """Say how a LiDAR moved between two recordings that show one place; None if it did not."""
    surfaces = _surface(one), _surface(other)
    return _moved_between((one, other), surfaces)[1]


def elsewhere(recordings: Sequence[View | None]) -> dict[int, Moved | None]:
    """Placements whose recording does not show the LiDAR's place.

    With three recordings or more, those that agree with less than half of the others; with two that
    differ, both. For each its displacement from the majority; None if it shows another
    place.

    Parameters
    ----------
    recordings
        What the LiDAR saw, in each placement.
    """
    known = [(p, view) for p, view in enumerate(recordings) if view is not None]
    views = [view for _, view in known]
    surfaces = [_surface(view) for view in views] if len(views) > 1 else []
    # Each is registered to the first that shows its place: the others follow.
    first: list[int] = []
    poses: list[Array] = []
    agrees = np.zeros((len(known), len(known)), dtype=bool)
    shares = agrees.copy()
    for a, view in enumerate(views):
        for b in range(a):
            shares[a, b] = shares[b, a] = same_place(views[b], view) >= SAME_PLACE
        root = next((first[b] for b in range(a) if shares[a, b]), a)
        pose = np.eye(4)
        if root != a and shares[a, root]:
            pose, _ = _moved_between((views[root], view), (surfaces[root], surfaces[a]))
        first.append(root)
        poses.append(pose)
        for b in range(a):
            agrees[a, b] = agrees[b, a] = shares[a, b] and not _is_far(_apart(poses[b], pose))
    found: dict[int, Moved | None] = {}
    for a, (p, _) in enumerate(known):
        if 2 * int(agrees[a].sum()) >= len(known) - 1:
            continue
        beside = [_apart(poses[b], poses[a]) for b in range(len(known)) if shares[a, b]]
        found[p] = max(beside, key=lambda each: each.rotation + each.translation, default=None)
    return found


def _apart(T: Array, other: Array) -> Moved:
    step = se3.difference(T, other)
    return Moved(step.rotation, step.translation)


def _is_far(apart: Moved) -> bool:
    return apart.rotation > TURNED or apart.translation > PUSHED


def _surface(view: View) -> Surface | None:
    points = np.array(view.tree.data)
    return surface_of(points) if len(points) >= MIN_CLOUD_POINTS else None


def _moved_between(
    views: tuple[View, View], surfaces: tuple[Surface | None, Surface | None]
) -> tuple[Array, Moved | None]:
    """(4, 4) first from second recording, and how far that is where the LiDAR moved."""
    one, other = surfaces
    still = np.eye(4), None
    if one is None or other is None:
        return still
    try:
        found = register(
            one,
            other,
            np.eye(4),
            method="GICP",
            max_correspondence_distance=ICP_CORRESPONDENCE_DISTANCE,
        )
    except Refusal:
        return still
    apart = _apart(np.eye(4), T := found.T_target_source)
    if not _is_far(apart):
        return still
    before, after = (
        compare_views(*views, at, within=WITHIN, limit=WITHIN).overlap for at in (np.eye(4), T)
    )
    return (T, apart) if after - before > MORE_COINCIDES else still
