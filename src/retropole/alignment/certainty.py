"""How sure a pose is: what the scatter says, what the instruments allow, and what no model names.

The pose x and the errors b are estimated together, with information ``H`` (all of x and b, the
prior ``B⁻¹`` of the errors among it). An error b moves the estimate by ``−[H⁻¹]_xb B⁻¹ b``: what
the data show of it is taken out, the rest passes into the pose. See docs/method.md, Certainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtri

from ..base.datatypes import Array
from ..base.systematic import Groups
from ..base.uncertainty import BudgetEntry, Uncertainty, floor, predicted_error
from .factor import POSE, PoleFactor

FLOOR = "what no model names"
"""What the budget calls that: nothing makes it smaller."""

WORKING_SHARE, POLES_ONLY = 0.25, ("tape", "radius")
"""The estimate is drawn to the prior of errors that only poles show as if they had this part of
their 1 σ; what is stated counts them whole. A few poles cannot tell an offset from a translation:
given all the freedom that the instrument has, the estimate takes noise for offsets. Of 100 set-ups
of the paper the median e_rt is 0.081 m with 0.25, 0.087 with 0.5 and 0.125 with 1; with offsets of
7 mm on tape and 4 mm on rings 0.125, 0.129 and 0.152 (seeds 0 to 99)."""

CONSIDERED, CONSIDERED_SHARE = "width", 0.01
"""The error that is considered and not estimated (Schmidt 1966), and the part of its 1 σ that it is
held within. The estimate takes beams to be as wide as they are known to be, and what is stated
counts that they may not be. Which touch of a pole's edge still returns is not known well enough to
tell the width from it: estimated, it came out at 0.2 to 0.7 of what was simulated, and the poles of
4 streets of 8 sweeps (seeds 501 to 504, sensors known) fitted each other worse, with a χ² of up to
70 in place of 2."""

SCALE_WEIGHT = 4.0
"""So many errors of the size that is known beforehand count beside those that the data show."""

MIN_MEMBERS = 5
"""Errors that a size is estimated from: those of a whole LiDAR, one to four of a kind, do not tell
their own size, and given the freedom it grows with the pose that they pull along. With that of bent
scan lines estimated, of 36 recordings of a standing vehicle that were turned by 0.3° two to five
were not found to have moved (benchmarks/check.py, PandaSet, seeds 1000 and 1001); of 36 none is
missed so."""

MAX_SCALE = 3.0
"""Most that errors may be found larger than they are known to be: beyond, it is not the LiDAR."""

BUDGET_RANGE = 30.0
"""Range at which shares of the budget are told, metres."""

CHI2_95 = 12.591587243743977
"""95 % quantile of χ² with 6 degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """A random part of the covariance: its name, (6, 6), and how many degrees of freedom it has."""

    name: str
    covariance: Array
    freedom: float


def prior_precision(groups: Groups, sigma: Array) -> Array:
    """(B,) B⁻¹ of the errors, from the 1 σ of each group; what is considered is held fast."""
    held = considered(groups, sigma) > 0
    return np.asarray(1.0 / (np.where(held, CONSIDERED_SHARE, 1.0) * sigma[groups.label]) ** 2)


def considered(groups: Groups, sigma: Array) -> Array:
    """(B,) 1 σ of the errors that are considered and not estimated, 0 of all others."""
    kept = np.array([kind.field == CONSIDERED for kind in groups.kinds])
    return np.asarray(np.where(kept, sigma, 0.0)[groups.label])


def working_sigma(groups: Groups, sigma: Array, *, poles_alone: bool) -> Array:
    """(G,) 1 σ that the estimate is drawn by, of those that only poles show `WORKING_SHARE`.

    Poles alone show hardly any error; with the scene, all but the offset on tape and the radius.
    """
    hidden = [poles_alone or kind.field in POLES_ONLY for kind in groups.kinds]
    return np.where(hidden, WORKING_SHARE, 1.0) * sigma


@dataclass(frozen=True, eq=False)
class FactorEstimate:
    """Step (6,) of the pose, errors (B,), and the inverse (6 + B, 6 + B) of the information."""

    step: Array
    errors: Array
    inverse: Array


def solve_factor(factor: PoleFactor, precision: Array) -> FactorEstimate:
    """Estimate pose and errors from the poles alone, with the precision (B,) of the errors."""
    information = factor.information.copy()
    index = np.arange(POSE, len(information))
    information[index, index] += precision
    inverse: Array = np.asarray(np.linalg.inv(information))
    best = inverse @ factor.vector
    return FactorEstimate(best[:POSE], best[POSE:], inverse)


def group_scales(
    groups: Groups, known: Array, precision: Array, estimated: Array, variance: Array
) -> Array:
    """Estimate the 1 σ of each group from the errors that the data show, never below the known.

    ``σ² = (ν₀ σ₀² + Σ b̂²) / (ν₀ + Σ γ)`` with ``γ = 1 − var/σ²``, how far the data determine each
    error (MacKay 1992, Bayesian interpolation; REML in the geodesists' words).

    Parameters
    ----------
    groups
        Which errors belong together.
    known
        (G,) the sizes known beforehand.
    precision
        (B,) of the prior that the errors were estimated with.
    estimated, variance
        (B,) the errors and their posterior variance.
    """
    determined = np.clip(1.0 - variance * precision, 0.0, 1.0)
    count = len(known)
    square = np.bincount(groups.label, estimated**2, count)
    gamma = np.bincount(groups.label, determined, count)
    new = np.sqrt((SCALE_WEIGHT * known**2 + square) / (SCALE_WEIGHT + gamma))
    many = np.bincount(groups.label, minlength=count) >= MIN_MEMBERS
    return np.asarray(np.where(many, np.clip(new, known, MAX_SCALE * known), known))


def stated(
    groups: Groups,
    sigma: Array,
    precision: Array,
    inverse: Array,
    estimated: Array,
    scatter: Sequence[Scatter],
    other: Sequence[tuple[str, Array]] = (),
) -> Uncertainty:
    """State the uncertainty of the pose, and its budget.

    Parameters
    ----------
    groups, sigma
        Errors, and the 1 σ of each group.
    precision
        (B,) of the prior that the errors were estimated with, which may be narrower.
    inverse
        (6 + B, 6 + B) H⁻¹.
    estimated
        (B,) the errors as the data have them.
    scatter
        Random parts, each named.
    other
        Further systematic parts (6, 6), each named.
    """
    passed = inverse[:POSE, POSE:] * precision * sigma[groups.label]
    rows: list[tuple[str, int | None, float, str, float | None, Array]] = []
    for g, (kind, lidar) in enumerate(zip(groups.kinds, groups.sensors, strict=True)):
        member = groups.label == g
        part = passed[:, member] @ passed[:, member].T
        alone = np.count_nonzero(member) == 1 and kind.field != CONSIDERED
        value = float(estimated[member][0]) if alone else None
        rows.append((kind.name, lidar, float(sigma[g]), kind.unit, value, part))
    random = np.zeros((POSE, POSE))
    for one in scatter:
        widened = one.covariance * few_freedom(one.freedom)
        random = random + widened
        rows.append((one.name, None, _at(widened), "m", None, widened))
    for name, part in (*other, (FLOOR, floor())):
        rows.append((name, None, _at(part), "m", None, part))
    total = sum((row[5] for row in rows), np.zeros((POSE, POSE)))
    whole = _at(total) ** 2
    budget = [
        BudgetEntry(
            name,
            None if lidar is None else _sensor(lidar),
            size,
            unit,  # type: ignore[arg-type]
            value,
            _at(part) ** 2 / whole,
        )
        for name, lidar, size, unit, value, part in rows
    ]
    budget.sort(key=lambda entry: -entry.share_at_30m)
    return Uncertainty(random, np.asarray(total - random), tuple(budget))


def excess(covariance: Array, other: Array) -> Array:
    """Give by how much a covariance is more than another, in the directions where it is."""
    more, way = np.linalg.eigh(covariance - other)
    return np.asarray((way * np.maximum(more, 0.0)) @ way.T)


def few_freedom(freedom: float) -> float:
    """Factor by which few degrees of freedom widen a covariance: ``6 F(6, ν) / χ²(6)`` at 95 %."""
    return float(POSE * fdtri(POSE, max(freedom, 3.0), 0.95) / CHI2_95)


def _sensor(lidar: int) -> Literal["target", "source"]:
    return "source" if lidar else "target"


def _at(covariance: Array) -> float:
    """1 σ at `BUDGET_RANGE`, metres."""
    return predicted_error(covariance, (BUDGET_RANGE,))[0][1]
