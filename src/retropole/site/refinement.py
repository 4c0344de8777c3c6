"""Poles, survey and scenes of all pairs in one problem: the poses that all agree on.

As `scene.refinement` for one pair, over the poses and errors of all LiDARs: the quadratic form of
the network, and the distances between surface patches of every two LiDARs that see the same
surfaces. The errors of a LiDAR are the same in all its pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from ..alignment.certainty import group_scales, prior_precision, working_sigma
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.systematic import Groups, Layout
from ..scene.descent import (
    FEW,
    FEW_STEP,
    INFORMATION_SHARE,
    MAX_REFINEMENT_ITERATIONS,
    NARROWING,
    inverse_of,
    stride_of,
)
from ..scene.patch_pairs import (
    MIN_PATCHES,
    PatchPairs,
    PatchSets,
    pair_patches,
    prepare_patches,
    thinned,
)
from ..scene.patches import Patches, surface_patches
from ..scene.weights import weigh
from .network import Network, marginal, steps_to
from .relative import joint_of, relative, relative_jacobian
from .scans import SiteScans
from .state import POSE
from .unknowns import Unknowns

STEP = 5e-8
"""Stop where a step is below this, rad and m: a quarter of what `scene.descent` takes for a pair.
Forces of poles, survey and scenes that balance each other turn with a step, to first order by half
of it; steps of 2e-7 left 1.3e-6 of 1 σ at one of a hundred sites (tests/site/test_independent.py,
seed 69)."""


@dataclass(frozen=True, eq=False)
class ScenePair:
    """Patches of two LiDARs, made ready to be paired; `few` has a part of them."""

    lidars: tuple[int, int]
    sets: PatchSets
    few: PatchSets


@dataclass(frozen=True, eq=False)
class SceneTerm:
    """What the scene of one pair says at some poses.

    Attributes
    ----------
    lidars
        The pair.
    sets
        Patches of both.
    pairs, weights
        Those that correspond, and the weights (P,) of their residuals, 1/m².
    rows, residuals
        (P, 12 + B) derivative of the residuals by the unknowns at `place`, and (P,) the residuals,
        without what the surfaces do not hold.
    place
        (12 + B,) poses of both, and errors.
    """

    lidars: tuple[int, int]
    sets: PatchSets
    pairs: PatchPairs
    weights: Array
    rows: Array
    residuals: Array
    place: IntArray

    @cached_property
    def information(self) -> Array:
        """(12 + B, 12 + B) of the unknowns at `place`."""
        weighted = self.rows * np.sqrt(self.weights)[:, None]
        return np.asarray(weighted.T @ weighted)

    @cached_property
    def slope_without_errors(self) -> Array:
        """(12 + B,) of the logarithm of the likelihood where the errors are zero."""
        return -np.asarray((self.rows.T * self.weights) @ self.residuals)

    def slope(self, values: Array, poses: int) -> Array:
        """(12 + B,) of the same at the poses it was taken at, under errors.

        Parameters
        ----------
        values
            (K,) of all unknowns, of which those from `poses` on are taken: the errors.
        poses
            How many parameters all poses have.
        """
        errors = np.where(self.place >= poses, values[self.place], 0.0)
        return np.asarray(self.slope_without_errors - self.information @ errors)


@dataclass(frozen=True, eq=False)
class SiteEnd:
    """Where the descent ended.

    Attributes
    ----------
    T
        (L, 4, 4) the poses.
    about
        (L, 4, 4) where patches were paired and the terms of the scene count from.
    errors
        (B,) of the LiDARs and the radius.
    sigma
        (G,) 1 σ of each group of errors.
    precision
        (B,) of the prior that they were estimated with.
    inverse
        (K, K) of the information of poses and errors; zero where the datum holds a pose.
    search
        (6 L, 6 L) covariance as far as which patches look for their partners.
    scene
        The terms of the last step.
    converged, iterations
        Whether the last step was small enough, and how many were taken.
    """

    T: Array
    about: Array
    errors: Array
    sigma: Array
    precision: Array
    inverse: Array
    search: Array
    scene: tuple[SceneTerm, ...]
    converged: bool
    iterations: int


def patches_of(scans: SiteScans) -> list[Patches | None]:
    """Fit surface patches to what each LiDAR recorded; None where it recorded nothing."""
    scenes = [scans.scene(lidar) for lidar in range(len(scans.by_lidar))]
    return [None if scene is None else surface_patches(scene) for scene in scenes]


def scene_pairs(patches: Sequence[Patches | None], lidars: Sequence[int]) -> list[ScenePair]:
    """Make every two of some LiDARs ready whose surfaces may be compared."""
    found = []
    for i, j in combinations(lidars, 2):
        first, second = patches[i], patches[j]
        if first is None or second is None:
            continue
        if min(len(first.centres), len(second.centres)) < MIN_PATCHES:
            continue
        sets = prepare_patches(
            first, second, Layout((np.unique(first.bands), np.unique(second.bands)))
        )
        found.append(ScenePair((i, j), sets, thinned(sets, FEW)))
    return found


def refine_site(
    network: Network,
    pairs: Sequence[ScenePair],
    groups: Groups,
    known: Array,
    start: Array | None = None,
    *,
    few: bool = False,
) -> SiteEnd:
    """Descend to the poses that poles, survey and scenes agree on.

    Parameters
    ----------
    network
        Poles and survey.
    pairs
        Scenes that may be compared; without any the poles and the survey alone decide.
    groups, known
        Errors, and 1 σ (G,) of each group as known beforehand.
    start
        (L, 4, 4) where to start; None takes the poses of the network.
    few
        Whether a part of the patches is enough.
    """
    information, vector = marginal(network)
    problem = _Problem(network, information, vector, groups, known)
    T = network.state.T if start is None else start
    alone = _solve(problem, T, (), known)
    searched = alone.inverse[: network.unknowns.poses, : network.unknowns.poses]
    begin = replace(alone, T=T, search=searched, sigma=known)
    some = [(each.lidars, each.few) for each in pairs]
    near = _descend(problem, some, begin, searched, FEW_STEP)
    if few:
        return near
    every = [(each.lidars, each.sets) for each in pairs]
    return _descend(problem, every, near, searched, STEP)


@dataclass(frozen=True, eq=False)
class _Problem:
    network: Network
    information: Array
    vector: Array
    groups: Groups
    known: Array


def _descend(
    problem: _Problem,
    scenes: Sequence[tuple[tuple[int, int], PatchSets]],
    begin: SiteEnd,
    covariance: Array,
    tolerance: float,
) -> SiteEnd:
    """Gauss–Newton steps of the poses, the errors and their sizes, until one is small."""
    end, T, search, sigma, begun = begin, begin.T, begin.search, begin.sigma, begin.iterations
    before: Array | None = None
    unknowns = problem.network.unknowns
    for iteration in range(begun + 1, begun + MAX_REFINEMENT_ITERATIONS + 1):
        terms = tuple(
            term
            for lidars, sets in scenes
            if (term := _scene_term(lidars, sets, T, search, unknowns)) is not None
        )
        end = _solve(problem, T, terms, sigma)
        step = np.concatenate([se3.local(a, b) for a, b in zip(T, end.T, strict=True)])
        small = bool(np.abs(step).max() < tolerance)
        stride, before = stride_of(step, np.diag(end.inverse)[: len(step)], before)
        # The last step is whole: the answer solves the problem that its covariance is of.
        T = end.T if small else _moved(T, stride * step)
        narrowed = NARROWING**iteration * covariance
        search = INFORMATION_SHARE * end.inverse[: len(step), : len(step)] + narrowed
        sigma = end.sigma
        end = replace(end, T=T, search=search, converged=small, iterations=iteration)
        if small:
            break
    return end


def _moved(T: Array, step: Array) -> Array:
    steps = step.reshape(-1, POSE)
    return np.stack([se3.retract(one, by) for one, by in zip(T, steps, strict=True)])


def _scene_term(
    lidars: tuple[int, int],
    sets: PatchSets,
    T: Array,
    search: Array,
    unknowns: Unknowns,
) -> SceneTerm | None:
    """Pair the patches of two LiDARs under their poses; None where too few correspond."""
    i, j = lidars
    T_ij, covariance = relative(T[i], T[j], joint_of(search, i, j))
    pairs = pair_patches(sets, T_ij, covariance, False)
    if pairs is None:
        return None
    weighed = weigh(pairs, covariance)
    by_poses = weighed.rows[:, :POSE] @ relative_jacobian(T[i], T[j])
    place = np.r_[unknowns.pose(i), unknowns.pose(j), unknowns.of_layout(sets.layout, lidars)]
    rows = np.concatenate([by_poses, weighed.rows[:, POSE:]], axis=1)
    return SceneTerm(lidars, sets, pairs, weighed.weights, rows, weighed.residuals, place)


def _solve(problem: _Problem, T: Array, terms: Sequence[SceneTerm], sigma: Array) -> SiteEnd:
    """Solve the problem about some poses, and estimate the sizes of the errors."""
    network = problem.network
    unknowns, poses = network.unknowns, network.unknowns.poses
    working = working_sigma(problem.groups, sigma, poles_alone=not terms)
    precision = prior_precision(problem.groups, working)
    # The network counts from where it was expanded, the scene's terms from here.
    here, by_step = steps_to(network, T)
    moved, by_move = slice(poses), by_step[:poses, :poses]
    information = problem.information.copy()
    gradient = problem.vector - problem.information[:, moved] @ here[moved]
    gradient[moved] = by_move.T @ gradient[moved]
    information[moved] = by_move.T @ information[moved]
    information[:, moved] = information[:, moved] @ by_move
    index = np.arange(poses, unknowns.kept)
    information[index, index] += precision
    for term in terms:
        information[np.ix_(term.place, term.place)] += term.information
        np.add.at(gradient, term.place, term.slope_without_errors)
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.errors, dtype=bool)])
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = inverse_of(information[np.ix_(free, free)])
    best = inverse @ gradient
    errors = best[poses:]
    variance = np.diag(inverse)[poses:]
    return SiteEnd(
        _moved(T, best[:poses]),
        T,
        errors,
        group_scales(problem.groups, problem.known, precision, errors, variance),
        precision,
        inverse,
        inverse[:poses, :poses],
        tuple(terms),
        False,
        0,
    )
