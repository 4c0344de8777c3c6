"""Where the poles of a site stand, placement by placement, so that they link all LiDARs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..base.datatypes import Array
from ..base.sensors import Sensor
from .arrangement import draw_poles, symmetric_poles
from .pairs import MAX_POLE_ANGLE, MIN_POLE_ANGLE
from .raycast import Cylinder
from .recording import SimulationError, poles_in_view
from .site_places import PLACES, SitePlace, is_free, stands_free

Seen = tuple[tuple[tuple[bool, ...], ...], ...]
"""``seen[placement][lidar][pole]``."""

LINKING_POLES = 2
"""Poles of one placement that two LiDARs share when they are linked: fewer determine no pose."""


def groups_of(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> list[tuple[int, ...]]:
    """LiDARs that are linked with each other, directly or through others."""
    linked = np.zeros((lidars, lidars), dtype=bool)
    for placement in np.array(seen, dtype=np.int64) if len(seen) else ():
        linked |= placement @ placement.T >= LINKING_POLES
    count, group = connected_components(linked, directed=False)
    return [tuple(np.flatnonzero(group == k).tolist()) for k in range(count)]


def are_linked(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> bool:
    """Whether all LiDARs are in one group."""
    return len(groups_of(seen, lidars)) == 1


SHARED_RETURNS = 9
"""Two LiDARs that are to be linked see a pole with so many returns of thin beams or more: half
as many again as a line needs, as noise takes some."""

NEAREST = 2.0
"""No pole stands nearer to a LiDAR, metres: it would see a piece that is too short for a line."""

FARTHEST = 12.0
"""Poles further from a LiDAR link it to no other, metres: tape is wrapped and poles are stood where
their returns are many (docs/placing.md has 2 to 8 m)."""

MAX_DRAWS = 100
"""Draws of a place before a `SimulationError`."""

MAX_SPOTS = 15
"""Draws of where the poles of one placement stand before the place is drawn anew."""

SPOT_SPREAD = 1.5
"""1 σ by which a placement misses the middle of the LiDARs that it links, metres (chosen)."""

MIN_GAP = 1.0
"""By how much a ring fails to close, metres, where pairs take the other hypothesis."""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """A place, the poles of each placement, who sees them, and who records."""

    place: SitePlace
    poles: list[tuple[Cylinder, ...]]
    seen: Seen
    recorded: list[tuple[int, ...]]


def arrange(
    kind: str,
    rng: np.random.Generator,
    sensors: tuple[Sensor, ...],
    placements: int,
    poles: int,
    radius: float,
) -> Arrangement:
    """Draw places until poles link all LiDARs."""
    for _ in range(MAX_DRAWS):
        place = PLACES[kind](rng, len(sensors))
        if not all(is_free(pose[:3, 3], place.surroundings) for pose in place.poses):
            continue
        found = (
            _place_ring(place, rng, sensors, radius)
            if kind == "ring"
            else _place_poles(place, rng, sensors, placements, poles, radius)
        )
        if found is not None:
            return found
    raise SimulationError(
        f"{MAX_DRAWS} draws of {kind!r} gave none where {placements} placements of {poles} poles "
        f"link {len(sensors)} LiDARs: give more placements, or sensors with more rings"
    )


def _view(
    place: SitePlace,
    standing: Sequence[Cylinder],
    sensors: Sequence[Sensor],
    rng: np.random.Generator,
    who: Sequence[int],
) -> tuple[tuple[bool, ...], ...]:
    """Which LiDAR sees which pole from near; those that do not record see none."""
    none = (False,) * len(standing)
    found = []
    for k, (sensor, pose) in enumerate(zip(sensors, place.poses, strict=True)):
        near = [bool(np.linalg.norm(one.centre - pose[:3, 3]) < FARTHEST) for one in standing]
        if k not in who or not any(near):
            found.append(none)
            continue
        met = poles_in_view(
            place.surroundings, standing, sensor, pose, rng.spawn(1)[0], SHARED_RETURNS
        )
        found.append(tuple(a and b for a, b in zip(met, near, strict=True)))
    return tuple(found)


def _place_poles(
    place: SitePlace,
    rng: np.random.Generator,
    sensors: tuple[Sensor, ...],
    placements: int,
    poles: int,
    radius: float,
) -> Arrangement | None:
    """Put the poles of each placement where they link LiDARs that nothing links yet."""
    at = np.array([pose[:2, 3] for pose in place.poses])
    everyone = tuple(range(len(sensors)))
    standing: list[tuple[Cylinder, ...]] = []
    seen: list[tuple[tuple[bool, ...], ...]] = []
    for left in range(placements, 0, -1):
        groups = groups_of(seen, len(sensors))
        # So many groups may remain, that each of the other placements joins an equal share.
        may_remain = 1 + (len(groups) - 1) * (left - 1) // left
        for _ in range(MAX_SPOTS):
            # Around the middle of a LiDAR and the nearest of the other groups.
            one = int(rng.integers(len(at)))
            away = [float(np.linalg.norm(own - at[one])) for own in at]
            others = [min(group, key=away.__getitem__) for group in groups if one not in group]
            others.sort(key=away.__getitem__)
            joined = [one, *others[: max(len(groups) - may_remain, 1)]]
            middle = at[joined].mean(axis=0) + rng.normal(0, SPOT_SPREAD, 2)
            middle = np.clip(middle, -np.array(place.reach), place.reach)
            new = _stand(rng, poles, middle, place, radius)
            if new is None:
                continue
            view = _view(place, new, sensors, rng, everyone)
            if len(groups_of([*seen, view], len(sensors))) <= may_remain:
                standing.append(new)
                seen.append(view)
                break
        else:
            return None
    return Arrangement(place, standing, tuple(seen), [everyone] * placements)


def _stand(
    rng: np.random.Generator, count: int, middle: Array, place: SitePlace, radius: float
) -> tuple[Cylinder, ...] | None:
    """Draw poles around a place (2,); None where this draw has none that stand free."""
    drawn = draw_poles(rng, count, (3.0, 3.0), (MIN_POLE_ANGLE, MAX_POLE_ANGLE), radius)
    if drawn is None:
        return None
    moved = tuple(replace(pole, centre=pole.centre + np.r_[middle, 0.0]) for pole in drawn)
    if _too_near(moved, place) or not all(stands_free(p, place.surroundings) for p in moved):
        return None
    return moved


def _too_near(poles: Sequence[Cylinder], place: SitePlace) -> bool:
    return any(
        np.linalg.norm(pole.centre - pose[:3, 3]) < NEAREST
        for pole in poles
        for pose in place.poses
    )


def _place_ring(
    place: SitePlace, rng: np.random.Generator, sensors: tuple[Sensor, ...], radius: float
) -> Arrangement | None:
    """Put two symmetric poles between each LiDAR and the next; None where the ring is ambiguous."""
    count = len(sensors)
    recorded: list[tuple[int, ...]] = [(k, (k + 1) % count) for k in range(count)]
    at = np.array([pose[:2, 3] for pose in place.poses])
    middles, standing, seen = [], [], []
    for pair in recorded:
        for _ in range(MAX_SPOTS):
            middle = np.r_[at[list(pair)].mean(axis=0) + rng.uniform(-1.5, 1.5, 2), 0.0]
            new = tuple(
                replace(pole, centre=pole.centre + middle) for pole in symmetric_poles(rng, radius)
            )
            view = _view(place, new, sensors, rng, pair)
            if all(all(view[k]) for k in pair) and not _too_near(new, place):
                break
        else:
            return None
        middles.append(middle[:2])
        standing.append(new)
        seen.append(view)
    if closes_otherwise(np.array(middles)):
        return None
    return Arrangement(place, standing, tuple(seen), recorded)


def closes_otherwise(axes: Array) -> bool:
    """Whether half turns about some vertical axes (N, 2), in turn, make no step of `MIN_GAP`.

    An odd number of half turns is one itself; an even number a step of twice the alternating sum.
    """
    for taken in product((False, True), repeat=len(axes)):
        chosen = axes[np.array(taken)]
        if len(chosen) and len(chosen) % 2 == 0:
            step = 2 * (chosen[::2] - chosen[1::2]).sum(axis=0)
            if np.linalg.norm(step) < MIN_GAP:
                return True
    return False
