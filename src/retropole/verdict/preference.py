"""Comparison of two poses by the fit of the surfaces of both clouds, and its significance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..adjustment.descent import CLOSE
from ..adjustment.refinement import Refinement
from ..alignment.adjustment import BeamAlignment
from ..base import se3
from ..base.datatypes import Array, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.quantities import error
from ..surfaces.patch_pairs import CLUSTER_SIDE, MAX_NORMAL_ANGLE, labels_of
from ..surfaces.patches import SPAN, Patches, selected, surface_patches

NEAR_POLES = 10.0
"""Distance from a pole up to which `check_near_poles` uses surfaces, metres: the pose from the
poles is most accurate there."""

MAX_WORSE, MIN_SIGMAS = 0.05, 2.0
"""Surfaces near the poles conflict with a refined pose if they are farther from each other under it
than under that of the poles: by this mean difference of their losses, and by this many times its 1
σ. In 45 honest recordings of the simulator's field (six scenes, seeds 0 to 7) the mean difference
was at most 0.0007; a tilt by 0.6° and a lift by 6 cm make 0.1 to 0.25, and 2.8 σ or more."""


def check_near_poles(aligned: BeamAlignment | None, refined: Refinement | None) -> None:
    """Refuse a refined pose under which ground and walls near the poles fit worse.

    Far surfaces may bias the refinement. Near the poles the pose from the poles is hardly off,
    and the surfaces there must fit at least as well under the refined one: the former is applied
    to the recorded points, the latter to points corrected for the estimated errors of the LiDARs.

    Parameters
    ----------
    aligned, refined
        The pose from the poles, and the refined one; None if the scene gave no information.

    Raises
    ------
    Refusal
        ``scene_contradicts``.
    """
    if aligned is None or refined is None or not len(aligned.axis_points):
        return
    T, T_poles = refined.pose.T_target_source, aligned.pose.T_target_source
    tree = cKDTree(aligned.axis_points)
    source = refined.surfaces[1].centres
    near = np.isfinite(tree.query(se3.apply(T_poles, source), distance_upper_bound=NEAR_POLES)[0])
    if not near.any():
        return
    places = labels_of(np.floor(source[near] / CLUSTER_SIDE))
    own, by_poles = (
        _losses(patches[0], cKDTree(patches[0].centres), selected(patches[1], near), each)
        for patches, each in ((refined.corrected, T), (refined.surfaces, T_poles))
    )
    worse, sigmas = float(np.mean(own - by_poles)), _studentised(own - by_poles, places)
    if worse <= MAX_WORSE or sigmas <= MIN_SIGMAS:
        return
    moved = se3.difference(T_poles, T)
    raise Refusal(
        "scene_contradicts",
        f"far surfaces move the pose {error(moved.translation, 'm')} and "
        f"{error(moved.rotation, 'rad')} away from the poles, but ground and walls within "
        f"{NEAR_POLES:g} m of the poles fit worse there, by {sigmas:.1f} σ ({MIN_SIGMAS:g} are "
        "allowed): record where there are more objects, or use only the poles with --no-refine",
        {"worse": worse, "sigmas": sigmas, "allowed": MIN_SIGMAS, "places": int(places.max()) + 1},
    )


def preferences(
    target: PointCloud, source: PointCloud, T: Array, others: Sequence[Array]
) -> tuple[float, ...]:
    """How much better the surfaces fit under one pose than under each of some others.

    Every patch of the source has a loss ``r²/(r² + w²)`` by its distance r from the target's
    surface, 1 if there is none near. The difference of the losses under both poses is summed over
    all patches, in units of its 1 σ; patches at one place may be correlated in any way.

    Parameters
    ----------
    target, source
        Clouds, each in the frame of its LiDAR.
    T, others
        (4, 4) the one pose, and the others.

    Returns
    -------
    tuple of float
        Positive if the first pose fits better; 0 if the clouds give no information.
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
    distance, near = tree.query(moved, distance_upper_bound=SPAN)
    met = np.isfinite(distance)
    at = np.where(met, near, 0)
    cosine = np.abs(np.einsum("mi,mi->m", source.normals @ T[:3, :3].T, target.normals[at]))
    across = np.einsum("mi,mi->m", moved - target.centres[at], target.normals[at])
    return np.where(
        met & (cosine > np.cos(MAX_NORMAL_ANGLE)), across**2 / (across**2 + CLOSE**2), 1.0
    )


def _studentised(gains: Array, places: IntArray) -> float:
    """Sum of the gains (M,) over its 1 σ, with those of one place combined."""
    by_place = np.bincount(places, gains)
    return float(by_place.sum() / max(float(np.linalg.norm(by_place)), 1e-12))
