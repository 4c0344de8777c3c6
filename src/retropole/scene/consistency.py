"""Whether what stands in a scene agrees with a pose: depth consistency, place by place.

Flat ground agrees with any pose that keeps it level, so it is left out. A place is a cube of the
rest. Under the pose, a point of it agrees where the other cloud has a point as near as the depth
tolerance; it stands in the way where the other LiDAR looked through it; else it is hidden, or out
of view, and says nothing. A place counts as one witness however many points it has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from .. import se3
from ..datatypes import Array, BoolArray, IntArray, Placement, PointCloud
from ..errors import Reason, Refusal
from ..uncertainty import Confirmation
from .patch_pairs import labels_of
from .registration import voxel_downsample
from .shifts import best_shift
from .visibility import OWN_VEHICLE, RangeImage, cells_of, range_image

VOXEL, PLACE_SIDE = 0.2, 1.0
"""Clouds are compared at one point per cube of the first side, counted in cubes of the second,
metres."""

DEPTH_TOLERANCE, RELATIVE_TOLERANCE, MAX_TOLERANCE = 0.15, 0.02, 1.0
"""Depths agree within this, metres, and this part of the range, together not more than the last."""

MAX_CONTRADICTED, MIN_AGREEING = 0.1, 40
"""A pose is confirmed where no larger share of the places denies it, and so many agree. At the
right pose of 200 hard scenes (benchmarks/hard_scenes.py, seeds below 200) the share was 0.8 % in
the median and 5.7 % at most, and 91 places or more agreed. On bare ground up to 25 agree."""

BETTER = 1.05
"""By this factor more places agree where the scene fits better: by 1.09 and more for poles carried
by 1 to 5 m along a corridor, a street or a harbor (benchmarks/deception.py, seeds 10 to 25)."""

DENIED, MIN_TOTAL = 0.2, 60
"""From this share on, of at least so many places, the scene denies a pose."""

GROUND_TRIALS, GROUND_SAMPLE = 200, 4000
"""Planes through three points that are tried for the ground, and the points that vote."""

MIN_AREA = 0.1
"""Least area that the three points span, twice, m²: fewer than three span no plane."""

GROUND_THICKNESS, GROUND_SLOPE = 0.3, 0.02
"""Points so near the ground belong to it, metres, and this part of their range: it is cambered."""


@dataclass(frozen=True, eq=False)
class Standing:
    """What stands in one LiDAR's scene, and what the LiDAR saw.

    Attributes
    ----------
    points
        (S, 3) off the ground and off the own vehicle, own frame, metres.
    place
        (S,) number of the cube that each lies in.
    tree
        Of the whole downsampled cloud.
    image
        Of the cloud as it was recorded.
    up
        (3,) normal of the ground.
    """

    points: Array
    place: IntArray
    tree: cKDTree
    image: RangeImage
    up: Array


def consistency_of(
    placements: Sequence[Placement], T: Array, rng: np.random.Generator
) -> Confirmation:
    """Count over all placements of the poles; see `consistency` and `standing_in`."""
    each = [
        _with_shift(
            standing_in(placement.target.cloud, rng), standing_in(placement.source.cloud, rng), T
        )
        for placement in placements
    ]
    return Confirmation(
        sum(one.agreeing for one in each),
        sum(one.contradicting for one in each),
        max((one.better_at for one in each if one.better_at is not None), default=None),
    )


def _with_shift(target: Standing, source: Standing, T: Array) -> Confirmation:
    """Count at a pose, and at the shift along the ground where more of the scene coincides."""
    here = consistency(target, source, T)
    shift = best_shift(target.points, source.points, target.up, T)
    if shift is None or shift.gain <= 1:
        return here
    there = consistency(target, source, se3.retract(T, np.r_[np.zeros(3), shift.step]))
    is_better = there.agreeing >= BETTER * here.agreeing
    if not is_better or there.contradicted > here.contradicted:
        return here
    return replace(here, better_at=float(np.linalg.norm(shift.step)))


def is_denied(found: Confirmation) -> bool:
    """Whether so many places deny a pose that nothing else vouches for it."""
    return found.total >= MIN_TOTAL and found.contradicted > DENIED


def check_consistency(found: Confirmation) -> None:
    """Refuse a pose that what stands in the scene denies.

    Raises
    ------
    Refusal
        ``scene_contradicts``.
    """
    is_better_elsewhere = found.better_at is not None
    if not (is_denied(found) or (is_better_elsewhere and found.total >= MIN_TOTAL)):
        return
    elsewhere = f", and it fits better {found.better_at:.1f} m away" if is_better_elsewhere else ""
    raise Refusal(
        "scene_contradicts",
        f"under the pose that the poles give, {found.contradicting} of {found.total} places off "
        f"the ground ({found.contradicted:.0%}; {DENIED:.0%} are allowed) stand where the other "
        f"LiDAR looked through{elsewhere}: did a pole move between the recordings, or are they of "
        "two placements?",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "contradicted": found.contradicted,
            "allowed": DENIED,
            **({} if found.better_at is None else {"better_at_m": found.better_at}),
        },
    )


def unconfirmed(found: Confirmation, poles: int, placements: int) -> Iterator[Reason]:
    """Warn where the scene does not confirm the pose.

    Where it has too little to say, a third pole or a second placement confirms it as well: two
    poles that were carried or leaned fit any pose that they are given.
    """
    is_denied = found.contradicted > MAX_CONTRADICTED and found.total >= MIN_TOTAL
    if not is_denied and (found.agreeing >= MIN_AGREEING or poles > 2 or placements > 1):
        return
    yield Reason(
        "not_confirmed",
        f"{found.agreeing} places off the ground agree with this pose and {found.contradicting} "
        f"deny it; {MIN_AGREEING} must agree, and {MAX_CONTRADICTED:.0%} of all may deny it, to "
        "confirm what the poles say: add a third pole or a second placement, or stand boxes or a "
        "car in view of both LiDARs",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "needed": MIN_AGREEING,
            "allowed": MAX_CONTRADICTED,
        },
    )


def standing_in(cloud: PointCloud, rng: np.random.Generator) -> Standing:
    """Prepare a cloud; the random numbers choose the planes that are tried for the ground."""
    points = voxel_downsample(cloud.xyz, VOXEL)
    ranges = np.linalg.norm(points - cloud.origin, axis=1)
    on_ground, up = _ground(points, ranges, rng)
    standing = points[(ranges > OWN_VEHICLE) & ~on_ground]
    place = labels_of(np.floor(standing / PLACE_SIDE)) if len(standing) else np.zeros(0, np.int64)
    return Standing(standing, place, cKDTree(points), range_image(cloud), up)


def _ground(points: Array, ranges: Array, rng: np.random.Generator) -> tuple[BoolArray, Array]:
    """Which points lie on the plane that most of a sample lies on, and its normal (3,)."""
    sample = points[:: 1 + len(points) // GROUND_SAMPLE]
    if len(sample) < 3:
        return np.zeros(len(points), dtype=bool), np.array([0.0, 0.0, 1.0])
    a, b, c = (sample[rng.integers(len(sample), size=GROUND_TRIALS)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(area, MIN_AREA)[:, None]
    height = sample @ normals.T - np.einsum("ij,ij->i", a, normals)
    votes = np.count_nonzero(np.abs(height) < DEPTH_TOLERANCE, axis=0)
    best = int(np.argmax(np.where(area > MIN_AREA, votes, -1)))
    own = np.abs((points - a[best]) @ normals[best])
    return np.asarray(own < GROUND_THICKNESS + GROUND_SLOPE * ranges), normals[best]


def consistency(target: Standing, source: Standing, T: Array) -> Confirmation:
    """Count the places of both clouds that agree with a pose (4, 4), target from source."""
    there = _votes(target, source, T)
    back = _votes(source, target, se3.inverse(T))
    return Confirmation(there[0] + back[0], there[1] + back[1])


def contradicting_points(target: Standing, source: Standing, T: Array) -> tuple[Array, Array]:
    """Find the points that stand where the other LiDAR looked through, in places that deny a pose.

    Parameters
    ----------
    target, source
        What stands in the scene of each.
    T
        (4, 4) target from source.

    Returns
    -------
    tuple of Array
        (N, 3) of the target and (M, 3) of the source, each in its own frame, metres.
    """
    found = []
    for seer, other, pose in ((source, target, se3.inverse(T)), (target, source, T)):
        in_the_way, yes, no = _judged(seer, other, pose)
        found.append(other.points[in_the_way & (no > yes)[other.place]])
    return found[0], found[1]


class _Judged(NamedTuple):
    """Which points stand in the way, and how many of each place agree and stand in the way."""

    in_the_way: BoolArray
    yes: IntArray
    no: IntArray


def _judged(seer: Standing, other: Standing, T: Array) -> _Judged:
    """Hold the points of the other cloud against what the seer saw."""
    moved = se3.apply(T, other.points)
    rays = moved - seer.image.origin
    ranges = np.linalg.norm(rays, axis=1)
    tolerance = np.minimum(DEPTH_TOLERANCE + RELATIVE_TOLERANCE * ranges, MAX_TOLERANCE)
    agrees = seer.tree.query(moved, distance_upper_bound=MAX_TOLERANCE)[0] < tolerance
    cells = cells_of(rays)
    nearest = seer.image.nearest
    in_the_way = ~agrees & nearest.seen[cells] & (nearest.ranges[cells] > ranges + tolerance)
    count = int(other.place.max()) + 1 if len(other.place) else 0
    yes = np.bincount(other.place[agrees], minlength=count)
    no = np.bincount(other.place[in_the_way], minlength=count)
    return _Judged(in_the_way, yes, no)


def _votes(seer: Standing, other: Standing, T: Array) -> tuple[int, int]:
    """How many places of the other cloud agree with what the seer saw, and how many deny it."""
    _, yes, no = _judged(seer, other, T)
    return int(np.count_nonzero((yes > 0) & (yes >= no))), int(np.count_nonzero(no > yes))
