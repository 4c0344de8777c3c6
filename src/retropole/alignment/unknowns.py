"""The order of all that is estimated: poses, errors of LiDARs, axes of poles, control points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import IntArray
from ..base.systematic import (
    DEVICE,
    DEVICE_KINDS,
    RADIUS,
    RADIUS_KIND,
    RING,
    RING_KINDS,
    Groups,
    Kind,
    Layout,
)

POSE = 6
"""Parameters of a pose: a rotation vector and a translation, ``[φ, δ]``."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Index of each unknown: poses, errors LiDAR by LiDAR, radius, axes, control points.

    Attributes
    ----------
    bands
        For each LiDAR, the bands of elevation that it has returns in, sorted.
    axes, control
        How many there are.
    """

    bands: tuple[IntArray, ...]
    axes: int
    control: int

    @property
    def lidars(self) -> int:
        """How many LiDARs there are."""
        return len(self.bands)

    @property
    def poses(self) -> int:
        """How many parameters all poses have: the first ones."""
        return POSE * self.lidars

    @property
    def errors(self) -> int:
        """How many errors there are: they come after the poses."""
        return sum(self._of_lidar(i) for i in range(self.lidars)) + 1

    @property
    def kept(self) -> int:
        """How many poses' parameters and errors there are."""
        return self.poses + self.errors

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return self.kept + 4 * self.axes + 3 * self.control

    def _of_lidar(self, lidar: int) -> int:
        return DEVICE + RING * len(self.bands[lidar])

    def pose(self, lidar: int) -> IntArray:
        """(6,) indices of a pose."""
        return np.asarray(POSE * lidar + np.arange(POSE))

    def device(self, lidar: int) -> IntArray:
        """(9,) indices of the errors of a whole LiDAR."""
        first = self.poses + sum(self._of_lidar(i) for i in range(lidar))
        return np.asarray(first + np.arange(DEVICE))

    def rings(self, lidar: int, kind: int, bands: IntArray) -> IntArray:
        """Indices of the errors of one of `RING_KINDS` of some of a LiDAR's bands."""
        first = int(self.device(lidar)[-1]) + 1 + kind * len(self.bands[lidar])
        return np.asarray(first + np.searchsorted(self.bands[lidar], bands))

    @property
    def radius(self) -> int:
        """Index of the error of the radius."""
        return self.kept - 1

    def axis(self, own: IntArray) -> IntArray:
        """(4 N,) indices of some axes."""
        return np.asarray((self.kept + 4 * own[:, None] + np.arange(4)).reshape(-1))

    def control_point(self, number: int) -> IntArray:
        """(3,) indices of a control point."""
        return np.asarray(self.kept + 4 * self.axes + 3 * number + np.arange(3))

    def with_bands(self, bands: Sequence[IntArray]) -> Unknowns:
        """Give the same with more bands of elevation of each LiDAR."""
        union = (np.union1d(a, b) for a, b in zip(self.bands, bands, strict=True))
        return replace(self, bands=tuple(each.astype(np.int64) for each in union))

    def places_in(self, other: Unknowns) -> IntArray:
        """(kept,) index of each pose and error among those of others with all these bands."""
        errors = [
            part
            for lidar, bands in enumerate(self.bands)
            for part in (
                other.device(lidar),
                *(other.rings(lidar, kind, bands) for kind in range(RING)),
            )
        ]
        return np.asarray(np.r_[np.arange(self.poses), *errors, other.radius])

    def of_layout(self, layout: Layout, lidars: tuple[int | None, int]) -> IntArray:
        """Indices of the errors of a pair's layout; −1 if the target is not a LiDAR (None)."""
        place = np.full(layout.size, -1)
        for side, lidar in enumerate(lidars):
            if lidar is None:
                continue
            place[layout.device(side)] = self.device(lidar)
            for kind in range(RING):
                bands = layout.bands[side]
                place[layout.rings(side, kind)] = self.rings(lidar, kind, bands)
        place[RADIUS] = self.radius
        return place

    def groups(self) -> Groups:
        """Group the errors by kind and LiDAR."""
        label = np.zeros(self.errors, dtype=np.int64)
        kinds: list[Kind] = []
        sensors: list[int | None] = []
        for lidar in range(self.lidars):
            places = [np.array([each]) for each in self.device(lidar)]
            places += [self.rings(lidar, kind, self.bands[lidar]) for kind in range(RING)]
            for place, kind in zip(places, (*DEVICE_KINDS, *RING_KINDS), strict=True):
                if not (kinds and kinds[-1] == kind and sensors[-1] == lidar):
                    kinds.append(kind)
                    sensors.append(lidar)
                label[place - self.poses] = len(kinds) - 1
        kinds.append(RADIUS_KIND)
        sensors.append(None)
        label[-1] = len(kinds) - 1
        return Groups(label, tuple(kinds), tuple(sensors))
