"""The likelihood of the returns on poles to second order: by poses, LiDARs' errors, and axes.

`pole_factor` eliminates the axes; `compare_axes` asks whether both LiDARs saw them stand alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import Array, IntArray
from ..base.systematic import DEVICE, RADIUS, RING, TAPE, WIDTH, Layout, band_of, by_error
from .factor import OF_SOURCE, PoleFactor, poses_of_pair
from .likelihood import closest_approach
from .observations import Beams
from .posterior import SHARED, BeamGeometry, State, own_geometry
from .unknowns import POSE, Unknowns
from .views import Average, View, average_passed, average_returns

WIDTH_STEP = 0.01
"""Of the logarithm of the width of a beam, over which its derivatives are taken as differences."""


@dataclass(frozen=True, eq=False)
class Expansion:
    """Second-order expansion of the likelihood of the returns about a state, LiDAR by LiDAR.

    Attributes
    ----------
    state, layout
        Where, and the order of the errors.
    errors
        (B,) the errors that the state already has: offsets on tape, and of the radius.
    information, gradient
        For the target and the source, (P, P) and (P,) over pose, errors and axes; the gradient is
        that of the logarithm of the likelihood.
    inliers
        (2, K) how many returns of each LiDAR lie on each pole.
    """

    state: State
    layout: Layout
    errors: Array
    information: tuple[Array, Array]
    gradient: tuple[Array, Array]
    inliers: Array


def expand(state: State, views: Sequence[View], beams: Sequence[Beams], radius: float) -> Expansion:
    """Expand the likelihood of the returns, averaged over what each LiDAR's beams leave open.

    Parameters
    ----------
    state
        The maximum of the posterior.
    views
        Of the target and of the source, about that state.
    beams
        Of the target and of the source.
    radius
        Of the poles as given, metres, from which its error counts.
    """
    bands = [np.unique(band_of(one.directions, one.axis)) for one in beams]
    layout = Layout((bands[0], bands[1]))
    errors = np.zeros(layout.size)
    errors[TAPE], errors[DEVICE + TAPE] = state.offsets
    errors[RADIUS] = state.radius - radius
    found = [
        expand_lidar(state, lidar, one, views[lidar], layout) for lidar, one in enumerate(beams)
    ]
    # What curves upwards says nothing.
    information = [semidefinite(each[0], lambda size: np.maximum(size, 0.0)) for each in found]
    return Expansion(
        state,
        layout,
        errors,
        (information[0], information[1]),
        (found[0][1], found[1][1]),
        np.array([found[lidar][2] for lidar in (0, 1)]),
    )


def pole_factor(expansion: Expansion) -> PoleFactor:
    """Eliminate the axes of the poles from an expansion."""
    axes = POSE + expansion.layout.size
    information = expansion.information[0] + expansion.information[1]
    gradient = expansion.gradient[0] + expansion.gradient[1]
    kept, gone = slice(0, axes), slice(axes, len(gradient))
    eliminated = np.linalg.solve(information[gone, gone], information[gone, kept])
    marginal = information[kept, kept] - information[kept, gone] @ eliminated
    vector = gradient[kept] - eliminated.T @ gradient[gone]
    here = np.r_[np.zeros(POSE), expansion.errors]
    redundancy = float(expansion.inliers.sum()) - POSE - 4.0 * len(expansion.state.points)
    unknowns = Unknowns(expansion.layout.bands, 0, 0)
    place = np.r_[unknowns.pose(1), unknowns.of_layout(expansion.layout, (0, 1))]
    whole, of_whole = np.zeros((unknowns.kept, unknowns.kept)), np.zeros(unknowns.kept)
    whole[np.ix_(place, place)] = marginal
    of_whole[place] = vector + marginal @ here
    T = poses_of_pair(expansion.state.T)
    return PoleFactor(T, unknowns, OF_SOURCE, whole, of_whole, max(redundancy, 1.0))


@dataclass(frozen=True, eq=False)
class AxesTest:
    """Whether both LiDARs see the poles stand to each other alike.

    Attributes
    ----------
    chi2, freedom
        By how much freeing the axes for each LiDAR would raise twice the logarithm of the
        posterior, and how many more parameters that has: χ² where the poles stand alike.
    by_pole
        (K,) the same where only that pole's axis is freed.
    """

    chi2: float
    freedom: int
    by_pole: Array


def compare_axes(expansion: Expansion, precision: Array, considered: Array) -> AxesTest:
    """Test whether the poles stood alike when each LiDAR recorded them (score test, Rao 1948).

    The source's axes get a displacement of their own, beside pose, errors and common axes. Six of
    its directions are the pose's; two poles leave two to test, their angle and their distance.

    Parameters
    ----------
    expansion
        About the maximum.
    precision
        (B,) of the prior of the errors.
    considered
        (B,) 1 σ of errors that are not estimated, and may be the cause all the same; 0 of others.
    """
    axes = POSE + expansion.layout.size
    poles = len(expansion.state.points)
    both = expansion.information[0] + expansion.information[1]
    errors = POSE + np.flatnonzero(considered)
    by_errors = both[:, errors]
    gradient = expansion.gradient[0] + expansion.gradient[1]
    index = np.arange(POSE, axes)
    both[index, index] += precision
    gradient[index] -= precision * expansion.errors
    source = expansion.information[1]

    def gain(own: slice) -> float:
        cross = source[:, own]
        known = np.linalg.solve(both, np.column_stack([cross, gradient]))
        score = expansion.gradient[1][own] - cross.T @ known[:, -1]
        left = source[own, own] - cross.T @ known[:, :-1]
        # What is considered moves the score by so much.
        by = (source[own, errors] - known[:, :-1].T @ by_errors) * considered[errors - POSE]
        left = left + by @ by.T
        return float(score @ np.linalg.pinv(left, rcond=1e-9, hermitian=True) @ score)

    by_pole = [gain(slice(axes + 4 * k, axes + 4 * k + 4)) for k in range(poles)]
    return AxesTest(
        gain(slice(axes, axes + 4 * poles)), max(4 * poles - POSE, 1), np.array(by_pole)
    )


def expand_lidar(
    state: State, lidar: int, one: Beams, view: View, layout: Layout
) -> tuple[Array, Array, Array]:
    """Expand the likelihood of one LiDAR's beams: information, gradient, inliers on each pole.

    Over pose, errors and axes, as in `Expansion`; the target (0) has no part in the pose. In some
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
