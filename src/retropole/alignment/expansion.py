"""The likelihood of a LiDAR's returns on poles to second order: by pose, its errors, and axes.

An axis is averaged over the uncertainty that the beams of one LiDAR leave. Where few returns lie
on a pole, or beams are wide compared with it, the likelihood of its axis is not a parabola but a
box with blurred walls: a return shows that its beam hit the pole, but hardly where. The curvature
at the maximum is that of the wall which happens to be near. Of all normal distributions ``N(d, Σ)``
of the axis, the one closest to the posterior has

    E[∇ log L] = 0,    Σ⁻¹ = −E[∇² log L],

averaged over itself (Opper and Archambeau 2009, The variational Gaussian approximation revisited).
Where many returns leave little uncertainty compared with the blur, it is the parabola at the
maximum. The noise is averaged likewise: returns lie closer to an axis that was fitted to them than
to the true one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray
from ..base.systematic import RADIUS, RING, WIDTH, Layout, band_of, by_error
from .likelihood import FEW_NODES, arc_likelihood, closest_approach, passed_beam_likelihood
from .observations import Beams
from .posterior import RETURN_CURVATURE, SHARED, BeamGeometry, State, damping_of, lidar_geometry
from .unknowns import POSE

MIN_NOISE = 2e-5
"""Least noise of a return, metres."""

MIN_LATERAL_NOISE = 1 / 5
"""Least noise sideways, as a part of that in depth. With less, the edges of the pole are walls: the
posterior is far from a parabola, its curvature promises too much, and the climb takes long."""

MAX_LATERAL_NOISE = 2.0
"""Most noise sideways, as a multiple of that in depth: returns sharp in depth and blurred sideways
would fall between the nodes of the integral."""

WIDEST = 0.1
"""Largest uncertainty of an axis, 1 σ: metres, and of its lean, rad."""

FARTHEST = 2.0
"""Most that a view lies away from the state, in units of the view's 1 σ: that of few returns may
else lose some of them as outliers, and wander off (tests/adjustment/test_blunders.py: a pole that
was pushed by 0.4 m said nothing any more)."""

BLEND, MAX_ROUNDS, CONVERGED = 0.5, 30, 0.1
"""Part of the way that each round goes, rounds at most (some views go to and fro), and the change,
in units of 1 σ and of the information, at which the distribution equals its average. Stated σ are
then within 3 % of those of the limit in all but one of 24 simulated pairs, with a quarter of the
rounds."""

NODES_BY_UNCERTAINTY = {1: 0.02, 3: 0.5, 4: 0.8}
"""Nodes that suffice where no axis is uncertain by more than this many times the noise sideways:
over such a short range the likelihood is all but a parabola, and n nodes are exact to the power 2
n − 1. An exact view has no uncertainty."""

_HERMITE = {n: np.polynomial.hermite_e.hermegauss(n) for n in (*NODES_BY_UNCERTAINTY, FEW_NODES)}


def _nodes_over(sideways: Array, noise: float) -> tuple[Array, Array]:
    """Nodes (M, 1), and their weights (M,), over the uncertainty sideways (N,), 1 σ, metres."""
    most = float(sideways.max(initial=0.0))
    few = (n for n, share in NODES_BY_UNCERTAINTY.items() if most <= share * noise)
    at, weight = _HERMITE[next(few, FEW_NODES)]
    return at[:, None], weight / weight.sum()


@dataclass(frozen=True, eq=False)
class View:
    """Axes of the poles by the beams of one LiDAR alone, as a step from a state's.

    Attributes
    ----------
    shift, covariance
        (K, 4) and (K, 4, 4) of point and direction, in the order of `State.moved`.
    noise
        (2,) of its returns, in depth and sideways, metres.
    """

    shift: Array
    covariance: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Average:
    """Log-likelihood of beams, averaged over a view: derivatives about the state itself.

    Attributes
    ----------
    log
        (N,) the average itself.
    score, information
        (N, C) and (N, C, C) by depth, lateral offset and radius, or by the last two alone.
    inlier, noise
        (N,) and (N, 2) as in `ArcLikelihood`; empty for beams that passed.
    """

    log: Array
    score: Array
    information: Array
    inlier: Array
    noise: Array

    def part(self, some: BoolArray) -> Average:
        """Give that of some of the beams (N,)."""
        own = self.inlier, self.noise
        inlier, noise = (each[some] for each in own) if len(self.inlier) else own
        return Average(self.log[some], self.score[some], self.information[some], inlier, noise)


def exact_view(poles: int, noise: Array) -> View:
    """View without uncertainty: averages over it are the values at the state."""
    return View(np.zeros((poles, 4)), np.zeros((poles, 4, 4)), noise)


def average_returns(seen: BeamGeometry, beams: Beams, radius: float, view: View) -> Average:
    """Average the likelihood of returns on poles over the uncertainty of a view.

    Parameters
    ----------
    seen
        Where they are at the state, by `lidar_geometry`.
    beams
        Of the LiDAR of the view.
    radius
        Of the poles, metres.
    view
        About the state.
    """
    J = _by_axis(seen.jacobian, beams.pole)
    moved = np.einsum("nci,ni->nc", J, view.shift[beams.pole])
    spread = np.einsum("nci,nij,nej->nce", J, view.covariance[beams.pole], J)
    # The depth goes with the lateral offset. What remains adds to the noise alone: in depth
    # the logarithm is all but a parabola.
    sideways = np.sqrt(spread[:, 1, 1])
    depthways = spread[:, 0, 1] / np.maximum(sideways, 1e-12)
    sigma = np.hypot(view.noise[0] * seen.sine, view.noise[1] * np.sqrt(1.0 - seen.sine**2))
    rest = np.maximum(spread[:, 0, 0] - depthways**2, 0.0) / sigma**2
    at, weight = _nodes_over(sideways, float(view.noise[1]))
    # All nodes at once: the arrays are small, and calls cost more than what they compute.
    arc = arc_likelihood(
        (seen.depth + moved[:, 0] + at * depthways).reshape(-1),
        (seen.lateral_offset + moved[:, 1] + at * sideways).reshape(-1),
        np.tile(sigma, len(at)),
        np.full(len(at) * len(sigma), view.noise[1]),
        radius,
        np.tile(beams.half_width, len(at)),
        np.tile(beams.passed_share, len(at)),
    )
    information, inlier = _averaged(arc.information, weight), _averaged(arc.inlier, weight)
    noise = _averaged(arc.inlier[:, None] * arc.noise, weight)
    noise /= np.maximum(inlier, 1e-300)[:, None]
    noise[:, 0] += rest
    score = _averaged(arc.score, weight) + np.einsum("nce,ne->nc", information[:, :, :2], moved)
    return Average(_averaged(arc.log, weight), score, information, inlier, noise)


def average_passed(seen: BeamGeometry, beams: Beams, radius: float, view: View) -> Average:
    """Average as in `average_returns` for beams that passed poles."""
    own, count = beams.passed_pole, len(beams.passed_pole)
    J = _by_axis(seen.jacobian, own)[:, 1]
    moved = np.einsum("ni,ni->n", J, view.shift[own])
    sideways = np.sqrt(np.einsum("ni,nij,nj->n", J, view.covariance[own], J))
    at, weight = _nodes_over(sideways, float(view.noise[1]))
    free = passed_beam_likelihood(
        (seen.lateral_offset + moved + at * sideways).reshape(-1),
        np.full(len(at) * count, view.noise[1]),
        radius,
        np.tile(beams.passed_half_width, len(at)),
    )
    information = _averaged(free.information, weight)
    score = _averaged(free.score, weight) + information[:, :, 0] * moved[:, None]
    log = _averaged(free.log, weight)
    return Average(log, score, information, np.zeros(0), np.zeros((0, 2)))


def _averaged(values: Array, weight: Array) -> Array:
    """Average (M·N, …) values at M nodes, one node after the other, to (N, …)."""
    by_node = values.reshape(len(weight), -1, *values.shape[1:])
    return np.asarray(np.tensordot(weight, by_node, axes=1))


def find_view(
    state: State, lidar: int, beams: Beams, noise: Array, rounds: int = MAX_ROUNDS
) -> View:
    """Find the uncertainty of each axis by the beams of one LiDAR, pose and errors as in the
    state.

    Parameters
    ----------
    state
        The maximum of the posterior, or near it.
    lidar
        0 for the target, 1 for the source.
    beams
        Of this view.
    noise
        (2,) there, in depth and sideways, metres.
    rounds
        Of which no more are taken.
    """
    poles = len(state.points)
    seen, passed_by = lidar_geometry(state, lidar, beams)
    J = _by_axis(seen.jacobian, beams.pole)
    J_passed = _by_axis(passed_by.jacobian, beams.passed_pole)[:, 1:]
    view = exact_view(poles, np.asarray(noise, dtype=np.float64))
    precision: Array | None = None
    for _ in range(rounds):
        on = average_returns(seen, beams, state.radius, view)
        passed = average_passed(passed_by, beams, state.radius, view)
        bent = on.information[:, :2, :2]
        now, slope = np.zeros((poles, 4, 4)), np.zeros((poles, 4))
        for jacobian, information, score, own in (
            (J, bent, on.score[:, :2], beams.pole),
            (J_passed, passed.information[:, :1, :1], passed.score[:, :1], beams.passed_pole),
        ):
            np.add.at(now, own, jacobian.transpose(0, 2, 1) @ information @ jacobian)
            np.add.at(slope, own, np.einsum("nci,nc->ni", jacobian, score))
        # The scores are about the state; here, the slope where the view is.
        slope = slope - np.einsum("kij,kj->ki", now, view.shift)
        if precision is None:
            # At a single place there may be no curvature at all: start with that of the climb.
            least = RETURN_CURVATURE * on.inlier / view.noise[0] ** 2
            more = damping_of(bent, least)[:, None, None]
            np.add.at(now, beams.pole, J.transpose(0, 2, 1) @ (more * J))
        size, way = np.linalg.eigh(now)
        size = np.maximum(size, WIDEST**-2)
        now = np.einsum("kij,kj,klj->kil", way, size, way)
        blended = now if precision is None else (1 - BLEND) * precision + BLEND * now
        covariance = np.linalg.inv(blended)
        step = BLEND * np.einsum("kij,kj->ki", covariance, slope)
        grown = np.einsum("kij,kji->k", covariance, now) / 4 - 1
        wrong = np.sqrt(np.einsum("ki,kij,kj->k", step, blended, step)).max()
        has_converged = precision is not None and max(wrong, np.abs(grown).max()) < CONVERGED
        shift = view.shift + step
        far = np.sqrt(np.einsum("ki,kij,kj->k", shift, blended, shift))
        shift = shift * np.minimum(1.0, FARTHEST / np.maximum(far, FARTHEST))[:, None]
        view = View(shift, covariance, _noise(view.noise, on))
        precision = blended
        if has_converged:
            break
    return view


def _noise(noise: Array, on: Average) -> Array:
    """Noise (2,) that the averaged returns have, within the bounds of that sideways."""
    new = noise * np.sqrt(on.inlier @ on.noise / max(on.inlier.sum(), 1e-300))
    depth = max(new[0], MIN_NOISE)
    lateral = np.clip(new[1], MIN_LATERAL_NOISE * depth, MAX_LATERAL_NOISE * depth)
    return np.array([depth, max(lateral, MIN_NOISE)])


def _by_axis(jacobian: Array, own: IntArray) -> Array:
    """Columns (N, C, 4) of the axis that each beam belongs to."""
    index = SHARED + 4 * own[:, None] + np.arange(4)
    return np.take_along_axis(jacobian, index[:, None, :], axis=2)


WIDTH_STEP = 0.01
"""Of the logarithm of the width of a beam, over which its derivatives are taken as differences."""


def average_lidar(state: State, lidar: int, one: Beams, view: View) -> tuple[Average, Average]:
    """Average the likelihood of one LiDAR's returns, and of its beams that passed, with widths."""
    seen, passed_by = lidar_geometry(state, lidar, one)
    return (
        with_width(lambda by: average_returns(seen, one.wider(by), state.radius, view)),
        with_width(lambda by: average_passed(passed_by, one.wider(by), state.radius, view)),
    )


def expand_lidar(
    state: State, lidar: int, one: Beams, averages: tuple[Average, Average], layout: Layout
) -> tuple[Array, Array, Array]:
    """Expand the likelihood of one LiDAR's beams: information, gradient, inliers on each pole.

    Over pose, errors and axes, from the averages of `average_lidar`; the target (0) has no part in
    the pose. In some directions there may be less information than none; see `semidefinite`.
    """
    on, passed = averages
    # All at once: the arrays are small, and calls cost as much as what they compute.
    J = _jacobian(
        state,
        lidar,
        np.concatenate([each.jacobian for each in lidar_geometry(state, lidar, one)]),
        np.concatenate([one.directions, one.passed_directions]),
        np.concatenate([one.ranges, np.zeros(len(one.passed_pole))]),
        one,
        np.concatenate([one.pole, one.passed_pole]),
        layout,
    )
    size, count = J.shape[2], len(one.pole)
    flat = J[:count].reshape(-1, size)
    information = flat.T @ (on.information @ J[:count]).reshape(-1, size)
    gradient = on.score.reshape(-1) @ flat
    if len(one.passed_pole):
        flat = J[count:, 1:].reshape(-1, size)
        information = information + flat.T @ (passed.information @ J[count:, 1:]).reshape(-1, size)
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
    geometry: Array,
    directions: Array,
    ranges: Array,
    beams: Beams,
    own: IntArray,
    layout: Layout,
) -> Array:
    """Derivative (N, 4, P) of depth, offset, radius and log-width by pose, errors and axes."""
    T = state.T if lidar else np.eye(4)
    R, t = T[:3, :3], T[:3, 3]
    q, n = (state.points - t) @ R, state.directions @ R
    by = closest_approach(beams.origin, directions, q[own], n[own])
    ahead = by.ranges - ranges + state.offsets[lidar]
    by_axis = np.stack(
        [
            by.sine[:, None] * by.ranges_by_axis + ahead[:, None] * by.sine_by_axis,
            by.lateral_offset_by_axis,
        ],
        axis=1,
    )
    # Turning the beam about its origin is turning the axis in the opposite direction.
    by_rotation = by_axis[:, :, :3] @ se3.hat(q - beams.origin)[own]
    by_rotation += by_axis[:, :, 3:] @ se3.hat(n)[own]
    raising = directions @ se3.hat(beams.axis)
    raising /= np.maximum(se3.lengths(raising), 1e-9)[:, None]
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
    J = np.zeros((len(own), 4, axes + geometry.shape[2] - SHARED))
    J[:, :2, :POSE] = geometry[:, :, :POSE]
    J[:, :2, POSE:axes][:, :, layout.device(lidar)] = device
    J[:, 2, POSE + RADIUS] = 1.0
    J[:, 3, POSE + layout.device(lidar).start + WIDTH] = 1.0
    J[:, :2, axes:] = geometry[:, :, SHARED:]
    bands = band_of(directions, beams.axis)
    # Beams that passed may lie in bands that no return is in.
    rows = np.flatnonzero(np.isin(bands, layout.bands[lidar]))
    band = np.searchsorted(layout.bands[lidar], bands)
    for kind in range(RING):
        column = POSE + layout.rings(lidar, kind).start + band[rows]
        J[rows, :2, column] = ring[rows, :, kind]
    return J
