"""Certainty of a pose: from the scatter, the instruments' errors, and unmodelled errors.

The poses x and the errors b are estimated together, with information ``H`` (all of x and b, the
prior ``B⁻¹`` of the errors among it). An error b moves the estimate by ``−[H⁻¹]_xb B⁻¹ b``: the
part that the data show is removed, the rest affects the pose. See docs/method.md, Certainty.

The sizes of the errors are the prior ones, corrected by the data. Every error is a
random effect ``b ~ N(0, σ²)``, with one σ for each group. The prior has the weight
of `MIN_MEMBERS` errors of that size; the data may show that they are larger or
smaller. Makers state the largest errors of a kind, and an error that does not exist absorbs
information on the pose: with sizes that never fall below the known ones, the median e_rt of 60
easy streets and harbors (seeds 0 to 29) is 2.0 and 2.4 mm, instead of 1.6 and 2.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc, chdtri, erfcinv, fdtri, ndtri

from ..base import se3
from ..base.datatypes import Array, BoolArray
from ..base.systematic import Groups
from ..base.uncertainty import BUDGET_RANGE, BudgetEntry, Uncertainty, floor, predicted_error
from ..base.uncertainty.purpose import CONFIDENCE
from .network import PoleFactor
from .solver import inverse_of
from .unknowns import POSE

POLES_ONLY = "tape", "radius"
"""Errors that only poles show."""

WORKING_SHARE = 0.25
"""In the estimate, errors that only poles show have a prior with this part of their 1
σ; the stated uncertainty includes them in full. A few poles cannot distinguish an offset from
a translation: with the full prior, the estimate would explain noise by offsets. Of
100 set-ups of the paper the median e_rt is 0.081 m with 0.25, 0.087 with 0.5 and 0.125 with 1; with
offsets of 7 mm on tape and 4 mm on rings 0.125, 0.129 and 0.152 (seeds 0 to 99)."""

CONSIDERED = "width"
CONSIDERED_SHARE = 0.01
"""The error that is considered and not estimated (Schmidt 1966), and the part of its 1 σ that is
used in the estimate. The estimate assumes the known width of the beams, and the stated uncertainty
includes its error. The minimal overlap of a beam with a pole's edge that still gives a return is
not known well enough to estimate the width: estimated, it came out at 0.2 to 0.7 of what was
simulated, and the poles of 4 streets of 8 sweeps (seeds 501 to 504, sensors known) fitted each
other worse, with a χ² of up to 70 instead of 2."""

MIN_MEMBERS = 5
"""Minimum number of errors from which a size is estimated; the prior size has the weight of the
same number in addition to the data. The errors of a whole LiDAR, one to four of a kind, do not
determine their size, and an estimated size would grow with an error of the pose. With that of bent
scan lines estimated, of 36 recordings of a stationary vehicle that were turned by 0.3° two to five
were not found to have moved (benchmarks/check.py, PandaSet, seeds 1000 and 1001); without, none of
36 is missed."""

MAX_SCALE = 3.0
"""Largest factor of an estimated size over the known one: beyond, the cause is not the LiDAR."""


def prior_precision(groups: Groups, sigma: Array) -> Array:
    """(B,) B⁻¹ of the errors, from the 1 σ of each group; considered errors are almost fixed."""
    constrained = considered(groups, sigma) > 0
    return np.asarray(
        1.0 / (np.where(constrained, CONSIDERED_SHARE, 1.0) * sigma[groups.label]) ** 2
    )


def considered(groups: Groups, sigma: Array) -> Array:
    """(B,) 1 σ of the errors that are considered and not estimated, 0 of all others."""
    kept = np.array([kind.field == CONSIDERED for kind in groups.kinds])
    return np.asarray(np.where(kept, sigma, 0.0)[groups.label])


def working_sigma(groups: Groups, sigma: Array, *, poles_alone: bool) -> Array:
    """(G,) 1 σ used in the estimate: `WORKING_SHARE` of it for errors that only poles show.

    Poles alone show hardly any error; with the scene, all but the offset on tape and the radius.
    """
    hidden = np.array([poles_alone or kind.field in POLES_ONLY for kind in groups.kinds])
    return np.where(hidden, WORKING_SHARE, 1.0) * sigma


def group_scales(
    groups: Groups, known: Array, precision: Array, estimated: Array, variance: Array
) -> Array:
    """Estimate the 1 σ of each group from the estimated errors and the prior sizes.

    ``σ² = (ν₀ σ₀² + Σ b̂²) / (ν₀ + Σ γ)`` with ``γ = 1 − var/σ²``, the degree to which the data
    determine each error (MacKay 1992, Bayesian interpolation; REML in geodesy).

    Parameters
    ----------
    groups
        Which errors belong together.
    known
        (G,) the prior sizes.
    precision
        (B,) of the prior that the errors were estimated with.
    estimated, variance
        (B,) the errors and their posterior variance.
    """
    determined = np.clip(1.0 - variance * precision, 0.0, 1.0)
    count = len(known)
    square = np.bincount(groups.label, estimated**2, count)
    gamma = np.bincount(groups.label, determined, count)
    new = np.sqrt((MIN_MEMBERS * known**2 + square) / (MIN_MEMBERS + gamma))
    many = np.bincount(groups.label, minlength=count) >= MIN_MEMBERS
    return np.asarray(np.where(many, np.minimum(new, MAX_SCALE * known), known))


FLOOR = "unmodelled errors"
"""Name of the unmodelled errors in the budget: nothing reduces them."""

POLES = "scatter of the poles' returns"
"""Name of that part in the budget."""

DEPTH = "depth of the poles"
"""Name in the budget of the error common to all returns of a LiDAR on one pole."""

SWAY = "sway while it recorded"
"""Name of the remaining sway in the budget."""

SIDES: tuple[Literal["target"], Literal["source"]] = ("target", "source")
"""Names of the LiDARs of a pair."""

CHI2_SHARE = 0.99
"""Probability of the quantile that `chi2_limit` gives by default."""


SIGNIFICANCE = 0.001
"""Significance level of the tests that warn: the rate of false alarms (Baarda 1968)."""

MAX_NORMAL = float(-ndtri(SIGNIFICANCE / 2.0))
"""Standard normal number, 3.29, that is exceeded with this probability, in either direction."""


def chi2_limit(freedom: float, share: float = CHI2_SHARE) -> float:
    """Quantile of χ² with some degrees of freedom."""
    return float(chdtri(freedom, 1.0 - share))


def normalised(chi2: float, freedom: int, among: int = 1) -> float:
    """Give a χ², the largest of some, as a standard normal number of the same probability."""
    p = min(among * float(chdtrc(freedom, chi2)), 1.0)
    return float(np.sqrt(2.0) * erfcinv(p)) if p > 0 else float(np.sqrt(chi2))


@dataclass(frozen=True, eq=False)
class Part:
    """One source of error, and its part in the covariance of all poses.

    Attributes
    ----------
    name, lidar
        The source of the error, and its LiDAR; None if it does not belong to a single LiDAR.
    sigma, unit
        1 σ of the error itself; None if it is not a single quantity.
    estimated
        The error estimated from the data; None if it is not estimated or is not one number.
    root
        (6 L, R): the part is ``root rootᵀ``.
    is_random
        Whether it is independent in another recording.
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
    zero where the datum fixes a pose.
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
    inverse[np.ix_(free, free)] = inverse_of(information[np.ix_(free, free)])
    best = inverse @ factor.vector
    return FactorEstimate(best[:poses], best[poses:], inverse)


def parts_of_errors(
    groups: Groups, sigma: Array, precision: Array, inverse: Array, estimated: Array
) -> list[Part]:
    """Compute the effect of each group of errors on all poses.

    Parameters
    ----------
    groups, sigma
        Errors, and the 1 σ of each group.
    precision
        (B,) of the prior that the errors were estimated with, which may be narrower.
    inverse
        (K, K) H⁻¹ of poses and errors.
    estimated
        (B,) the estimated errors.
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
    """Give a part (6 L, R) that is not a single quantity."""
    return Part(name, None, None, "m", None, root, is_random)


def parts_of_poles(name: str, factor: PoleFactor, inverse: Array) -> list[Part]:
    """Compute the effect of the scatter of the returns on the poles on all poses, and of their
    depth.

    Parameters
    ----------
    name
        Name of the scatter.
    factor
        Of the poles, about the answer.
    inverse
        (K, K) of all information.
    """
    wide = np.sqrt(few_freedom(factor.redundancy))
    by_poses = inverse[: factor.unknowns.poses]
    depth = by_poses @ factor.depth
    scatter = by_poses @ factor.information @ by_poses.T - depth @ depth.T
    return [
        part_of(name, wide * root_of(scatter), is_random=True),
        part_of(DEPTH, np.asarray(depth)),
    ]


def root_of(square: Array) -> Array:
    """(N, N) whose square ``root rootᵀ`` is a matrix that may be singular."""
    size, way = np.linalg.eigh(square)
    return np.asarray(way * np.sqrt(np.maximum(size, 0.0)))


def floors(T: Array, free: BoolArray) -> list[Part]:
    """State the unmodelled errors: half of its variance for each LiDAR of a pair.

    They rotate and shift the frame of a LiDAR.

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
    """State the remaining sway of each LiDAR (L, 6, 6), in its axes; empty if none sways.

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
    """(6 L, 6) effect on all poses of an error of the frame of one LiDAR, given by a root (6, 6).

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
    """State the uncertainty of the pose of a pair's source, and its sources."""
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
    """List the sources of the error of one pose, the largest first; equal names are combined.

    Parameters
    ----------
    parts
        Every source of error.
    lidar
        Whose pose.
    names
        Of all LiDARs of a site; None of a pair, whose LiDARs have separate names.
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
        label = name if whose is None or names is None else f"{name} of {names[whose]}"
        sensor = None if whose is None or names is not None else SIDES[whose]
        size = first.sigma if first.sigma is not None else float(np.sqrt(squares[name, whose]))
        estimated = first.estimated if len(members) == 1 else None
        share = squares[name, whose] / whole
        found.append(BudgetEntry(label, sensor, size, first.unit, estimated, share))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda entry: -entry.share_at_30m))


def excess(covariance: Array, other: Array) -> Array:
    """Give the excess of a covariance (..., N, N) over another, in the directions in which it is
    larger."""
    more, way = np.linalg.eigh(covariance - other)
    return np.asarray((way * np.maximum(more, 0.0)[..., None, :]) @ np.swapaxes(way, -1, -2))


def few_freedom(freedom: float) -> float:
    """Factor by which few degrees of freedom widen a covariance: ``6 F(6, ν) / χ²(6)`` at 95 %.

    It is 1 if they are infinite: for a covariance that is given, not estimated.
    """
    if np.isinf(freedom):
        return 1.0
    return float(POSE * fdtri(POSE, max(freedom, 3.0), CONFIDENCE) / chi2_limit(POSE, CONFIDENCE))


def _at(root: Array) -> float:
    """1 σ at `BUDGET_RANGE` of a part of one pose's covariance, metres."""
    return predicted_error(root @ root.T, (BUDGET_RANGE,))[0].sigma_m
