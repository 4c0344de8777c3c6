"""Down to the poses that poles and scenes agree on: one linear problem after the other.

Minimised together over the steps x of all poses and the errors b of all LiDARs:

    Σ_i w_i ρ( n_i · (R c_i + t − d_i) + D_i b )  +  ½ zᵀΛz − ηᵀz  +  ½ bᵀB⁻¹b,    z = [x, b]

with R, t the pose of one LiDAR of a pair in the other's frame, c_i the centre of a patch of the
one, d_i of the other's surface near it, n_i the mean of their normals, and Λ, η what the poles (and
a survey) say. A direction that the scenes do not hold (along a corridor, over open ground) has no
part in the first sum and stays where the poles put it. The sizes of the errors are estimated too.
Coarse to fine: a patch looks for its partner as far as the pose is still uncertain there.

`SceneTerm` is the information of the scene of two LiDARs about their poses: shared surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..alignment.certainty import group_scales, prior_precision, working_sigma
from ..alignment.network import PoleFactor
from ..alignment.solver import MAX_ITERATIONS, inverse_of
from ..alignment.unknowns import POSE, Unknowns
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.se3 import joint_of, relative, relative_jacobian
from ..base.systematic import Groups, Layout
from ..surfaces.patch_pairs import (
    MIN_PATCHES,
    PatchPairs,
    PatchSets,
    every_nth_patch,
    pair_patches,
    prepare_patches,
    without_rings,
)
from ..surfaces.patches import Patches
from ..surfaces.weights import Weighed, weigh

FEW = 4
"""Where a part of the patches is enough it is every n-th of each second LiDAR."""


@dataclass(frozen=True, eq=False)
class ScenePair:
    """Patches of two LiDARs, made ready to be paired; `few` has some of these patches."""

    lidars: tuple[int, int]
    sets: PatchSets
    few: PatchSets

    def without_rings(self) -> ScenePair:
        """Give the same without the errors of single rings."""
        return ScenePair(self.lidars, without_rings(self.sets), without_rings(self.few))


def scene_pairs(patches: Sequence[Patches | None], lidars: Sequence[int]) -> list[ScenePair]:
    """Make every two of some LiDARs ready whose surfaces may be compared.

    Parameters
    ----------
    patches
        Of each LiDAR, in its frame; None if it recorded nothing.
    lidars
        Which of them are compared.
    """
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
        found.append(ScenePair((i, j), sets, every_nth_patch(sets, FEW)))
    return found


@dataclass(frozen=True, eq=False)
class SceneTerm:
    """Information of the scene of one pair at some poses.

    Attributes
    ----------
    lidars
        The pair.
    sets
        Patches of both.
    weighed
        Those that correspond, and their information about the pose of the second LiDAR in the frame
        of the first, and of the errors.
    by_poses
        (6, 12) derivative of that pose by steps of both.
    place
        (12 + B,) poses of both, and errors.
    """

    lidars: tuple[int, int]
    sets: PatchSets
    weighed: Weighed
    by_poses: Array
    place: IntArray

    @property
    def pairs(self) -> PatchPairs:
        """Patches that correspond."""
        return self.weighed.pairs

    def by_step(self, directions: Array) -> Array:
        """(P, M) change of the residuals of unit weight by directions (12 + B, M) of `place`."""
        pose, errors = self.by_poses @ directions[: 2 * POSE], directions[2 * POSE :]
        return self.weighed.by(np.concatenate([pose, errors]))

    def _at_place(self, own: Array) -> Array:
        """Take (6 + B, ...) by the relative pose and the errors to (12 + B, ...) of `place`."""
        return np.concatenate([self.by_poses.T @ own[:POSE], own[POSE:]])

    @property
    def information(self) -> Array:
        """(12 + B, 12 + B) of the unknowns at `place`."""
        return self._at_place(self._at_place(self.weighed.square).T)

    def slope(self, values: Array, poses: int) -> Array:
        """(12 + B,) of the logarithm of the likelihood at the poses it was taken at, under errors.

        Parameters
        ----------
        values
            (K,) of all unknowns, of which those from `poses` on are taken: the errors.
        poses
            How many parameters all poses have.
        """
        errors = np.where(self.place >= poses, values[self.place], 0.0)
        residuals = self.weighed.residuals + self.by_step(errors)
        return -self._at_place(self.weighed.pull(residuals))


def scene_term(
    lidars: tuple[int, int],
    sets: PatchSets,
    T: Array,
    search: Array,
    unknowns: Unknowns,
    origins_known: bool,
) -> SceneTerm | None:
    """Pair the patches of two LiDARs under their poses; None if too few correspond."""
    i, j = lidars
    T_ij, covariance = relative(T[i], T[j], joint_of(search, i, j))
    pairs = pair_patches(sets, T_ij, covariance, origins_known)
    if pairs is None:
        return None
    place = np.r_[unknowns.pose(i), unknowns.pose(j), unknowns.of_layout(sets.layout, lidars)]
    by_poses = relative_jacobian(T[i], T[j])
    return SceneTerm(lidars, sets, weigh(pairs, covariance), by_poses, place)


STEP = 0.04
"""Stop where no step is above this part of the 1 σ that independent residuals would leave. Steps
fall to a half or a third each, so that no more than that is left, and the last is gone whole: of 13
scenes poses moved by up to 0.022 σ from where steps of 5e-8 rad and m end."""

MAX_STRIDE = 4.0
"""Most, and the inverse of the least, of a step that is gone: steps three times too long walk to
and fro, each −2 times the one before, and a third of one is right."""

FEW_STEP = 0.5
"""The approach takes a part of the patches, until no step is above this part."""

NARROWING, INFORMATION_SHARE = 0.06, 4.0
"""Patches look for their partners as far as this many times the variance that independent residuals
would leave, and as this part, from step to step, of the variance that the poles left: narrowed at
once, the search clings to whatever the first step found."""

NARROWED = 0.4
"""The variance that the poles left is not used where it is below this many times the one
that independent residuals leave: a tenth of `INFORMATION_SHARE`. Stopped before, one of 30 sites
(benchmarks/same_answers.py, number 10) ended 4 σ from where it came to rest."""

CLOSE = 0.02
"""Patches at this distance have half weight where answers are compared, metres: twice the range
offset assumed for an unknown LiDAR, and a tenth of the error of a pose by a moved pole."""


@dataclass(frozen=True, eq=False)
class RefinementProblem:
    """What stays the same from step to step: poles, scenes, groups of errors, their sizes (G,).

    `origins_known` as `refinement.refine` has it.
    """

    factor: PoleFactor
    scenes: tuple[ScenePair, ...]
    groups: Groups
    known: Array
    origins_known: bool = False

    def without_rings(self) -> RefinementProblem:
        """Give the same without the errors of single rings.

        An approach does without what moves a pose by millimetres, in a third of the time.
        """
        factor = self.factor.without_bands()
        scenes = tuple(scene.without_rings() for scene in self.scenes)
        return replace(self, factor=factor, scenes=scenes, groups=factor.unknowns.groups())


@dataclass(frozen=True, eq=False)
class End:
    """Where a descent ended.

    Attributes
    ----------
    T
        (L, 4, 4) the poses.
    about
        (L, 4, 4) where patches were paired and the terms of the scenes count from.
    errors
        (B,) of the LiDARs and the radius.
    sigma
        (G,) 1 σ of each group of errors.
    precision
        (B,) of the prior that they were estimated with.
    inverse
        (K, K) of the information of poses and errors; zero where the datum fixes a pose.
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
    converged: bool = False
    iterations: int = 0


def support_of(end: End) -> float:
    """How much of the scenes agrees at an end: the sum of robust weights, each at most 1."""
    return sum(
        float(np.sum(pairs.agreement / (1.0 + square)))
        for pairs in (term.pairs for term in end.scene)
        for square in [pairs.residuals**2 / (pairs.variance + CLOSE**2)]
    )


def minimise(problem: RefinementProblem, T: Array | None = None, *, few: bool = False) -> End:
    """Descend as far as the poles (and a survey) leave the poses undetermined.

    Parameters
    ----------
    problem
        What is minimised; without scenes the poles alone decide.
    T
        (L, 4, 4) where to start; None takes the poses of the poles.
    few
        Whether a part of the patches is enough.
    """
    start = problem.factor.T if T is None else T
    searched = _solve(problem, start, (), problem.known).search
    near = approach(problem.without_rings(), start, searched)
    end = converge(problem, near, searched, few=few)
    # A scene with few patches needs all patches.
    return converge(problem, near, searched) if few and not end.scene else end


def approach(problem: RefinementProblem, T: Array, covariance: Array) -> End:
    """Descend with a part of the patches.

    Parameters
    ----------
    problem
        What is minimised.
    T, covariance
        (L, 4, 4) and (6 L, 6 L) from where, and how far that may be off.
    """
    begin = _Begin(T, covariance, problem.known)
    near = _descend(problem, [each.few for each in problem.scenes], begin, covariance, FEW_STEP)
    if near.scene or not problem.scenes:
        return near
    # A scene with few patches needs all patches.
    return _descend(problem, [each.sets for each in problem.scenes], begin, covariance, FEW_STEP)


def converge(problem: RefinementProblem, near: End, covariance: Array, *, few: bool = False) -> End:
    """Descend from where an approach ended, with rings or without: with all patches to rest.

    Parameters
    ----------
    problem, near
        What is minimised, and from where.
    covariance
        (6 L, 6 L) how far the approach may have been off where it started.
    few
        Whether a part of the patches is enough, and no rest is.
    """
    sets = [each.few if few else each.sets for each in problem.scenes]
    return _descend(problem, sets, near, covariance, FEW_STEP if few else STEP)


class _Begin(NamedTuple):
    """From where a descent starts; see `End`."""

    T: Array
    search: Array
    sigma: Array
    iterations: int = 0


def _descend(
    problem: RefinementProblem,
    scenes: Sequence[PatchSets],
    begin: _Begin | End,
    covariance: Array,
    tolerance: float,
) -> End:
    """Gauss–Newton steps of the poses, the errors and their sizes, until one is small."""
    T, search, sigma, begun = begin.T, begin.search, begin.sigma, begin.iterations
    unknowns, free = problem.factor.unknowns, problem.factor.free
    before: Array | None = None
    end: End | None = None
    for iteration in range(begun + 1, begun + MAX_ITERATIONS + 1):
        # The terms of a step are most of what a site keeps in memory: those before are let go.
        end = None
        found = (
            scene_term(each.lidars, sets, T, search, unknowns, problem.origins_known)
            for each, sets in zip(problem.scenes, scenes, strict=True)
        )
        end = _solve(problem, T, tuple(term for term in found if term is not None), sigma)
        step = se3.local(T, end.T).reshape(-1)
        scaled = step[free] / np.sqrt(np.diag(end.inverse)[: len(step)][free])
        # Before it has narrowed, the search may rest on what is no partner.
        wide = NARROWING ** (iteration - 1) * np.diag(covariance)[free]
        is_narrow = bool(np.all(wide < NARROWED * np.diag(end.inverse)[: len(step)][free]))
        small = is_narrow and bool(np.abs(scaled).max(initial=0.0) < tolerance)
        stride, before = _stride_of(scaled, before)
        # The last step is whole: the answer solves the problem that its covariance is of.
        T = end.T if small else se3.retract(T, (stride * step).reshape(-1, POSE))
        narrowed = NARROWING**iteration * covariance
        search = INFORMATION_SHARE * end.inverse[: len(step), : len(step)] + narrowed
        sigma = end.sigma
        end = replace(end, T=T, search=search, converged=small, iterations=iteration)
        if small:
            break
    assert end is not None
    return end


def _stride_of(scaled: Array, before: Array | None) -> tuple[float, Array | None]:
    """How much of a step, in σ, to go, and what of it to remember for the next (Aitken 1926).

    Weights and partners change with the pose, so that each step is followed by a smaller one in the
    same direction, or back where it was too long. Of two steps the second shows the ratio, and
    thereby the sum of all to come.
    """
    if before is None:
        return 1.0, scaled
    ratio = float(scaled @ before / max(float(before @ before), 1e-300))
    return 1.0 / min(max(1.0 - ratio, 1.0 / MAX_STRIDE), MAX_STRIDE), None


def _solve(problem: RefinementProblem, T: Array, terms: tuple[SceneTerm, ...], sigma: Array) -> End:
    """Solve the problem about some poses, and estimate the sizes of the errors."""
    working = working_sigma(problem.groups, sigma, poles_alone=not terms)
    precision = prior_precision(problem.groups, working)
    # The poles count from where they were expanded, the scenes' terms from here.
    factor = problem.factor.about(T)
    poses, free = factor.unknowns.poses, factor.estimated
    information, gradient = factor.information, factor.vector
    index = np.arange(poses, len(gradient))
    information[index, index] += precision
    nothing = np.zeros(len(gradient))
    for term in terms:
        information[np.ix_(term.place, term.place)] += term.information
        np.add.at(gradient, term.place, term.slope(nothing, poses))
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = inverse_of(information[np.ix_(free, free)])
    best = inverse @ gradient
    errors, variance = best[poses:], np.diag(inverse)[poses:]
    sizes = group_scales(problem.groups, problem.known, precision, errors, variance)
    search = inverse[:poses, :poses]
    moved = se3.retract(T, best[:poses].reshape(-1, POSE))
    return End(moved, T, errors, sizes, precision, inverse, search, terms)
