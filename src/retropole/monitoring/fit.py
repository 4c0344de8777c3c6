"""Under which of two poses the surfaces of both clouds fit each other better, and how surely."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from .. import se3
from ..datatypes import Array, IntArray, PointCloud
from ..scene.patch_pairs import CLUSTER_SIDE, MAX_NORMAL_ANGLE, labels_of
from ..scene.patches import Patches, surface_patches

REACH = 0.5
"""A patch belongs to the surface of a patch of the other cloud so near, metres."""

WIDTH = 0.03
"""Distance across the surface at which a patch counts for half, metres: that of a movement that
matters. Nothing counts for more than one, however far it is off."""


def preferences(
    target: PointCloud, source: PointCloud, T: Array, others: Sequence[Array]
) -> tuple[float, ...]:
    """Say how much better the surfaces fit under one pose than under each of some others.

    Every patch of the source has a loss ``r²/(r² + w²)`` by its distance r from the target's
    surface, 1 where it meets none. The difference of the losses under both poses is summed over
    all patches, in units of its own 1 σ; patches at one place may be correlated in any way.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    T, others
        (4, 4) the one pose, and the others.

    Returns
    -------
    tuple of float
        Positive where the first pose fits better; 0 where the clouds do not tell.
    """
    patches = surface_patches(target), surface_patches(source)
    if min(len(one.centres) for one in patches) == 0:
        return (0.0,) * len(others)
    tree = cKDTree(patches[0].centres)
    places = labels_of(np.floor(patches[1].centres / CLUSTER_SIDE))
    own = _losses(patches[0], tree, patches[1], T)
    return tuple(
        _studentised(_losses(patches[0], tree, patches[1], other) - own, places) for other in others
    )


def _losses(target: Patches, tree: cKDTree, source: Patches, T: Array) -> Array:
    moved = se3.apply(T, source.centres)
    distance, near = tree.query(moved, distance_upper_bound=REACH)
    met = np.isfinite(distance)
    at = np.where(met, near, 0)
    cosine = np.abs(np.einsum("mi,mi->m", source.normals @ T[:3, :3].T, target.normals[at]))
    across = np.einsum("mi,mi->m", moved - target.centres[at], target.normals[at])
    return np.where(
        met & (cosine > np.cos(MAX_NORMAL_ANGLE)), across**2 / (across**2 + WIDTH**2), 1.0
    )


def _studentised(gains: Array, places: IntArray) -> float:
    """Sum of the gains (M,) over its 1 σ, with those of one place taken together."""
    by_place = np.bincount(places, gains)
    return float(by_place.sum() / max(float(np.linalg.norm(by_place)), 1e-12))
