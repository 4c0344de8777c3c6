"""What the scene of every two LiDARs says of their poses: surfaces that both see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from ..alignment.unknowns import POSE, Unknowns
from ..base.datatypes import Array, IntArray
from ..base.se3 import joint_of, relative, relative_jacobian
from ..base.systematic import Layout
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
    """Patches of two LiDARs, made ready to be paired; `few` has a part of them."""

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
        Of each LiDAR, in its own frame; None where it recorded nothing.
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
    """What the scene of one pair says at some poses.

    Attributes
    ----------
    lidars
        The pair.
    sets
        Patches of both.
    pairs, weighed
        Those that correspond, and what they say of the pose of the second LiDAR in the frame of the
        first, and of the errors.
    by_poses
        (6, 12) derivative of that pose by steps of both.
    place
        (12 + B,) poses of both, and errors.
    """

    lidars: tuple[int, int]
    sets: PatchSets
    pairs: PatchPairs
    weighed: Weighed
    by_poses: Array
    place: IntArray

    def by_step(self, directions: Array) -> Array:
        """(P, M) change of the residuals of unit weight by directions (12 + B, M) of `place`."""
        pose, errors = self.by_poses @ directions[: 2 * POSE], directions[2 * POSE :]
        return self.weighed.by(np.concatenate([pose, errors]))

    def _at_place(self, own: Array) -> Array:
        """Take (6 + B, ...) by the relative pose and the errors to (12 + B, ...) of `place`."""
        return np.concatenate([self.by_poses.T @ own[:POSE], own[POSE:]])

    @cached_property
    def information(self) -> Array:
        """(12 + B, 12 + B) of the unknowns at `place`."""
        return self._at_place(self._at_place(self.weighed.square[:-1, :-1]).T)

    @cached_property
    def slope_without_errors(self) -> Array:
        """(12 + B,) of the logarithm of the likelihood where the errors are zero."""
        return -self._at_place(self.weighed.square[:-1, -1])

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


def scene_term(
    lidars: tuple[int, int],
    sets: PatchSets,
    T: Array,
    search: Array,
    unknowns: Unknowns,
    origins_known: bool,
) -> SceneTerm | None:
    """Pair the patches of two LiDARs under their poses; None where too few correspond."""
    i, j = lidars
    T_ij, covariance = relative(T[i], T[j], joint_of(search, i, j))
    pairs = pair_patches(sets, T_ij, covariance, origins_known)
    if pairs is None:
        return None
    place = np.r_[unknowns.pose(i), unknowns.pose(j), unknowns.of_layout(sets.layout, lidars)]
    by_poses = relative_jacobian(T[i], T[j])
    return SceneTerm(lidars, sets, pairs, weigh(pairs, covariance), by_poses, place)
