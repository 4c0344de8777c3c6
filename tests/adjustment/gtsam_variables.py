"""What GTSAM adjusts: poses, errors, axes and points; and residuals of coordinates of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, C, E, L, R

from retropole.adjustment.site import Adjusted
from retropole.alignment.posterior import JointState
from retropole.base.datatypes import Array, BoolArray

POSE, AXIS, POINT = 6, 4, 3

Coordinates = Callable[[gtsam.Values], tuple[Array, list[Array]]]
"""Some coordinates (N,) of variables, and their derivative by GTSAM's step of each (N, dim)."""

Pose = Callable[[gtsam.Values], tuple[gtsam.Pose3, Array]]
"""A pose, and its derivative (6, dim) in GTSAM's steps by that of its variable."""


@dataclass(frozen=True, eq=False)
class Variable:
    """One of GTSAM's: its key, and where it stands among all unknowns; of a LiDAR its pose."""

    key: int
    place: slice
    pose: Pose | None = None


def variables_of(adjusted: Adjusted) -> list[Variable]:
    """All variables, in the order of the unknowns."""
    unknowns = adjusted.network.unknowns
    sizes = [(L(i), POSE) for i in range(unknowns.lidars)]
    ends = [int(unknowns.device(i)[0]) for i in range(1, unknowns.lidars)] + [unknowns.radius]
    for i, last in enumerate(ends):
        sizes.append((E(i), last - int(unknowns.device(i)[0])))
    sizes.append((R(0), 1))
    sizes += [(A(k), AXIS) for k in range(unknowns.axes)]
    sizes += [(C(q), POINT) for q in range(unknowns.control)]
    stops = np.cumsum([size for _, size in sizes])
    assert stops[-1] == unknowns.size
    poses = [
        _whole(L(i)) if free.all() or not free.any() else _in_part(L(i), adjusted.end.T[i], free)
        for i, free in enumerate(freedom_of(adjusted))
    ]
    return [
        Variable(key, slice(int(stop) - size, int(stop)), poses[k] if k < len(poses) else None)
        for k, ((key, size), stop) in enumerate(zip(sizes, stops, strict=True))
    ]


def freedom_of(adjusted: Adjusted) -> BoolArray:
    """(L, 6) what of each pose is estimated."""
    return adjusted.network.free.reshape(-1, POSE)


def _whole(key: int) -> Pose:
    return lambda values: (values.atPose3(key), np.eye(POSE))


def _in_part(key: int, about: Array, free: BoolArray) -> Pose:
    """Make a pose of what is free of its step [φ, δ] from a pose (4, 4)."""
    first = gtsam.Pose3(about)

    def found(values: gtsam.Values) -> tuple[gtsam.Pose3, Array]:
        step = np.zeros(POSE)
        step[free] = values.atVector(key)
        pose = moved(first, step)
        return pose, np.asarray(np.linalg.inv(away(first, pose)[1])[:, free])

    return found


def moved(first: gtsam.Pose3, step: Array) -> gtsam.Pose3:
    turn = gtsam.Rot3.Expmap(step[:3]).compose(first.rotation())
    return gtsam.Pose3(turn, first.translation() + step[3:6])


def away(first: gtsam.Pose3, now: gtsam.Pose3) -> tuple[Array, Array]:
    """[φ, δ] from one pose to another, and its derivative by GTSAM's step of the other."""
    phi = gtsam.Rot3.Logmap(now.rotation().compose(first.rotation().inverse()))
    # GTSAM turns and shifts in the axes of the LiDAR.
    turn = now.rotation().matrix()
    J = np.zeros((POSE, POSE))
    J[:3, :3] = np.linalg.solve(gtsam.so3.DexpFunctor(phi).leftJacobian(), turn)
    J[3:, 3:] = turn
    return np.r_[phi, now.translation() - first.translation()], J


def pose_step(pose: Pose, start: Array) -> Coordinates:
    """[φ, δ] from a pose (4, 4), with ``R = Exp(φ) R₀`` and ``t = t₀ + δ``."""
    first = gtsam.Pose3(start)

    def found(values: gtsam.Values) -> tuple[Array, list[Array]]:
        now, by_variable = pose(values)
        step, by_pose = away(first, now)
        return step, [by_pose @ by_variable]

    return found


def relative_step(one: Pose, other: Pose, start: Array) -> Coordinates:
    """[φ, δ] of T_i⁻¹ T_j from a relative pose (4, 4)."""
    first = gtsam.Pose3(start)

    def found(values: gtsam.Values) -> tuple[Array, list[Array]]:
        by_i, by_j = (np.zeros((POSE, POSE), order="F") for _ in range(2))
        (T_i, of_i), (T_j, of_j) = one(values), other(values)
        step, J = away(first, T_i.between(T_j, by_i, by_j))
        return step, [J @ by_i @ of_i, J @ by_j @ of_j]

    return found


def vector_of(key: int) -> Coordinates:
    def found(values: gtsam.Values) -> tuple[Array, list[Array]]:
        vector = np.asarray(values.atVector(key))
        return vector, [np.eye(len(vector))]

    return found


def coordinates_of(one: Variable, number: int, state: JointState) -> Coordinates:
    """Of a pose its step from the state, of all others their values."""
    return vector_of(one.key) if one.pose is None else pose_step(one.pose, state.T[number])


def linear(
    parts: Sequence[tuple[Sequence[int], Coordinates, Array]], constant: Array
) -> gtsam.CustomFactor:
    """Residuals of 1 σ that are linear in coordinates: Σ rows·coordinates + constant."""
    keys = [key for own, _, _ in parts for key in own]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        total, at = constant.copy(), 0
        for own, coordinates, rows in parts:
            value, derivatives = coordinates(values)
            total += rows @ value
            for derivative in derivatives:
                if H is not None:
                    H[at] = rows @ derivative
                at += 1
            assert len(derivatives) == len(own)
        return total

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(constant)), keys, error)


def of_unknowns(
    rows: Array, constant: Array, variables: Sequence[Variable], state: JointState
) -> gtsam.CustomFactor:
    """Residuals ``rows z + constant`` with rows (M, Z) over all unknowns."""
    parts = []
    for k, one in enumerate(variables):
        own = rows[:, one.place]
        if own.any():
            parts.append(([one.key], coordinates_of(one, k, state), own))
    return linear(parts, constant)
