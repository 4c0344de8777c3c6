"""Which contradictions of a simulated site the rest of its observations can check.

The rule knows the truth, who sees what and the stated σ, and nothing of what a calibration says.

Poles' ends and control points are seen by LiDARs whose poses are free, each end across its pole and
each point in all directions to `SEEN`, and are surveyed as is stated. Whoever sees a pole is taken
to see it from foot to top. Surroundings count for nothing. A contradiction moves some of these
values by a known vector. It is *checkable* where

- all others leave of that vector, after everything unknown has been fitted, a χ² that a test at the
  level of the calibration's own (w of 6.5, and 7 for each degree of freedom) finds with a power of
  80 % (Baarda 1968), and
- no other single contradiction, that has another name and as many degrees of freedom at most,
  explains it as well: it leaves 25 of χ² (5 σ) more.

A contradiction is an error of a control point, an end or a surveyed pole, a pole that stands
elsewhere for some of the LiDARs that see it, and a recording of a LiDAR that stood elsewhere. Four
are judged otherwise:

- a LiDAR that turns between two placements: it has a recording of both, whose surroundings stand
  still, and a turn of 1° moves what is 5 m away by 9 cm;
- coordinates of a survey, or a part of it, that are mirrored, exchanged or in another unit: they
  leave enough where all that is written is laid on what is true as a rigid body;
- swapped recordings: each shows two poles that another LiDAR sees, and the others link all LiDARs
  without both (`Blunder.checked`);
- the diameter for the radius: the width of the poles tells it, by the returns from their edges. It
  is known by the azimuth step, and to a fifth of the beam's footprint, of each LiDAR at each pole;
  the least difference that the test at 3 σ finds with a power of 80 % is below the radius.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, chndtr, ndtr

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import SurveyedPole
from retropole.base.systematic import STATED_WIDTH
from retropole.simulation.sites import SimulatedSite

SEEN = 0.005
"""1 σ of what a LiDAR sees of an end of a pole across it, and of a control point, metres: what the
simulation states of control points."""

LEVEL, PER_FREEDOM, POWER = 6.5, 7.0, 0.8
"""Of the calibration's tests, w and χ² for each degree of freedom; and of detection."""

SEPARABLE = 25.0
"""χ² by which no other contradiction explains it as well: 5 σ, as in `site_blunders`."""

RADIUS_LEVEL = 3.0
"""Of the calibration's test of the radius, σ."""

LEAST = 1e-9
"""Part of an error's own information below which the others say nothing of it."""


@dataclass(frozen=True)
class Error:
    """A contradiction: its name, which of the values it may change, and together if `common`.

    `columns` (N, F) are the values by its parameters.
    """

    name: str
    columns: Array

    @property
    def freedom(self) -> int:
        """How many parameters it has."""
        return int(self.columns.shape[1])


@cache
def least_found(freedom: int) -> float:
    """Noncentrality of a χ² that the test finds with the power asked for."""
    limit = max(float(chdtri(freedom, 2.0 * ndtr(-LEVEL))), PER_FREEDOM * freedom)
    return float(brentq(lambda size: 1.0 - chndtr(limit, freedom, size) - POWER, 1.0, 1e4))


@dataclass(frozen=True)
class Value:
    """A value that is observed: of what, by whom, and its row of the design (each whitened).

    `pole` is placement and number, `point` a number, `lidar` None of the survey.
    """

    lidar: int | None
    pole: tuple[int, int] | None
    end: int | None
    point: int | None
    at: Array
    across: Array
    sigma: float


class Design:
    """What is observed of a site, linearised about the truth."""

    def __init__(self, site: SimulatedSite) -> None:
        self.site = site
        self.values = list(_values(site))
        count = len(site.T_world_lidar)
        places = {_place(one): None for one in self.values}
        first = dict(zip(places, 6 * count + 3 * np.arange(len(places)), strict=True))
        rows = []
        for one in self.values:
            row = np.zeros((len(one.across), 6 * count + 3 * len(places)))
            if one.lidar is not None:
                arm = one.at - site.T_world_lidar[one.lidar][:3, 3]
                turn = np.hstack([-se3.hat(arm), np.eye(3)])
                row[:, 6 * one.lidar : 6 * one.lidar + 6] = one.across @ turn
                row[:, first[_place(one)] :][:, :3] = -one.across
            else:
                row[:, first[_place(one)] :][:, :3] = one.across
            rows.append(row / one.sigma)
        A = np.concatenate(rows)
        self.starts = np.cumsum([0, *(len(one.across) for one in self.values)])
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        self.fitted = U[:, s > 1e-8 * s[0]]

    def left(self, moved: Array) -> Array:
        """Take off what the unknowns fit of changes (N, ...) of the values."""
        return np.asarray(moved - self.fitted @ (self.fitted.T @ moved))

    def whitened(self, by_value: dict[int, Array]) -> Array:
        """(N, F) of changes (3, F) of some values, metres in the world."""
        width = next(iter(by_value.values())).shape[1]
        moved = np.zeros((self.starts[-1], width))
        for k, change in by_value.items():
            one = self.values[k]
            moved[self.starts[k] : self.starts[k + 1]] = one.across @ change / one.sigma
        return moved

    def errors(self) -> Iterator[Error]:
        """All single contradictions that are thought of."""
        own = [(k, one) for k, one in enumerate(self.values)]
        for q, point in enumerate(self.site.true_points):
            some = [k for k, one in own if one.point == q and one.lidar is None]
            yield self._free(point.name, some)
            for lidar in range(len(self.site.names)):
                some = [k for k, one in own if one.point == q and one.lidar == lidar]
                if some:
                    yield self._free(point.name, some)
        for each in self.site.true_surveyed:
            some = [k for k, one in own if one.pole == _index(each) and one.lidar is None]
            for k in some:
                yield self._free(each.name, [k])
            if some:
                yield self._free(each.name, some)
        for p, k in sorted({one.pole for one in self.values if one.pole is not None}):
            who = sorted(
                {one.lidar for _, one in own if one.pole == (p, k) and one.lidar is not None}
            )
            for size in range(1, len(who)):
                for part in combinations(who, size):
                    yield self._common(pole_name(p, k), (p, k), part)
        for lidar in range(len(self.site.names)):
            for p in range(len(self.site.poles)):
                some = [k for k, one in own if one.lidar == lidar and one.pole and one.pole[0] == p]
                if some:
                    yield Error(self.site.names[lidar], self._turned(some, lidar))

    def _free(self, name: str, some: Sequence[int]) -> Error:
        """Each of some values for itself."""
        columns = np.zeros((self.starts[-1], sum(len(self.values[k].across) for k in some)))
        first = 0
        for k in some:
            size = len(self.values[k].across)
            columns[self.starts[k] : self.starts[k + 1], first : first + size] = np.eye(size)
            first += size
        return Error(name, columns)

    def _common(self, name: str, pole: tuple[int, int], part: Sequence[int | None]) -> Error:
        """A pole that stands elsewhere for some LiDARs."""
        columns = np.zeros((self.starts[-1], 4))
        for k, one in enumerate(self.values):
            if one.pole == pole and one.lidar in part:
                assert one.end is not None
                columns[self.starts[k] : self.starts[k + 1], 2 * one.end : 2 * one.end + 2] = (
                    np.eye(2)
                )
        return Error(name, columns)

    def _turned(self, some: Sequence[int], lidar: int) -> Array:
        """A LiDAR that stood elsewhere, for some of its values."""
        at = self.site.T_world_lidar[lidar][:3, 3]
        by_value = {k: np.hstack([-se3.hat(self.values[k].at - at), np.eye(3)]) for k in some}
        return self.whitened(by_value)

    def is_checkable(self, name: str, moved: Array) -> bool:
        """Whether a change (N, 1) of the values by something of a name is found, and told."""
        left = self.left(moved)[:, 0]
        own: list[tuple[float, int]] = []
        rivals: list[tuple[float, int]] = []
        for error in self.errors():
            explained = _explained(self.left(error.columns), error.columns, left)
            (own if error.name == name else rivals).append((explained, error.freedom))
        size = float(left @ left)
        own = [(chi2, freedom) for chi2, freedom in own if chi2 > 0.99 * size]
        if not own:
            return False
        freedom = min(freedom for _, freedom in own)
        if size < least_found(freedom):
            return False
        return all(size - chi2 > SEPARABLE for chi2, other in rivals if other <= freedom)


def pole_name(placement: int, pole: int) -> str:
    """Call a pole that stands elsewhere for some LiDARs."""
    return f"pole {pole + 1} of placement {placement + 1}"


def _explained(left: Array, whole: Array, of: Array) -> float:
    """How much of a χ² an error's parameters explain."""
    normal = left.T @ left
    size, way = np.linalg.eigh(normal)
    told = size > LEAST * np.diag(whole.T @ whole).max()
    along = way[:, told].T @ (left.T @ of)
    return float(np.sum(along**2 / size[told]))


def _place(one: Value) -> tuple[object, ...]:
    return one.pole, one.end, one.point


def _index(each: SurveyedPole) -> tuple[int, int]:
    """Placement and number of a surveyed pole, as the simulation names them."""
    return each.placement, int(each.name.split("-")[1]) - 1


def _values(site: SimulatedSite) -> Iterator[Value]:
    surveyed = {_index(each): each for each in site.true_surveyed}
    for p, poles in enumerate(site.poles):
        for k, pole in enumerate(poles):
            _, _, Vt = np.linalg.svd(pole.axis[None])
            who = [i for i, own in enumerate(site.seen[p]) if own[k]]
            for end, sign in enumerate((-1.0, 1.0)):
                at = pole.centre + sign * pole.length / 2 * pole.axis
                for lidar in who:
                    yield Value(lidar, (p, k), end, None, at, Vt[1:], SEEN)
                if who and (p, k) in surveyed:
                    sigma = surveyed[p, k].sigma
                    yield Value(None, (p, k), end, None, at, Vt[1:], sigma)
    for q, point in enumerate(site.true_points):
        for sight in point.seen:
            yield Value(sight.lidar, None, None, q, point.at, np.eye(3), sight.sigma)
        yield Value(None, None, None, q, point.at, np.eye(3), point.sigma)


def survey_is_checkable(site: SimulatedSite, name: str, offsets: Array) -> bool:
    """Whether a point, or both ends of a pole (2, 3), that are off by so much are."""
    design = Design(site)
    points = [k for k, point in enumerate(site.points) if point.name == name]
    poles = [_index(each) for each in site.surveyed if each.name == name]
    moved = {}
    for k, one in enumerate(design.values):
        if one.lidar is None and (one.point in points or one.pole in poles):
            moved[k] = offsets[one.end or 0][:, None]
    return bool(moved) and design.is_checkable(name, design.whitened(moved))


def placement_is_checkable(site: SimulatedSite, name: str) -> bool:
    """Whether a surveyed pole is that is taken for the nearest of the other placement."""
    each = next(own for own in site.true_surveyed if own.name == name)
    assert each.foot is not None
    assert each.top is not None
    ends = np.array([each.foot, each.top])
    off = []
    for pole in site.poles[1 - each.placement]:
        away = pole.centre - ends
        off.append(away - np.outer(away @ pole.axis, pole.axis))
    nearest = min(off, key=lambda one: float(np.linalg.norm(one, axis=1).max()))
    return survey_is_checkable(site, name, nearest)


def coordinates_are_checkable(true: Sequence[Array], written: Sequence[Array]) -> bool:
    """Whether points (3,) that are written otherwise are, as those of a rigid body."""
    a, b = np.array(true), np.array(written)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    chi2 = float(np.sum((b @ R.T - a) ** 2)) / (2 * SEEN**2)
    return chi2 > least_found(max(a.size - 6, 1))


def pole_is_checkable(
    site: SimulatedSite, pole: tuple[int, int], lidars: Sequence[int], T: Array
) -> bool:
    """Whether a pole (placement and number) is that some LiDARs saw moved by (4, 4)."""
    design = Design(site)
    moved = {
        k: (se3.apply(T, one.at[None])[0] - one.at)[:, None]
        for k, one in enumerate(design.values)
        if one.pole == pole and one.lidar in lidars
    }
    return bool(moved) and design.is_checkable(pole_name(*pole), design.whitened(moved))


def lidar_is_checkable(site: SimulatedSite, lidar: int) -> bool:
    """Whether a LiDAR is that turns between the placements."""
    return all(cloud is not None for cloud in site.clouds[lidar])


def radius_is_checkable(site: SimulatedSite) -> bool:
    """Whether the diameter for the radius is."""
    precision = 0.0
    for p, poles in enumerate(site.poles):
        for lidar, (pose, sensor) in enumerate(zip(site.T_world_lidar, site.sensors, strict=True)):
            for k, pole in enumerate(poles):
                if not site.seen[p][lidar][k]:
                    continue
                away = float(np.linalg.norm(pole.centre - pose[:3, 3]))
                ends = [pole.centre + s * pole.length / 2 * pole.axis for s in (-1.0, 1.0)]
                own = se3.apply(se3.inverse(pose), np.array(ends))
                low, high = sorted(np.arctan2(own[:, 2], np.linalg.norm(own[:, :2], axis=1)))
                rings = int(np.sum((sensor.elevations > low) & (sensor.elevations < high)))
                if rings:
                    # Two edges of each ring, each known within a step.
                    edge = sensor.azimuth_step * away / np.sqrt(24 * rings)
                    footprint = STATED_WIDTH * sensor.divergence * away / 2
                    precision += 1.0 / (edge**2 + footprint**2)
    z = float(brentq(lambda x: ndtr(x) - POWER, 0.0, 5.0))
    return bool(site.radius * np.sqrt(precision) > RADIUS_LEVEL + z)
