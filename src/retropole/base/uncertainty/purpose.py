"""Is a pose as accurate as it must be: how far off no point is, with which probability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np

from ..bounded import Share, Size, Text
from ..se3 import Array

CONFIDENCE = 0.95
"""Probability with which a pose must be as accurate as required."""

DRAWS = 100_000
"""Errors that a probability is counted from: 95 % is then known to 0.07 %, its bound to 0.4 %."""


class Need(msgspec.Struct, frozen=True, rename=lambda name: f"{name}_m"):
    """How accurate a pose must be: no point up to `at` away is off by more than `within`.

    Attributes
    ----------
    within
        Most that a point may land away from its true place, metres.
    at
        Distance from the source LiDAR up to which that is requested, metres.
    """

    within: Size
    at: Size

    @property
    def text(self) -> str:
        """For a person, in the units of the options: ``within 2 cm at 30 m``."""
        return f"within {100 * self.within:g} cm at {self.at:g} m"


DEFAULT_AT = 30.0
"""Default range of a need: the one at which the budget is stated, metres."""

LARGEST_NEED, FARTHEST = 10.0, 1000.0
"""Errors and distances that a need may name, metres: no LiDAR is that poor, and none reaches it."""

USABLE = Need(0.3, DEFAULT_AT)
"""Required accuracy of an answer to be ok if no need is stated: benchmarks/coverage.py counts those
that are further off. With the scene, bounds at 30 m are a tenth of it in the median
(benchmarks/fit.py)."""


class Fitness(msgspec.Struct, frozen=True):
    """Whether a pose is as accurate as it must be.

    Attributes
    ----------
    within_m, at_m
        What was requested, as `Need` has it.
    answer
        ``yes`` or ``no`` with a probability of `CONFIDENCE`, or that neither is shown.
    probability
        That it is so.
    bound_m
        What it is accurate to instead with a probability of `CONFIDENCE`, metres, at the same
        distance; None if nothing can be said with that: the pose may be another one.
    words
        The answer for a person: ``within 2 cm at 30 m: yes, 98 % sure``.
    """

    within_m: Size
    at_m: Size
    answer: Literal["yes", "no", "not shown"]
    probability: Share
    bound_m: Size | None
    words: Text


def _answer(probability: float, doubts: tuple[str, ...]) -> Literal["yes", "no", "not shown"]:
    if probability < 1.0 - CONFIDENCE:
        return "no"
    return "not shown" if probability < CONFIDENCE or doubts else "yes"


def _words(need: Need, answer: str, probability: float, doubts: tuple[str, ...]) -> str:
    text = f"{need.text}: {answer}"
    if answer == "not shown":
        text_with_chance = f"{text}, {whole_percent(probability)} sure"
        return text_with_chance + (f" if it were not for {', '.join(doubts)}" if doubts else "")
    likely = probability if answer == "yes" else 1.0 - probability
    return f"{text}, {whole_percent(likely)} sure"


def whole_percent(share: float) -> str:
    """Write a probability in whole per cent, rounded down: 94.9 % are not the 95 % required."""
    return f"{min(int(100 * share + 1e-9), 99)} %"


def displacement(steps: Array, distance: float) -> Array:
    """Give the largest displacement of a point by errors of a pose, of all points at a distance.

    Parameters
    ----------
    steps
        (..., 6) errors ``[φ, δ]``, rad and m: ``R_true = Exp(φ) R``, ``t_true = t + δ``.
    distance
        Of the points from the source's origin, metres.

    Returns
    -------
    numpy.ndarray
        (...) metres: the largest length of ``φ × r + δ`` over all r of that length, which is
        ``√(δ∥² + (distance |φ| + δ⊥)²)`` with δ's parts along φ and across. It grows with the
        distance, so that no nearer point is moved further.
    """
    return _moved(*_parts(steps), distance)


def _parts(steps: Array) -> tuple[Array, Array, Array]:
    """``δ∥``, ``δ⊥`` and ``|φ|`` of `displacement`, (...) each."""
    phi, delta = steps[..., :3], steps[..., 3:]
    turned = np.linalg.norm(phi, axis=-1)
    along = np.sum(phi * delta, axis=-1) / np.maximum(turned, np.finfo(float).tiny)
    across = np.sqrt(np.maximum(np.sum(delta**2, axis=-1) - along**2, 0.0))
    return along, across, turned


def _moved(along: Array, across: Array, turned: Array, distance: float) -> Array:
    return np.asarray(np.hypot(along, distance * turned + across))


def displacements(covariance: Array, distance: float) -> Array:
    """Draw by how much the worst placed point at a distance is off, as a covariance says.

    Equal covariances give equal draws.

    Parameters
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m.
    distance
        Metres.

    Returns
    -------
    numpy.ndarray
        (DRAWS,) `displacement` of errors with that covariance, metres, the least first.
    """
    return np.sort(displacement(_drawn(covariance), distance))


def _drawn(covariance: Array) -> Array:
    """(DRAWS, 6) errors with a covariance (6, 6)."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = np.random.default_rng(0).standard_normal((DRAWS, 6))
    return np.asarray(draws @ root.T)


def displacement_bound(
    covariance: Array, distance: float, probability: float = CONFIDENCE
) -> float:
    """Bound how far off any point at a distance is, metres, with a probability.

    The bound applies to all directions at once, and for every nearer point: with this probability
    no point up to there lands further from its true place. The 1 σ of `predicted_error` is a mean
    over directions; the bound at 95 % is 2 to 3 times as large.
    """
    return float(displacement_bounds(covariance, (distance,), probability)[0])


def displacement_bounds(
    covariance: Array, distances: Sequence[float], probability: float = CONFIDENCE
) -> Array:
    """Bound as `displacement_bound` does at several distances (K,): (K,) metres, of equal draws."""
    parts = _parts(_drawn(covariance))
    return np.array([np.quantile(_moved(*parts, each), probability) for each in distances])


def is_certainly_met(covariance: Array, need: Need) -> bool:
    """Whether a need is fulfilled with a probability of `CONFIDENCE`, whatever the distribution.

    By the inequality of Chebyshev, without a draw: no error moves a point by more than
    ``|δ| + distance |φ|``, whose mean square is at most ``2 (tr Σ_δ + distance² tr Σ_φ)``. It says
    yes only far within the need.
    """
    variances = np.diag(covariance)
    mean_square = 2.0 * float(variances[3:].sum() + need.at**2 * variances[:3].sum())
    return mean_square <= (1.0 - CONFIDENCE) * need.within**2


def fitness(
    covariance: Array, need: Need, *, wrong: float = 0.0, doubts: tuple[str, ...] = ()
) -> Fitness:
    """Answer whether a pose is as accurate as it must be.

    Parameters
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m.
    need
        What is requested.
    wrong
        Probability that it is another pose altogether, which the covariance does not include.
    doubts
        Codes of what else it does not include: with one of them the answer is never yes.
    """
    sizes = displacements(covariance, need.at)
    right = 1.0 - wrong
    met = float(np.searchsorted(sizes, need.within, side="right")) / len(sizes)
    bound = float(np.quantile(sizes, CONFIDENCE / right)) if right > CONFIDENCE else None
    probability = right * met
    answer = _answer(probability, doubts)
    text = _words(need, answer, probability, doubts)
    return Fitness(need.within, need.at, answer, probability, bound, text)
