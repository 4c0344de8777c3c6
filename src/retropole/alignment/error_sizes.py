"""How large the errors of LiDARs are: as is known beforehand, and as the data show them.

Every error is a random effect ``b ~ N(0, σ²)``, with one σ for each group of them. What is known
beforehand counts as `MIN_MEMBERS` errors of that size; the data may show that they are larger or
smaller. Makers state the largest errors of a kind, and an error that is not there takes up what the
data say about the pose: with sizes that never fall below the known ones, the median e_rt of 60 easy
streets and harbors (seeds 0 to 29) is 2.0 and 2.4 mm, in place of 1.6 and 2.1.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array
from ..base.systematic import Groups

POLES_ONLY = "tape", "radius"
"""Errors that only poles show."""

WORKING_SHARE = 0.25
"""The estimate is drawn to the prior of errors that only poles show as if they had this part of
their 1 σ; what is stated counts them whole. A few poles cannot tell an offset from a translation:
given all the freedom that the instrument has, the estimate takes noise for offsets. Of 100 set-ups
of the paper the median e_rt is 0.081 m with 0.25, 0.087 with 0.5 and 0.125 with 1; with offsets of
7 mm on tape and 4 mm on rings 0.125, 0.129 and 0.152 (seeds 0 to 99)."""

CONSIDERED = "width"
CONSIDERED_SHARE = 0.01
"""The error that is considered and not estimated (Schmidt 1966), and the part of its 1 σ that it is
held within. The estimate takes beams to be as wide as they are known to be, and what is stated
counts that they may not be. Which touch of a pole's edge still returns is not known well enough to
tell the width from it: estimated, it came out at 0.2 to 0.7 of what was simulated, and the poles of
4 streets of 8 sweeps (seeds 501 to 504, sensors known) fitted each other worse, with a χ² of up to
70 in place of 2."""

MIN_MEMBERS = 5
"""Errors that a size is estimated from, and as many of the size that is known beforehand count
beside those that the data show. Those of a whole LiDAR, one to four of a kind, do not tell their
own size, and given the freedom it grows with the pose that they pull along. With that of bent scan
lines estimated, of 36 recordings of a standing vehicle that were turned by 0.3° two to five
were not found to have moved (benchmarks/check.py, PandaSet, seeds 1000 and 1001); of 36 none is
missed so."""

MAX_SCALE = 3.0
"""Most that errors may be found larger than they are known to be: beyond, it is not the LiDAR."""


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
    hidden = np.array([poles_alone or kind.field in POLES_ONLY for kind in groups.kinds])
    return np.where(hidden, WORKING_SHARE, 1.0) * sigma


def group_scales(
    groups: Groups, known: Array, precision: Array, estimated: Array, variance: Array
) -> Array:
    """Estimate the 1 σ of each group from the errors that the data show and those that are known.

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
    new = np.sqrt((MIN_MEMBERS * known**2 + square) / (MIN_MEMBERS + gamma))
    many = np.bincount(groups.label, minlength=count) >= MIN_MEMBERS
    return np.asarray(np.where(many, np.minimum(new, MAX_SCALE * known), known))
