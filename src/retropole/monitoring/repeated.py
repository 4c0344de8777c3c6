"""The covariance of a step between two poses of the same devices, whose errors repeat.

What scatter leaves in both poses is drawn anew and adds up. What the instruments err by is the same
in both, and cancels in the step as far as both poses were found the same way: by poles at the same
places, say. By poles elsewhere, or by the scene alone, the same errors move the pose another way.
How an error passes into each pose is not stored, only what all errors make together; but along a
direction in which both are equally uncertain they were probably found alike, and one in which only
the one is uncertain is nothing they can share. So with variances a and b along each of the
directions in which both systematic parts are uncorrelated (their generalised eigenvectors), the
step keeps

    a + b − 2 ρ √(a b),

the variance of the difference of two errors of correlation ρ. See docs/check.md.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from ..base.datatypes import Array, PoseEstimate
from ..base.uncertainty import Uncertainty, floor

REPEATED = 0.9
"""Correlation ρ of what the same devices err by in two recordings: the rest is what temperature,
warm-up and age change. With it and the floor, the 95 % quantile of χ² of unmoved simulated
recordings is 5 at most with the poles where they were, 10 with poles elsewhere and 8 without (field
and typical noise, 188 sites, seeds below 1000), where 12.6 is expected: the simulator's devices
repeat all of their errors."""


def step_covariance(stored: Uncertainty, new: Uncertainty) -> Array:
    """(6, 6) of the step from the stored pose to the new one, over ``[φ, δ]``, rad and m.

    A pose with no systematic part shares nothing: then all of both counts.
    """
    return np.asarray(stored.random + new.random + kept(stored.systematic, new.systematic))


def kept(stored: Array, new: Array) -> Array:
    """Part of the systematic errors (6, 6) of two poses that does not cancel in their difference.

    Unmodelled errors need not repeat: they are added for both recordings.
    """
    both = np.asarray(stored + new)
    if not (stored.any() and new.any()):
        return both
    share, vectors = eigh(stored, both)
    share = np.clip(share, 0.0, 1.0)
    common = 2.0 * REPEATED * np.sqrt(share * (1.0 - share))
    axes = both @ vectors
    return np.asarray((axes * (1.0 - common)) @ axes.T + 2.0 * floor())


def in_parts(pose: PoseEstimate, uncertainty: Uncertainty | None) -> Uncertainty:
    """Give the parts of a pose's covariance; where they are not known, all of it is random."""
    assert pose.covariance is not None
    if uncertainty is not None:
        return uncertainty
    return Uncertainty(pose.covariance, np.zeros_like(pose.covariance))
