"""What each place of the scenes says of the poses, and how the answer changes without it.

Residuals at one place may be correlated in any way, since they are of the same wall, and of the
same LiDAR's returns. With the errors of the LiDARs eliminated from the information S of the poses
and from the pull g_c of a place, ``d_c = (S − S_c)⁻¹ g_c`` is how far the answer goes without all
residuals there, and ``Σ_c d_c d_cᵀ`` their covariance (the jackknife over clusters, Bell and
McCaffrey 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..alignment.certainty import (
    POLES,
    Part,
    few_freedom,
    floors,
    part_of,
    parts_of_errors,
    parts_of_poles,
    sways,
)
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..surfaces.patch_pairs import CLUSTER_SIDE, labels_of
from .descent import End, RefinementProblem, SceneTerm

PLACE_BIAS = 0.0005
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
downsampling, which keeps more of the far tail of the noise than of the middle."""

SCATTER, FLAT = "scatter of the surfaces", "surfaces that are not flat"
"""What the budget calls the two parts of the scenes."""


@dataclass(frozen=True, eq=False)
class Places:
    """What each of C places says of F parameters, with the errors of the LiDARs eliminated.

    Attributes
    ----------
    covariance
        (F, F) of the parameters, as all information there is has it.
    marginal
        (F, F) its inverse.
    information
        (C, F, F) what each place has of it.
    gradients
        (C, F) how it pulls at the answer.
    flat
        (C, F) how a step of all its residuals by 1 m does.
    """

    covariance: Array
    marginal: Array
    information: Array
    gradients: Array
    flat: Array


def labels_of_places(end: End) -> list[IntArray]:
    """Number the places of all pairs' patches: (P,) of each pair.

    Those of one pair are the source's; several pairs see the same in the frame that all share.
    """
    if len(end.scene) == 1:
        return [end.scene[0].pairs.cluster]
    at = [se3.apply(end.T[term.lidars[0]], term.pairs.at) for term in end.scene]
    labels = labels_of(np.floor(np.concatenate(at) / CLUSTER_SIDE))
    return np.split(labels, np.cumsum([len(each) for each in at])[:-1])


def residuals_of(term: SceneTerm, end: End) -> Array:
    """(P,) of unit weight of a pair's patches, freed of the errors as they were estimated."""
    errors = np.r_[np.zeros(len(end.search)), end.errors][term.place]
    return np.asarray(term.weighed.residuals + term.by_step(errors))


def places_of(
    end: End,
    terms: Sequence[SceneTerm],
    gains: Sequence[Array],
    covariance: Array,
    labels: Sequence[IntArray],
) -> Places:
    """Sum what the pairs of patches of each place say of some parameters.

    Parameters
    ----------
    end
        The answer.
    terms
        The scenes that the parameters were estimated with.
    gains
        (F, 12 + B) of each term: from slopes of the unknowns at its place to the parameters.
    covariance
        (F, F) of the parameters, as all information there is has it.
    labels
        (P,) of each term, as `labels_of_places` has them.
    """
    size, count = len(covariance), 1 + max(int(own.max()) for own in labels)
    marginal = np.asarray(np.linalg.inv(covariance))
    information = np.zeros((count, size, size))
    gradients, flat = np.zeros((count, size)), np.zeros((count, size))
    for term, gain, own in zip(terms, gains, labels, strict=True):
        by_step = term.by_step(gain.T @ marginal)
        order = np.argsort(own, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(own[order]) > 0])
        at = own[order][starts]
        pulls = by_step * residuals_of(term, end)[:, None]
        gradients[at] += np.add.reduceat(pulls[order], starts)
        by_metre = by_step * np.sqrt(term.weighed.weights)[:, None]
        flat[at] += np.add.reduceat(by_metre[order], starts)
        for p, rows in zip(at, np.split(order, starts[1:]), strict=True):
            information[p] += by_step[rows].T @ by_step[rows]
    return Places(covariance, marginal, information, gradients, flat)


def places_of_poses(end: End) -> Places:
    """Sum what all places say of the poses that are estimated."""
    inverse = end.inverse
    free = np.flatnonzero(np.diag(inverse)[: len(end.search)] > 0)
    gains = [inverse[np.ix_(free, term.place)] for term in end.scene]
    return places_of(end, end.scene, gains, inverse[np.ix_(free, free)], labels_of_places(end))


def moved_by(places: Places) -> tuple[Array, Array]:
    """What the scatter of the surfaces does to the parameters, and that they are not flat.

    Returns
    -------
    scatter, flat
        (F, C) with a column for each place; covariances are their squares.
    """
    left = places.marginal - places.information
    moves = np.linalg.solve(left, places.gradients[:, :, None])[:, :, 0]
    share = np.sum(moves * (moves @ places.marginal), axis=1)
    freedom = float(share.sum() ** 2 / max(float(np.sum(share**2)), 1e-300))
    # A LiDAR has six parameters of its own, whatever the number of all.
    wide = np.sqrt(few_freedom(freedom))
    return moves.T * wide, places.covariance @ places.flat.T * PLACE_BIAS


def parts_of_surfaces(end: End) -> list[Part]:
    """Say what the surfaces do to all poses: nothing where no scene has a part."""
    if not end.scene:
        return []
    free = np.flatnonzero(np.diag(end.inverse)[: len(end.search)] > 0)
    found = []
    for name, moved in zip((SCATTER, FLAT), moved_by(places_of_poses(end)), strict=True):
        root = np.zeros((len(end.search), moved.shape[1]))
        root[free] = moved
        found.append(part_of(name, root, is_random=name == SCATTER))
    return found


def parts_of(problem: RefinementProblem, end: End, scatter: str = POLES) -> tuple[Part, ...]:
    """Say what every source of error does to all poses.

    Parameters
    ----------
    problem, end
        What was minimised, and where it ended.
    scatter
        What that of the poles' returns is called.
    """
    factor = problem.factor.about(end.T)
    return (
        *parts_of_errors(problem.groups, end.sigma, end.precision, end.inverse, end.errors),
        *parts_of_surfaces(end),
        *parts_of_poles(scatter, factor, end.inverse),
        *floors(end.T, factor.free),
        *sways(end.T, factor.free, factor.left),
    )
