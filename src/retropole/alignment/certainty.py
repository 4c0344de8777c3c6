"""How sure a pose is: what the scatter says, what the instruments allow, and unmodelled errors.

The poses x and the errors b are estimated together, with information ``H`` (all of x and b, the
prior ``B⁻¹`` of the errors among it). An error b moves the estimate by ``−[H⁻¹]_xb B⁻¹ b``: what
the data show of it is taken out, the rest passes into the pose. See docs/method.md, Certainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri, fdtri

from ..base import se3
from ..base.datatypes import Array, BoolArray
from ..base.systematic import Groups
from ..base.uncertainty import BudgetEntry, Uncertainty, floor, predicted_error
from .error_sizes import CONSIDERED
from .factor import PoleFactor
from .unknowns import POSE

FLOOR = "unmodelled errors"
"""What the budget calls that: nothing makes it smaller."""

POLES = "scatter of the poles' returns"
"""What it calls that."""

DEPTH = "depth of the poles"
"""What it calls what all returns of a LiDAR on one pole share."""

SWAY = "sway while it recorded"
"""What it calls what is left of that."""

BUDGET_RANGE = 30.0
"""Range at which shares of the budget are told, metres."""

SIDES: tuple[Literal["target"], Literal["source"]] = ("target", "source")
"""What the LiDARs of a pair are called."""

CONFIDENCE, SIGNIFICANT = 0.95, 0.99
"""Share of the errors that stated regions hold; share of chance up to which it may be chance."""


def chi2_limit(freedom: float, share: float = SIGNIFICANT) -> float:
    """χ² with some degrees of freedom that a share of chance is below."""
    return float(chdtri(freedom, 1.0 - share))


@dataclass(frozen=True, eq=False)
class Part:
    """One source of error, and its part in the covariance of all poses.

    Attributes
    ----------
    name, lidar
        What errs, and which LiDAR's; None where it is no single LiDAR's.
    sigma, unit
        1 σ of the error itself; None of what is no single quantity.
    estimated
        The error as the data have it; None where it is not estimated or is not one number.
    root
        (6 L, R): the part is ``root rootᵀ``.
    is_random
        Whether recording again draws it again.
    """

    name: str
    lidar: int | None
    sigma: float | None
    unit: str
    estimated: float | None
    root: Array
    is_random: bool = False


@dataclass(frozen=True, eq=False)
class FactorEstimate:
    """Steps (6 L,) of all poses, errors (B,), and the inverse (K, K) of the information of both,
    zero where the datum holds a pose.
    """

    steps: Array
    errors: Array
    inverse: Array


def solve_factor(factor: PoleFactor, precision: Array) -> FactorEstimate:
    """Estimate poses and errors from the poles alone, with the precision (B,) of the errors."""
    information = factor.information.copy()
    poses, free = factor.unknowns.poses, factor.estimated
    index = np.arange(poses, len(information))
    information[index, index] += precision
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    best = inverse @ factor.vector
    return FactorEstimate(best[:poses], best[poses:], inverse)


def parts_of_errors(
    groups: Groups, sigma: Array, precision: Array, inverse: Array, estimated: Array
) -> list[Part]:
    """Say what each group of errors does to all poses.

    Parameters
    ----------
    groups, sigma
        Errors, and the 1 σ of each group.
    precision
        (B,) of the prior that the errors were estimated with, which may be narrower.
    inverse
        (K, K) H⁻¹ of poses and errors.
    estimated
        (B,) the errors as the data have them.
    """
    poses = len(inverse) - len(estimated)
    passed = inverse[:poses, poses:] * precision * sigma[groups.label]
    found = []
    for g, (kind, lidar) in enumerate(zip(groups.kinds, groups.sensors, strict=True)):
        member = np.flatnonzero(groups.label == g)
        alone = len(member) == 1 and kind.field != CONSIDERED
        value = float(estimated[member[0]]) if alone else None
        found.append(Part(kind.name, lidar, float(sigma[g]), kind.unit, value, passed[:, member]))
    return found


def part_of(name: str, root: Array, *, is_random: bool = False) -> Part:
    """Give a part (6 L, R) that is no single quantity."""
    return Part(name, None, None, "m", None, root, is_random)


def parts_of_poles(name: str, factor: PoleFactor, inverse: Array) -> list[Part]:
    """Say what the scatter of the returns on the poles does to all poses, and their depth.

    Parameters
    ----------
    name
        What the scatter is called.
    factor
        Of the poles, about the answer.
    inverse
        (K, K) of all information.
    """
    wide = np.sqrt(few_freedom(factor.redundancy))
    by_poses = inverse[: factor.unknowns.poses]
    scatter = root_of(factor.information - factor.depth @ factor.depth.T)
    return [
        part_of(name, np.asarray(wide * by_poses @ scatter), is_random=True),
        part_of(DEPTH, np.asarray(by_poses @ factor.depth)),
    ]


def root_of(square: Array) -> Array:
    """(N, N) whose square ``root rootᵀ`` is a matrix that may leave directions free."""
    size, way = np.linalg.eigh(square)
    return np.asarray(way * np.sqrt(np.maximum(size, 0.0)))


def floors(T: Array, free: BoolArray) -> list[Part]:
    """State the unmodelled errors: half of its variance for each LiDAR of a pair.

    It turns and shifts a LiDAR's own frame.

    Parameters
    ----------
    T
        (L, 4, 4) the poses.
    free
        (6 L,) which of their parameters are estimated.
    """
    half = np.asarray(np.linalg.cholesky(floor() / 2))
    return [part_of(FLOOR, _of_frame(T, free, lidar, half)) for lidar in range(len(T))]


def sways(T: Array, free: BoolArray, left: Array) -> list[Part]:
    """State what is left of each LiDAR's sway (L, 6, 6), axes of its own; empty where all stand.

    Parameters as of `floors`.
    """
    found = []
    for lidar, covariance in enumerate(left):
        if covariance.any():
            turn = np.kron(np.eye(2), T[lidar, :3, :3])
            root = _of_frame(T, free, lidar, turn @ root_of(covariance))
            size = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
            found.append(Part(SWAY, lidar, size, "rad", None, root, is_random=True))
    return found


def _of_frame(T: Array, free: BoolArray, lidar: int, root: Array) -> Array:
    """(6 L, 6) what an error of one LiDAR's own frame, given by a root (6, 6), does to all poses.

    That of a LiDAR whose frame is the datum moves all others against it.
    """
    is_datum = np.array([not each.any() for each in free.reshape(-1, POSE)])
    found = np.zeros((len(T), POSE, POSE))
    if is_datum[lidar]:
        for other in np.flatnonzero(~is_datum):
            move = np.eye(POSE)
            move[3:, :3] = -se3.hat(T[other][:3, 3] - T[lidar][:3, 3])
            found[other] = -move @ root
    else:
        found[lidar] = root
    return np.asarray(found.reshape(-1, POSE))


def joint_covariance(parts: Sequence[Part]) -> Array:
    """(6 L, 6 L) of all poses, all errors together."""
    return np.asarray(sum(part.root @ part.root.T for part in parts))


def uncertainty_of_pair(parts: Sequence[Part]) -> Uncertainty:
    """State how sure the pose of a pair's source is, and what makes it so."""
    random, systematic = (
        sum(
            (root @ root.T for root in (part.root[POSE:] for part in parts if kind(part))),
            np.zeros((POSE, POSE)),
        )
        for kind in (lambda part: part.is_random, lambda part: not part.is_random)
    )
    return Uncertainty(np.asarray(random), np.asarray(systematic), budget_of(parts, 1))


def budget_of(
    parts: Sequence[Part], lidar: int, names: Sequence[str] | None = None
) -> tuple[BudgetEntry, ...]:
    """Say what the error of one pose is made of, the largest first; equal names are put together.

    Parameters
    ----------
    parts
        Every source of error.
    lidar
        Whose pose.
    names
        Of all LiDARs of a site; None of a pair, whose LiDARs have names of their own.
    """
    own = slice(POSE * lidar, POSE * (lidar + 1))
    rows: dict[tuple[str, int | None], list[Part]] = {}
    for part in parts:
        rows.setdefault((part.name, part.lidar), []).append(part)
    squares = {
        key: sum(_at(part.root[own]) ** 2 for part in members) for key, members in rows.items()
    }
    whole = sum(squares.values())
    if not whole:
        return ()
    found = []
    for (name, whose), members in rows.items():
        first = members[0]
        told = name if whose is None or names is None else f"{name} of {names[whose]}"
        sensor = None if whose is None or names is not None else SIDES[whose]
        size = first.sigma if first.sigma is not None else float(np.sqrt(squares[name, whose]))
        estimated = first.estimated if len(members) == 1 else None
        share = squares[name, whose] / whole
        found.append(BudgetEntry(told, sensor, size, first.unit, estimated, share))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda entry: -entry.share_at_30m))


def excess(covariance: Array, other: Array) -> Array:
    """Give by how much a covariance is more than another, in the directions where it is."""
    more, way = np.linalg.eigh(covariance - other)
    return np.asarray((way * np.maximum(more, 0.0)) @ way.T)


def few_freedom(freedom: float) -> float:
    """Factor by which few degrees of freedom widen a covariance: ``6 F(6, ν) / χ²(6)`` at 95 %.

    It is 1 where they are infinite: of a covariance that is given, not estimated.
    """
    if np.isinf(freedom):
        return 1.0
    return float(POSE * fdtri(POSE, max(freedom, 3.0), CONFIDENCE) / chi2_limit(POSE, CONFIDENCE))


def _at(root: Array) -> float:
    """1 σ at `BUDGET_RANGE` of a part of one pose's covariance, metres."""
    return predicted_error(root @ root.T, (BUDGET_RANGE,))[0].sigma_m
