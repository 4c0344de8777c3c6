"""Which poles that the LiDARs see are one: those that lie on one line under the chosen poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..alignment.maximum import Sight
from ..alignment.observations import beams_of
from ..base import se3
from ..base.datatypes import Array, Pole
from ..base.description import Site
from ..hypotheses.scans import SiteScans

SAME_DISTANCE, SAME_ANGLE = 0.5, np.radians(10.0)
"""Two poles are one if their middles lie within this distance of each other's line, metres, and
their directions differ by no more, rad. Poses that poles of one placement give are off by up to
`AGREE_DISTANCE`, poles are 1.2 m or more from each other (simulation.scenes); a pole that was
bumped is still the same."""


@dataclass(frozen=True, eq=False)
class SharedPole:
    """One pole in one placement, and each LiDAR's returns on it.

    Attributes
    ----------
    placement
        Index of the placement.
    number
        Of the pole in its placement, from 1.
    seen
        From the index of the LiDAR to the pole as it sees it, about its beam origin.
    point, direction
        (3,) the axis in the frame of the site, roughly.
    extent
        (2, 3) the ends of the part that any LiDAR saw, on that axis.
    surveyed
        Index in `Site.poles`; None if it was not surveyed.
    """

    placement: int
    number: int
    seen: dict[int, Pole]
    point: Array
    direction: Array
    extent: Array
    surveyed: int | None = None

    @property
    def length(self) -> float:
        """Between the ends of what was seen, metres."""
        return float(np.linalg.norm(self.extent[1] - self.extent[0]))

    def name(self, site: Site) -> str:
        """What it is called."""
        if self.surveyed is not None:
            return site.poles[self.surveyed].name
        return f"pole {self.number} of placement {site.placements[self.placement]}"


def shared_poles(scans: SiteScans, poses: dict[int, Array], radius: float) -> list[SharedPole]:
    """Put together what the LiDARs see under their poses.

    Parameters
    ----------
    scans
        Of all LiDARs.
    poses
        From the index of a LiDAR to its pose (4, 4), site from beam origin.
    radius
        Of the poles, metres.

    Returns
    -------
    list of SharedPole
        Those that two LiDARs or more see, and those that one sees: a surveyor may know them.
    """
    found: list[SharedPole] = []
    for placement in range(len(scans.by_lidar[0])):
        here: list[SharedPole] = []
        for lidar, T in poses.items():
            for pole in scans.poles(lidar, placement):
                _add(here, placement, lidar, pole, T, radius)
        found += here
    return found


def same_poles(one: Sequence[SharedPole], other: Sequence[SharedPole]) -> bool:
    """Whether the same returns are combined, wherever the poles are."""

    def together(poles: Sequence[SharedPole]) -> set[frozenset[tuple[int, int]]]:
        return {frozenset((i, id(seen)) for i, seen in pole.seen.items()) for pole in poles}

    return together(one) == together(other)


def _add(
    here: list[SharedPole], placement: int, lidar: int, pole: Pole, T: Array, radius: float
) -> None:
    """Add a pole to the one that it is, or as another one."""
    point = se3.apply(T, (pole.point + _behind(pole, radius))[None])[0]
    direction = T[:3, :3] @ pole.direction
    extent = extent_of(point, direction, se3.apply(T, pole.xyz))
    gaps = [
        max(
            _distance(point, each.point, each.direction),
            _distance(each.point, point, direction),
        )
        for each in here
    ]
    for k in np.argsort(gaps):
        each = here[k]
        near = gaps[k] <= SAME_DISTANCE
        if near and lidar not in each.seen and _angle(direction, each.direction) <= SAME_ANGLE:
            # The better one is seen, the nearer its line runs to the axis.
            better = len(pole.xyz) > max(len(one.xyz) for one in each.seen.values())
            point, direction = (point, direction) if better else (each.point, each.direction)
            here[k] = replace(
                each,
                seen={**each.seen, lidar: pole},
                point=point,
                direction=direction,
                extent=extent_of(point, direction, np.concatenate([each.extent, extent])),
            )
            return
    here.append(SharedPole(placement, len(here) + 1, {lidar: pole}, point, direction, extent))


def extent_of(point: Array, direction: Array, xyz: Array) -> Array:
    """(2, 3) ends of points (N, 3) along an axis."""
    along = (xyz - point) @ direction
    return np.asarray(point + np.array([[along.min()], [along.max()]]) * direction)


def _behind(pole: Pole, radius: float) -> Array:
    """From a line through returns, on average in front of the axis, to the axis, metres."""
    away = pole.point - (pole.point @ pole.direction) * pole.direction
    return np.asarray(np.pi / 4 * radius * away / max(float(np.linalg.norm(away)), 1e-9))


def _distance(point: Array, on: Array, direction: Array) -> float:
    return float(np.linalg.norm(np.cross(point - on, direction)))


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), abs(one @ other)))


def sights_of(scans: SiteScans, poles: Sequence[SharedPole]) -> list[Sight]:
    """Turn the returns of each LiDAR on the poles of all placements into beams."""
    sights = []
    for lidar in range(len(scans.by_lidar)):
        own = [k for k, pole in enumerate(poles) if lidar in pole.seen]
        if not own:
            continue
        seen = []
        for k in own:
            scan = scans.by_lidar[lidar][poles[k].placement]
            assert scan is not None
            seen.append((poles[k].seen[lidar], scan.cloud))
        sensor = next(scan.sensor for scan in scans.used(lidar))
        sights.append(Sight(lidar, beams_of(seen, sensor), np.array(own, dtype=np.int64)))
    return sights
