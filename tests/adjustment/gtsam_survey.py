"""What was surveyed, as factors of GTSAM; each residual is derived by differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from retropole.adjustment.site import Adjusted
from retropole.alignment.posterior import JointState
from retropole.alignment.survey import Surveyed
from retropole.base.datatypes import Array
from tests.adjustment.gtsam_variables import (
    POSE,
    Coordinates,
    Variable,
    coordinates_of,
    linear,
    moved,
)


def of_survey(
    adjusted: Adjusted, variables: Sequence[Variable], as_they_are: bool
) -> list[gtsam.CustomFactor]:
    """Residuals of surveyed ends, control points and inertial sensors, each over its 1 σ."""
    network = adjusted.network
    state, lidars = network.state, network.unknowns.lidars
    first_axis = 2 * lidars + 1
    first_point = first_axis + network.unknowns.axes
    found = []
    for which, residual in _residuals(adjusted.datum.surveyed, state):
        own = [
            variables[{"pose": 0, "axis": first_axis, "point": first_point}[kind] + number]
            for kind, number in which
        ]
        coordinates = [
            coordinates_of(one, number, state) for one, (_, number) in zip(own, which, strict=True)
        ]
        sizes = [one.place.stop - one.place.start for one in own]
        zero = np.zeros(sum(sizes))
        keys = [one.key for one in own]
        if as_they_are:
            found.append(_curved(keys, coordinates, sizes, residual))
            continue
        rows = np.split(_derivative(residual, zero), np.cumsum(sizes)[:-1], axis=1)
        parts = [([k], c, r) for k, c, r in zip(keys, coordinates, rows, strict=True)]
        found.append(linear(parts, residual(zero)))
    return found


def _curved(
    keys: Sequence[int],
    coordinates: Sequence[Coordinates],
    sizes: Sequence[int],
    residual: Callable[[Array], Array],
) -> gtsam.CustomFactor:
    """A residual that is any function of coordinates."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        parts = [each(values) for each in coordinates]
        z = np.concatenate([value for value, _ in parts])
        if H is not None:
            rows = np.split(_derivative(residual, z), np.cumsum(sizes)[:-1], axis=1)
            for k, (own, part) in enumerate(zip(rows, parts, strict=True)):
                H[k] = own @ part[1][0]
        return residual(z)

    size = len(residual(np.zeros(sum(sizes))))
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), list(keys), error)


def _derivative(residual: Callable[[Array], Array], at: Array) -> Array:
    """By central differences of fourth order."""
    columns = []
    for way in 1e-3 * np.eye(len(at)):
        near = residual(at + way) - residual(at - way)
        far = residual(at + 2 * way) - residual(at - 2 * way)
        columns.append((8 * near - far) / 12e-3)
    return np.stack(columns, axis=1)


def _residuals(
    surveyed: Surveyed, state: JointState
) -> list[tuple[list[tuple[str, int]], Callable[[Array], Array]]]:
    """What each is a function of, and the residual by their steps from the state."""
    tangents = state.of(0, np.arange(len(state.points))).tangents
    found: list[tuple[list[tuple[str, int]], Callable[[Array], Array]]] = []

    def turned(lidar: int, step: Array) -> gtsam.Pose3:
        return moved(gtsam.Pose3(state.T[lidar]), step)

    for end in surveyed.ends:
        # The same for all coordinates in what is compared.
        (own,) = {*np.broadcast_to(end.sigma, 3).tolist()}

        def across(step: Array, k: int = end.axis, at: Array = end.at, s: float = own) -> Array:
            B = tangents[k]
            line = state.directions[k] + B @ step[2:]
            line = line / np.linalg.norm(line)
            away = at - state.points[k] - B @ step[:2]
            return np.asarray(B.T @ (away - (away @ line) * line) / s)

        found.append(([("axis", end.axis)], across))
    for q, known in enumerate(surveyed.known):

        def stated(
            step: Array, q: int = q, at: Array = known.at, s: Array | float = known.sigma
        ) -> Array:
            return np.asarray((state.control[q] + step - at) / s)

        found.append(([("point", q)], stated))
    for seen in surveyed.seen:

        def sighted(
            step: Array,
            i: int = seen.lidar,
            q: int = seen.point,
            at: Array = seen.at,
            s: float = seen.sigma,
        ) -> Array:
            return np.asarray(
                (turned(i, step).transformFrom(at) - state.control[q] - step[POSE:]) / s
            )

        found.append(([("pose", seen.lidar), ("point", seen.point)], sighted))
    for up in surveyed.up:

        def level(
            step: Array, i: int = up.lidar, way: Array = up.direction, s: float = up.sigma
        ) -> Array:
            return np.asarray(turned(i, step).rotation().rotate(way)[:2] / s)

        found.append(([("pose", up.lidar)], level))
    return found
