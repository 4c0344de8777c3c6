"""All unknowns of a site at the answer, axes and control points too, and what is known of them.

Also how the answer changes, to first order, without one placement, and without one place of the
scenes. Residuals at one place may be correlated in any way, since they are of the same wall, and of
the same LiDAR's returns. With the errors of the LiDARs eliminated from the information S of the
poses and from the pull g_c of a place, ``d_c = (S − S_c)⁻¹ g_c`` is how far the answer goes without
all residuals there, and ``Σ_c d_c d_cᵀ`` their covariance (the jackknife over clusters, Bell and
McCaffrey 2002).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..alignment.adjustment import MAX_TRANSLATION_SIGMA
from ..alignment.certainty import (
    POLES,
    Part,
    considered,
    few_freedom,
    floors,
    part_of,
    parts_of_errors,
    parts_of_poles,
    sways,
)
from ..alignment.network import Network, Observation, about, factor_of
from ..alignment.solver import inverse_of
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.systematic import Groups
from ..surfaces.patch_pairs import CLUSTER_SIDE, labels_of
from .answer import WithoutPlacement
from .descent import End, RefinementProblem, SceneTerm

PLACE_BIAS = 0.0005
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
downsampling, which keeps more of the far tail of the noise than of the middle."""

SCATTER, FLAT = "scatter of the surfaces", "surfaces that are not flat"
"""What the budget calls the two parts of the scenes."""


@dataclass(frozen=True, eq=False)
class Places:
    """Information of each of C places about F parameters, with the errors of the LiDARs eliminated.

    Attributes
    ----------
    covariance
        (F, F) of the parameters, as all information there is has it.
    marginal
        (F, F) its inverse.
    information
        (C, F, F) the part of each place.
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
    """Sum what the pairs of patches of each place show of some parameters.

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
        order = np.argsort(own, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(own[order]) > 0])
        at = own[order][starts]
        by_step = term.by_step(gain.T @ marginal)[order]
        pulls = by_step * residuals_of(term, end)[order, None]
        gradients[at] += np.add.reduceat(pulls, starts)
        by_metre = by_step * np.sqrt(term.weighed.weights)[order, None]
        flat[at] += np.add.reduceat(by_metre, starts)
        for p, rows in zip(at, np.split(by_step, starts[1:]), strict=True):
            information[p] += rows.T @ rows
    return Places(covariance, marginal, information, gradients, flat)


def places_of_poses(end: End) -> Places:
    """Sum the information of all places about the poses that are estimated."""
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
    # A LiDAR has six parameters, whatever the number of all.
    wide = np.sqrt(few_freedom(freedom))
    return moves.T * wide, places.covariance @ places.flat.T * PLACE_BIAS


def parts_of_surfaces(end: End) -> list[Part]:
    """State the effect of the surfaces on all poses: nothing if no scene has a part."""
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


@dataclass(frozen=True, eq=False)
class Solved:
    """All unknowns of a site at the answer.

    Attributes
    ----------
    network
        The observations, in steps from the answer.
    values
        (Z,) the unknowns.
    inverse
        (Z, Z) of all information; zero where the datum fixes a pose.
    wide
        (Z, R) errors that are considered and not estimated, each of 1 σ.
    sigma
        (B,) 1 σ of each error.
    remainder
        (Z,) slope of everything together by the unknowns at the answer: zero but for what the
        iterations left.
    scene_information
        (Z, Z) what of all information is the scene's.
    scene
        (Z, R) steps of all unknowns that the scatter of the surfaces makes, and that they are not
        flat, each of 1 σ: a wall's patches are not independent observations, and that information
        promises too much where they alone decide.
    """

    network: Network
    values: Array
    inverse: Array
    wide: Array
    sigma: Array
    remainder: Array
    scene_information: Array
    scene: Array

    @cached_property
    def by_wide(self) -> Array:
        """(Z, R) how far the errors that are considered move the slope of all observations."""
        return np.asarray(self.network.total()[0] @ self.wide)

    def slope(self, one: Observation) -> Array:
        """(P,) slope of an observation's log-likelihood at the answer."""
        away = (self.values - self.network.start)[one.place]
        return np.asarray(one.gradient - one.information @ away)


@dataclass(frozen=True, eq=False)
class Axis:
    """An adjusted axis of a pole.

    Attributes
    ----------
    point, direction
        (3,) in the frame of the site.
    covariance
        (4, 4) of the point along two directions across the axis, and of its direction likewise.
    """

    point: Array
    direction: Array
    covariance: Array

    def nearest(self, at: Array) -> Array:
        """(3,) point of the axis that is nearest to another."""
        return np.asarray(self.point + self.direction * ((at - self.point) @ self.direction))

    def sigma_at(self, at: Array) -> float:
        """1 σ across the axis at one of its points, metres, the way that it is largest."""
        by = np.hstack([np.eye(2), (at - self.point) @ self.direction * np.eye(2)])
        return _largest_sigma(by @ self.covariance @ by.T)

    @property
    def direction_sigma(self) -> float:
        """1 σ of the direction, rad, the way that it is largest."""
        return _largest_sigma(self.covariance[2:, 2:])


def _largest_sigma(covariance: Array) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def axes_of(at: Solved) -> list[Axis]:
    """Give the axes of all poles as they were adjusted."""
    state, unknowns = at.network.state, at.network.unknowns
    tangents = state.of(0, np.arange(unknowns.axes)).tangents
    found = []
    for k in range(unknowns.axes):
        own = unknowns.axis(np.array([k]))
        step = at.values[own].reshape(2, 2) @ tangents[k].T
        direction = state.directions[k] + step[1]
        # What is considered and not estimated moves the axes as well.
        wide = at.inverse[own] @ at.by_wide
        covariance = at.inverse[np.ix_(own, own)] + wide @ wide.T
        direction /= np.linalg.norm(direction)
        found.append(Axis(state.points[k] + step[0], direction, covariance))
    return found


def solve_all(network: Network, end: End, groups: Groups, parts: Sequence[Part]) -> Solved:
    """Solve for all unknowns, axes and control points too, at the answer.

    Parameters
    ----------
    network, end
        What was adjusted, and where it ended.
    groups
        The errors.
    parts
        Every source of error, those of the surfaces among them.
    """
    network = about(network, end.T)
    unknowns, poses = network.unknowns, network.unknowns.poses
    information, gradient = network.total()
    kept = np.r_[np.zeros(poses), end.errors]
    gone = slice(unknowns.kept, None)
    start = network.start
    pull = gradient[gone] - information[gone, : unknowns.kept] @ (kept - start[: unknowns.kept])
    values = np.r_[kept, start[gone] + np.linalg.solve(information[gone, gone], pull)]
    remainder = gradient - information @ (values - start)
    index = np.arange(poses, unknowns.kept)
    information[index, index] += end.precision
    remainder[index] -= end.precision * end.errors
    by_scene = np.zeros_like(information)
    for term in end.scene:
        by_scene[np.ix_(term.place, term.place)] += term.information
        np.add.at(remainder, term.place, term.slope(values, poses))
    information += by_scene
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.size - poses, dtype=bool)])
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = inverse_of(information[np.ix_(free, free)])
    sigma = considered(groups, end.sigma)
    which = np.flatnonzero(sigma)
    wide = np.zeros((unknowns.size, len(which)))
    wide[poses + which, np.arange(len(which))] = sigma[which]
    # What moves the poses by this moves everything else with them.
    moved = np.flatnonzero(network.free)
    surfaces = [part.root for part in parts if part.name in (SCATTER, FLAT)]
    by_scene_moved = np.hstack([np.zeros((poses, 0)), *surfaces])[moved]
    along = inverse[:, moved] @ np.linalg.solve(inverse[np.ix_(moved, moved)], by_scene_moved)
    return Solved(
        network, values, inverse, wide, end.sigma[groups.label], remainder, by_scene, along
    )


GONE = 1.0
"""Precision of axes that nothing is left of, to keep the equations solvable."""


def without_placements(network: Network, end: End, placements: int) -> Iterator[WithoutPlacement]:
    """Solve again without the returns of each placement; nothing of a site with one.

    Parameters
    ----------
    network, end
        What was adjusted, and where it ended.
    placements
        How many there are.
    """
    if placements < 2:
        return
    unknowns, poses = network.unknowns, network.unknowns.poses
    index = np.arange(poses, unknowns.kept)
    free = factor_of(network).estimated
    network = about(network, end.T)
    here = np.r_[np.zeros(poses), end.errors]
    for p in range(placements):
        left = {k for k, one in enumerate(network.observations) if one.placement == p}
        factor = factor_of(network.without(left), ridge=GONE)
        information = factor.information
        slope = factor.vector - information @ here
        information[index, index] += end.precision
        slope[index] -= end.precision * end.errors
        for term in end.scene:
            information[np.ix_(term.place, term.place)] += term.information
            np.add.at(slope, term.place, term.slope(here, poses))
        yield _changed(p, information[np.ix_(free, free)], slope[free], free, poses)


def _changed(
    placement: int, information: Array, slope: Array, free: IntArray, poses: int
) -> WithoutPlacement:
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information / np.outer(scale, scale) + 1e-12 * np.eye(len(scale))
    inverse = inverse_of(scaled) / np.outer(scale, scale)
    own = free < poses
    if np.sqrt(np.diag(inverse)[own].max()) > MAX_TRANSLATION_SIGMA:
        return WithoutPlacement(placement, None, None, None)
    step = np.zeros(poses)
    step[free[own]] = (inverse @ slope)[own]
    rows = step.reshape(-1, POSE)
    turned, moved = (np.linalg.norm(rows[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    lidar = int(np.argmax(moved))
    return WithoutPlacement(placement, float(turned.max()), float(moved.max()), lidar)
