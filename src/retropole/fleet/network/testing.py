"""Every observation tested against all others, and the least error that the test finds.

What an observation misses, and how much of an error of it shows there, follow from the covariance
of its own ends alone (Baarda 1968): with A its whitened derivative and Q that covariance, an error
∇ shows as ``(I − A Q Aᵀ) ∇``. How much the sum of squares falls without the observation is its χ².
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc, chdtri, chndtrinc, erfcinv

from ...api import Array, BoolArray, IntArray
from .adjustment import AdjustedNetwork, Layout
from .graph import Graph

SIGNIFICANT = 1e-5
"""Probability of a sound observation's χ² to be beyond what is taken for chance: a hundredth of the
sound edges that may be lost at most, one in a thousand. w is then 4.4."""

POWER = 0.8
"""With which probability the least detectable error is found (Baarda 1968)."""

LEAST_CHECKED = 1e-5
"""Part of an error that must show in the residuals to be tested: far above the rounding that is
left of what nothing checks, far below what any test could find."""


@dataclass(frozen=True, eq=False)
class ObservationTests:
    """Tests of some observations.

    Attributes
    ----------
    chi2
        (K,) by how much the sum of squares falls without the observation, or, where it is left
        out, would rise with it.
    freedom
        (K,) how many numbers of it the others check; 0 where nothing does.
    w
        (K,) the χ² as a standard normal number of the same probability, two-sided.
    redundancy
        (K,) part of its errors that shows in its residuals, 0 to 1.
    detectable_rotation, detectable_translation
        (K,) least rotation, rad, and translation, m, in the direction in which it shows least,
        that the test finds with `POWER`; infinite where nothing checks one.
    """

    chi2: Array
    freedom: IntArray
    w: Array
    redundancy: Array
    detectable_rotation: Array
    detectable_translation: Array

    def split(self, counts: Iterable[int]) -> list[ObservationTests]:
        """So many of each kind."""
        ends = np.cumsum([*counts])[:-1]
        parts = (np.split(values, ends) for values in vars(self).values())
        return [ObservationTests(*part) for part in zip(*parts, strict=True)]


def all_tests(
    graph: Graph, layout: Layout, adjusted: AdjustedNetwork, active: BoolArray
) -> ObservationTests:
    """Test all observations (M,): edges, known poses, control points.

    Parameters
    ----------
    graph, layout
        The network.
    adjusted
        Its poses.
    active
        (M,) which observations were adjusted; the others are tested against these.
    """
    of, at, covariance = graph.observed, graph.observed.at(adjusted.T), adjusted.covariance
    # The ground is certain.
    own = np.concatenate([covariance.diagonal, np.zeros((1, 6, 6))])
    cross = layout.turn(covariance.pairs[layout.pair])
    edges = slice(0, len(cross))
    mixed = at.by_i[edges] @ cross @ np.swapaxes(at.by_j[edges], 1, 2)
    # The covariance of what the poses say.
    taken_up = _through(at.by_i, own[of.i]) + _through(at.by_j, own[of.j])
    taken_up[edges] += mixed + np.swapaxes(mixed, 1, 2)
    shows = np.eye(6) - taken_up
    # One that is left out would take the poses along so far.
    shows[~active] = np.linalg.inv(np.eye(6) + taken_up[~active])
    is_measured = np.arange(6) >= 6 - of.freedom[:, None]
    shows *= is_measured[:, :, None] & is_measured[:, None, :]
    part, way = np.linalg.eigh((shows + np.swapaxes(shows, 1, 2)) / 2)
    told = part > LEAST_CHECKED
    along = np.einsum("kab,ka->kb", way, at.residual)
    chi2 = np.where(active[:, None], along**2 / np.where(told, part, 1.0), along**2 * part)
    chi2 = np.sum(np.where(told, chi2, 0.0), axis=1)
    part = np.where(told, part, 0.0)
    freedom = np.count_nonzero(told, axis=1)
    redundancy = np.clip(np.sum(part, axis=1) / of.freedom, 0.0, 1.0)
    seen = (way * part[:, None]) @ np.swapaxes(way, 1, 2)
    information, whole = (np.swapaxes(of.root, 1, 2) @ each @ of.root for each in (seen, np.eye(6)))
    least = np.array([noncentrality(k) for k in range(7)])[freedom]
    rotation, translation = (
        _detectable(information[:, some, some], whole[:, some, some], least)
        for some in (slice(0, 3), slice(3, 6))
    )
    return ObservationTests(
        chi2, freedom, normalised(chi2, freedom), redundancy, rotation, translation
    )


def _through(J: Array, covariance: Array) -> Array:
    return np.asarray(J @ covariance @ np.swapaxes(J, 1, 2))


def _detectable(information: Array, whole: Array, least: Array) -> Array:
    """Least error (K,) that is found in the direction in which it shows least."""
    shown = np.linalg.eigvalsh(information)[:, 0]
    checked = shown > LEAST_CHECKED * np.linalg.eigvalsh(whole)[:, 0]
    return np.where(checked, np.sqrt(least / np.where(checked, shown, 1.0)), np.inf)


def normalised(chi2: Array, freedom: IntArray) -> Array:
    """Give each χ² as a standard normal number of the same probability; 0 without freedom."""
    p = np.where(freedom > 0, chdtrc(np.maximum(freedom, 1), chi2), 1.0)
    # Where the probability is too small for a number, the χ² is its own best measure.
    return np.where(p > 1e-300, np.sqrt(2) * erfcinv(np.maximum(p, 1e-300)), np.sqrt(chi2))


def critical(freedom: IntArray) -> Array:
    """χ² (K,) from which on an observation is no chance; infinite without freedom."""
    return np.where(freedom > 0, chdtri(np.maximum(freedom, 1), SIGNIFICANT), np.inf)


@lru_cache
def noncentrality(freedom: int, power: float = POWER) -> float:
    """Mean by which an error must raise χ² to be found with some probability."""
    if not freedom:
        return np.inf
    return float(chndtrinc(chdtri(freedom, SIGNIFICANT), freedom, 1 - power))
