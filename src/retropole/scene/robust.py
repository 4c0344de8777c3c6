"""The scale of values half of which may be outliers."""

from __future__ import annotations

import numpy as np

from ..datatypes import Array

GEMAN_HALF, SCALE_TOLERANCE = 0.6120, 1e-13
"""The c for which ``x²/(x² + c²)`` of standard normal x has a mean of one half, and how exactly the
logarithm of a scale is found."""


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
    found = brentq(excess, low, high + 1e-9, xtol=SCALE_TOLERANCE)
    return float(np.exp(0.5 * found)) / GEMAN_HALF
