"""The scale of values half of which may be outliers, and what they scatter by beside it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..base.datatypes import Array

GEMAN_HALF = 0.6120
"""The c for which ``x²/(x² + c²)`` of standard normal x has a mean of one half."""

START = float(np.log(GEMAN_HALF**2 * np.pi / 2.0))
"""Where the search for the scale begins, about the square of the mean: its place for normal ones,
logarithms."""

LOG_ROUNDING = 1e-12
"""Step of a logarithm at which its place is found."""

LEAST_SCATTER = 1e-6
"""Least that values are found to scatter by, and their variance in common, as a part of what is
predicted: less is rounding."""


MOST_HALVINGS = 100
"""Of `_root`, which halves where it cannot step: enough for any bracket of logarithms."""


def robust_scale(values: Array, weights: Array) -> float:
    """Estimate the standard deviation of values (N,) about 0, half of which may be outliers.

    The s with ``Σ w x²/(x² + (cs)²) = ½ Σ w`` (an M-estimate of scale, Huber 1981, with the loss of
    Geman and McClure); c makes it 1 for standard normal values. Unlike a median it has a derivative
    everywhere: where it jumped, so would the pose.
    """
    return float(np.sqrt(_half_outside(values**2, weights))) / GEMAN_HALF


def common_scatter(values: Array, variance: Array, weights: Array) -> float:
    """Find the variance that values (N,) have in common beside that which is predicted of each.

    The τ² with which ``x²/(v + τ²)`` has the same `robust_scale` among those of small predicted
    variance v as among those of large v; zero where the small ones scatter no more as it is. Small
    and large are weights, ``m/(m + v)`` and the rest, about the geometric mean m, so that τ² has a
    derivative everywhere.
    """
    middle = float(np.exp(np.average(np.log(variance), weights=weights)))
    sharp = weights * middle / (middle + variance)
    half = 0.5 * float(sharp.sum())
    square = values**2

    def difference(log_common: float) -> tuple[float, float]:
        common = np.exp(log_common)
        total = variance + common
        q = square / total
        scale = _half_outside(q, weights)
        # By the scale of all, half of the small ones lie outside where it is their own: and so do
        # half of the large ones.
        inside = 1.0 / (q + scale)
        outside = q * inside
        # By log τ²: of q itself, and of the scale, which keeps half of all outside.
        by_q = outside * inside * (common / total)
        by_scale = outside * inside
        moved = float(weights @ by_q) / float(weights @ by_scale)
        slope = scale * (moved * float(sharp @ by_scale) - float(sharp @ by_q))
        return float(sharp @ outside) - half, slope

    low, high = np.log(LEAST_SCATTER * middle), np.log(float(np.max(square)) + middle)
    if difference(low)[0] <= 0.0:
        return 0.0
    if difference(high)[0] >= 0.0:
        return float(np.exp(high))
    return float(np.exp(_root(difference, low, high, np.log(middle))))


def _half_outside(square: Array, weights: Array) -> float:
    """Find the S with ``Σ w q/(q + S) = ½ Σ w`` for squares q (N,)."""
    half = 0.5 * float(weights.sum())

    def excess(log_scale: float) -> tuple[float, float]:
        scale = np.exp(log_scale)
        inside = 1.0 / (square + scale)
        outside = square * inside
        return float(weights @ outside) - half, -scale * float(weights @ (outside * inside))

    low, high = float(np.log(1e-30)), float(np.log(float(square.max()) + 1e-30)) + 1e-9
    if excess(low)[0] <= 0:
        # Half of the values or more are zero.
        return float(np.exp(low))
    mean = float(weights @ np.sqrt(square)) / (2.0 * half)
    return float(np.exp(_root(excess, low, high, float(np.log(max(mean, 1e-15)) * 2.0) + START)))


def _root(
    function: Callable[[float], tuple[float, float]], low: float, high: float, start: float
) -> float:
    """Find where a function falls through zero between two places, by its slope (Newton).

    `scipy.optimize` has the same, but takes longer to import than all its calls to run.
    """
    x = min(max(start, low), high)
    for _ in range(MOST_HALVINGS):
        value, slope = function(x)
        low, high = (x, high) if value > 0.0 else (low, x)
        new = x - value / slope if slope < 0.0 else np.inf
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - x) < LOG_ROUNDING:
            return new
        x = new
    return x
