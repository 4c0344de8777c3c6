"""How large the errors of LiDARs are: as is known beforehand, and as the data show them.

Every error is a random effect ``b ~ N(0, σ²)``, with one σ for each group of them. What an estimate
is best drawn by and what has to be stated are two things: a LiDAR that is known to be no worse than
its data sheet says may be far better, and the data may show that, but not of every error.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array, BoolArray
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

OWN_MEMBERS = 2.0
"""As many errors of a group count as the size of all errors together says, beside its own: one
large error among small ones is found, and a few errors are not taken for none. With 1, 2 and
`MIN_MEMBERS` or 10 for all together, e_rt of the tuning families of benchmarks/coverage.py (seeds
200 to 217) is 0.61 to 0.98 of what it is with the known sizes, and of the field's 0.9, whatever
these are."""

LEAST_DRAWN = 0.1
"""The estimate is drawn by no less than this part of the 1 σ that errors are known to have."""


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
    hidden = poles_alone | _only_on_poles(groups)
    return np.where(hidden, WORKING_SHARE, 1.0) * sigma


def _only_on_poles(groups: Groups) -> BoolArray:
    return np.array([kind.field in POLES_ONLY for kind in groups.kinds])


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
    new = np.sqrt((MIN_MEMBERS * known**2 + square) / (MIN_MEMBERS + gamma))
    many = np.bincount(groups.label, minlength=count) >= MIN_MEMBERS
    return np.asarray(np.where(many, np.clip(new, known, MAX_SCALE * known), known))


def drawn_sigma(
    groups: Groups, known: Array, precision: Array, estimated: Array, variance: Array
) -> Array:
    """Estimate the 1 σ that the estimate is best drawn by: less than the known where errors are.

    As `group_scales`, in two steps: the size of all errors together, each in units of the known,
    and that of each group about it. A LiDAR whose errors are known to be no larger than so may be
    far better, and an error that is not there and yet is estimated takes noise for itself. What is
    stated counts the known sizes all the same (`scene.places.parts_of`): an error that the data do
    not determine may be as large.

    Parameters
    ----------
    groups, known, precision, estimated, variance
        As for `group_scales`.

    Returns
    -------
    numpy.ndarray
        (G,) in the unit of each; the known of what only poles show.
    """
    count = len(known)
    square = np.bincount(groups.label, (estimated / known[groups.label]) ** 2, count)
    gamma = np.bincount(groups.label, np.clip(1.0 - variance * precision, 0.0, 1.0), count)
    kept = _only_on_poles(groups) | np.array([kind.field == CONSIDERED for kind in groups.kinds])
    together = (MIN_MEMBERS + square[~kept].sum()) / (MIN_MEMBERS + gamma[~kept].sum())
    size = np.sqrt((OWN_MEMBERS * together + square) / (OWN_MEMBERS + gamma))
    return known * np.where(kept, 1.0, np.clip(size, LEAST_DRAWN, MAX_SCALE))
