"""The likelihood of a LiDAR's returns on poles to second order: by pose, its errors, and axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..base.datatypes import Array, IntArray
from ..base.systematic import RADIUS, RING, WIDTH, Layout, band_of, by_error
from .likelihood import closest_approach
from .observations import Beams
from .posterior import SHARED, BeamGeometry, State, own_geometry
from .unknowns import POSE
from .views import Average, View, average_passed, average_returns

WIDTH_STEP = 0.01
"""Of the logarithm of the width of a beam, over which its derivatives are taken as differences."""


def expand_lidar(
    state: State, lidar: int, one: Beams, view: View, layout: Layout
) -> tuple[Array, Array, Array]:
    """Expand the likelihood of one LiDAR's beams: information, gradient, inliers on each pole.

    Over pose, errors and axes; the target (0) has no part in the pose. In some
    directions there may be less information than none; see `semidefinite`.
    """
    seen, beside = own_geometry(state, lidar, one)
    on = with_width(lambda by: average_returns(seen, one.wider(by), state.radius, view))
    passed = with_width(lambda by: average_passed(beside, one.wider(by), state.radius, view))
    J = _jacobian(state, lidar, seen, one.directions, one.ranges, one, one.pole, layout)
    size = J.shape[2]
    flat = J.reshape(-1, size)
    information = flat.T @ (on.information @ J).reshape(-1, size)
    gradient = on.score.reshape(-1) @ flat
    if len(one.passed_pole):
        far = np.zeros(len(one.passed_pole))
        own = one.passed_pole
        J = _jacobian(state, lidar, beside, one.passed_directions, far, one, own, layout)[:, 1:]
        flat = J.reshape(-1, size)
        information = information + flat.T @ (passed.information @ J).reshape(-1, size)
        gradient = gradient + passed.score.reshape(-1) @ flat
    inliers = np.bincount(one.pole, on.inlier, len(state.points)).astype(np.float64)
    return np.asarray(information), np.asarray(gradient), inliers


def with_width(average_at: Callable[[float], Average]) -> Average:
    """Add the logarithm of the beams' width to what an average is derived by, as the last.

    Parameters
    ----------
    average_at
        The average where the beams are ``exp(by)`` times as wide.
    """
    less, now, more = (average_at(by) for by in (-WIDTH_STEP, 0.0, WIDTH_STEP))
    slope = (more.log - less.log) / (2 * WIDTH_STEP)
    mixed = (less.score - more.score) / (2 * WIDTH_STEP)
    bent = (2 * now.log - less.log - more.log) / WIDTH_STEP**2
    information = np.concatenate([now.information, mixed[:, None, :]], axis=1)
    last = np.concatenate([mixed, bent[:, None]], axis=1)
    return replace(
        now,
        score=np.concatenate([now.score, slope[:, None]], axis=1),
        information=np.concatenate([information, last[:, :, None]], axis=2),
    )


def semidefinite(information: Array, eigenvalues: Callable[[Array], Array]) -> Array:
    """Give an information (P, P) other eigenvalues where it has less than none in some direction.

    They are those of the information with a diagonal of ones, so that units make no difference.
    """
    scale = np.sqrt(np.abs(np.diag(information)))
    used = np.flatnonzero(scale > 0)
    block = np.ix_(used, used)
    by_scale = np.outer(scale[used], scale[used])
    size, way = np.linalg.eigh(information[block] / by_scale)
    left: Array = np.zeros_like(information)
    left[block] = (way * eigenvalues(size)) @ way.T * by_scale
    return left


def _jacobian(
    state: State,
    lidar: int,
    seen: BeamGeometry,
    directions: Array,
    ranges: Array,
    beams: Beams,
    own: IntArray,
    layout: Layout,
) -> Array:
    """Derivative (N, 4, P) of depth, offset, radius and log-width by pose, errors and axes."""
    T = state.T if lidar else np.eye(4)
    R, t = T[:3, :3], T[:3, 3]
    q, n = ((state.points - t) @ R)[own], (state.directions @ R)[own]
    by = closest_approach(beams.origin, directions, q, n)
    ahead = by.ranges - ranges + state.offsets[lidar]
    by_axis = np.stack(
        [
            by.sine[:, None] * by.ranges_by_axis + ahead[:, None] * by.sine_by_axis,
            by.lateral_offset_by_axis,
        ],
        axis=1,
    )
    # Turning the beam about its origin is turning the axis the other way.
    arm = (q - beams.origin)[:, None, :]
    by_rotation = -np.cross(arm, by_axis[:, :, :3]) - np.cross(n[:, None, :], by_axis[:, :, 3:])
    raising = np.cross(directions, beams.axis)
    raising /= np.maximum(np.linalg.norm(raising, axis=1), 1e-9)[:, None]
    by_range = np.stack([-by.sine, 0.0 * by.sine], axis=1)
    device, ring = by_error(
        by_range,
        by_rotation @ beams.axis,
        np.einsum("nki,ni->nk", by_rotation, raising),
        directions,
        beams.axis,
        ranges,
        np.zeros(len(own)),
        tape=True,
    )
    axes = POSE + layout.size
    J = np.zeros((len(own), 4, axes + seen.jacobian.shape[2] - SHARED))
    J[:, :2, :POSE] = seen.jacobian[:, :, :POSE]
    J[:, :2, POSE:axes][:, :, layout.device(lidar)] = device
    J[:, 2, POSE + RADIUS] = 1.0
    J[:, 3, POSE + layout.device(lidar).start + WIDTH] = 1.0
    J[:, :2, axes:] = seen.jacobian[:, :, SHARED:]
    bands = band_of(directions, beams.axis)
    # Beams that passed may lie in bands that no return is in.
    rows = np.flatnonzero(np.isin(bands, layout.bands[lidar]))
    band = np.searchsorted(layout.bands[lidar], bands)
    for kind in range(RING):
        column = POSE + layout.rings(lidar, kind).start + band[rows]
        J[rows, :2, column] = ring[rows, :, kind]
    return J
