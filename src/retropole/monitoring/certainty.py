"""How small a movement the covariance of a step tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, chndtr, ndtri

from ..base.datatypes import Array
from .tolerance import Tolerance

FALSE_ALARM = 0.01
"""How often the test may find a movement where there was none."""

CONFIDENCE = 0.95
"""With which it has moved by less than the tolerance before *same* is said: of movements of the
tolerance, so many at least are not answered by *same*."""

MIN_POWER = 0.95
"""Probability of finding a movement of the tolerance, below which the size of one is unsure."""

ONE_SIDED = float(ndtri(CONFIDENCE))
"""So many σ beyond a normal variable its mean lies with that confidence: 1.645."""

MAX_NONCENTRALITY = 1000.0
"""Beyond, the power is 1 to all digits and SciPy's noncentral χ² is not reliable."""

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)
"""Parts of a step."""


@dataclass(frozen=True, eq=False)
class LeastCertain:
    """1 σ of a part of the step in the direction where it is largest, and that direction (3,)."""

    sigma: float
    direction: Array


def least_certain(covariance: Array, part: slice) -> LeastCertain:
    """Find the direction of a part of the step in which its covariance (6, 6) is largest."""
    values, vectors = np.linalg.eigh(covariance[part, part])
    return LeastCertain(float(np.sqrt(values[-1])), np.asarray(vectors[:, -1]))


def upper_limit(step: Array, covariance: Array, sigmas: float = ONE_SIDED) -> Tolerance:
    """By how much it has moved at most: ``|d| + z σ`` of each part, σ in its worst direction.

    With ``z = Φ⁻¹(0.95)`` an upper limit with a confidence of 95 %: after a movement m of that
    size along the unit vector u, ``u · d`` is normal about ``|m|`` with a variance of ``λ_max``
    at most, and ``|d| ≥ u · d`` lies below ``|m| − z σ`` in one of twenty cases at most.

    Parameters
    ----------
    step, covariance
        (6,) from the stored pose to the new one, and (6, 6) of it.
    sigmas
        z.
    """
    rotation, translation = (
        float(np.linalg.norm(step[part])) + sigmas * least_certain(covariance, part).sigma
        for part in (ROTATION, TRANSLATION)
    )
    return Tolerance(rotation, translation)


def detection_power(covariance: Array, tolerance: Tolerance) -> float:
    """Probability that the test finds a movement of the tolerance, in the worst of all directions.

    Under a movement m the statistic is noncentral χ² with 6 degrees of freedom and noncentrality
    ``mᵀ S⁻¹ m``. Of all m that rotate by the tolerance, with whatever translation, the least of
    these is ``tol² / λ_max(S_φφ)``; of all that translate by it, with whatever rotation,
    ``tol² / λ_max(S_δδ)``.

    Parameters
    ----------
    covariance
        (6, 6) of the step.
    tolerance
        The movement that matters.
    """
    least = min(
        (tolerance.rotation / least_certain(covariance, ROTATION).sigma) ** 2,
        (tolerance.translation / least_certain(covariance, TRANSLATION).sigma) ** 2,
    )
    return float(1.0 - chndtr(chdtri(6, FALSE_ALARM), 6, min(least, MAX_NONCENTRALITY)))
