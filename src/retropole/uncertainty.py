"""What a covariance means where it matters: at the far end of a scan."""

from __future__ import annotations

import numpy as np

from . import se3
from .datatypes import Array

RANGES = (1.0, 10.0, 30.0, 60.0)
"""Ranges at which the error is predicted, metres."""


def predicted_error(
    covariance: Array | None, ranges: tuple[float, ...] = RANGES
) -> tuple[tuple[float, float], ...]:
    """Predict the error of where a source point lands in the target frame, by its range.

    Parameters
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m: ``R_true = Exp(φ) R``, ``t_true = t + δ``. None predicts
        nothing.
    ranges
        Distances of the point from the source's origin, metres.

    Returns
    -------
    tuple of (range, sigma)
        1 σ in metres: the root of the mean square length of ``φ × R p + δ``, over the error and
        over all directions of p.
    """
    if covariance is None:
        return ()
    # Six directions that average as the sphere does, for anything quadratic in the direction.
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    predictions = []
    for distance in ranges:
        J = np.concatenate(
            [-se3.hat(distance * directions), np.broadcast_to(np.eye(3), (6, 3, 3))], axis=2
        )
        variance = np.einsum("mij,jk,mik->m", J, covariance, J)
        predictions.append((distance, float(np.sqrt(variance.mean()))))
    return tuple(predictions)
