"""The scale of values half of which may be outliers, and what they scatter by beside it."""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array

GEMAN_HALF = 0.6120
"""The c for which ``x²/(x² + c²)`` of standard normal x has a mean of one half."""

LEAST_SCATTER = 1e-6
"""Least that values are found to scatter by, and their variance in common, as a part of what is
predicted: less is rounding."""


def robust_scale(values: Array, weights: Array) -> float:
    """Estimate the standard deviation of values (N,) about 0, half of which may be outliers.

    The s with ``Σ w x²/(x² + (cs)²) = ½ Σ w`` (an M-estimate of scale, Huber 1981, with the loss of
    Geman and McClure); c makes it 1 for standard normal values. Unlike a median it has a derivative
    everywhere: where it jumped, so would the pose.
    """
    from scipy.optimize import brentq

    square = values**2
    half = 0.5 * float(weights.sum())

    def excess(log_square: float) -> float:
        return float(weights @ (square / (square + np.exp(log_square)))) - half

    low, high = np.log(1e-30), np.log(float(square.max()) + 1e-30)
    if excess(low) <= 0:
        # Half of the values or more are zero.
        return float(np.exp(0.5 * low)) / GEMAN_HALF
    found = brentq(excess, low, high + 1e-9)
    return float(np.exp(0.5 * found)) / GEMAN_HALF


def common_scatter(values: Array, variance: Array, weights: Array) -> float:
    """Find the variance that values (N,) have in common beside that which is predicted of each.

    The τ² with which ``x²/(v + τ²)`` has the same `robust_scale` among those of small predicted
    variance v as among those of large v; zero where the small ones scatter no more as it is. Small
    and large are weights, ``m/(m + v)`` and the rest, about the geometric mean m, so that τ² has a
    derivative everywhere.
    """
    from scipy.optimize import brentq

    middle = np.exp(np.average(np.log(variance), weights=weights))
    sharp = weights * middle / (middle + variance)

    def difference(log_common: float) -> float:
        square = values**2 / (variance + np.exp(log_common))
        # By the scale of all, half of the small ones lie outside where it is their own: and so do
        # half of the large ones.
        outside = square / (square + (GEMAN_HALF * robust_scale(np.sqrt(square), weights)) ** 2)
        return float(sharp @ outside) - 0.5 * float(sharp.sum())

    low, high = np.log(LEAST_SCATTER * middle), np.log(float(np.max(values**2)) + middle)
    if difference(low) <= 0.0:
        return 0.0
    if difference(high) >= 0.0:
        return float(np.exp(high))
    return float(np.exp(brentq(difference, low, high)))
