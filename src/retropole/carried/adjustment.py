"""Poses, clocks and the motion of the pole, adjusted together over a whole walk.

In a frame W whose z axis is the mean direction of the pole, its axis at a height h is at
``(x + u h, y + v h, h)``. x, y, u and v are cubic B-splines in time, held together by white noise
on their acceleration, ``∫ ẍ² / q dt``, whose size q the data show. A row of returns (`rows`), moved
along its beam by the depth of the cylinder, is off the axis by::

    e = P − (x + u Z, y + v Z, Z),     b₁·e ~ σ_r |d_⊥| / √k,     b₂·e ~ w / √3,

b₁ being the beam across the axis, and b₂ across both. The clock of each LiDAR but the first runs
ahead by ``τ + κ (t − t_m)``. The systematic errors of every LiDAR (`base.systematic`) are unknowns
with a prior. The normal equations have a band for the splines, and a border for all else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_solve_banded, cholesky_banded, solve_banded
from scipy.linalg.lapack import dpotrf, dpotri, dtbtrs
from scipy.sparse import csr_array, hstack

from ..alignment.certainty import Part, joint_covariance
from ..base import se3
from ..base.datatypes import Array, IntArray
from .linear import (
    DEVICE_NAMES,
    DRIFT_AT,
    KNOT,
    OF_LIDAR,
    OFFSET,
    POSE,
    RING_NAMES,
    Frame,
    Seen,
    State,
    System,
    axes_at,
    curvature,
    curvature_band,
    first_coefs,
    frame_of,
    linearised,
    of_each,
)
from .start import Poses
from .track import Track

NOISE = (0.2, 0.2, 0.08, 0.08)
"""Noise of the acceleration to start from: of x and y, m²/s³, and of u and v, 1/s³."""

HUBER, BEYOND = 2.5, 12.0
"""Residuals have less weight from this many σ on, and not at all beyond."""

MAX_STEPS = 40
"""Steps at most; most walks need 8 to 15, as the noise of the motion comes to rest."""

WINDOW, FEWEST_IN_WINDOW = 5.0, 10
"""Windows in which fit and clocks' offset are looked at: s, and rows of each LiDAR. With 40 rows, a
walk of which little is common was answered across a jump of the clock."""

LEAST_MOTION = 1e-3
"""No noise of the motion is less: of a pole that never leans it would fall forever."""

REST, SETTLED = 0.05, 0.15
"""A step that moves nothing by more σ is the last, where the noise of the motion changes by less
than this, of its logarithm: the pose hardly depends on it."""

FASTER = 1.6
"""Power to which a change of the noise is raised: it comes to rest in half of the steps (EM comes
there slowly where the data leave much of the motion open)."""

SHORT = 0.5
"""A step of the clock is tested at times this far from each other, s."""

HELD = 1e-6
"""The offset of all is held to so much, s, where each window has its own."""

JITTERS = np.r_[0.0, np.geomspace(5e-5, 0.02, 60), np.inf]
"""Angles that are tried for what moves the edges of the pole, rad."""

FULL_STEPS = 5
"""After this many steps, half of each is gone."""

DOUBTED = 3.0
"""A step of the clock of so many σ may have happened: of steady clocks, 5 % have a larger one by
chance (Andrews 1993)."""

DRAWS = 4
"""Draws of the motion: over hundreds of knots, few draws show its spread."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The maximum, and what is known there.

    Attributes
    ----------
    T
        (L, 4, 4) of all LiDARs in the frame of the first, the target.
    covariance
        (7 (L − 1), 7 (L − 1)) over ``[φ, δ, τ]`` of each other, rad, m and s, target axes.
    clocks, middles
        (L, 2) by how much each clock is ahead of the target's in the middle of what both saw, s,
        and its rate, and (L,) that middle by the target's clock.
    motion
        (4,) noise of the acceleration, as `NOISE`.
    residuals, weights, times, lidar
        (N, 2) along the beam and across, in σ; (N, 2) their weights; (N,) s by the target's clock,
        and whose they are.
    off_along
        (N,) the first of the residuals, metres; 0 if hits are missing.
    axes
        (S, 4) x, y, u and v at (S,) `at`, s.
    at
        Where the axes are given.
    T_walk_target
        (4, 4) to the frame W.
    spread
        (L, 2) how the rows of each LiDAR scatter beyond what is stated: along beams a factor,
        across an angle, rad.
    clock_windows
        Of each LiDAR (K, 3) middle of each window of `WINDOW`, by the target's clock, the clock's
        offset there relative to that of all, and its 1 σ, s. Of the target of a pair none: it is
        the source's.
    clock_steps
        (L, 3) when a step of each offset is likeliest, s, the step and its 1 σ, s.
    random, parts
        (6 (L − 1), 6 (L − 1)) of `covariance` from the scatter of the returns and the motion of the
        pole, and what each systematic error adds.
    converged, cost
        Whether steps came to rest; the sum of the robust losses with the priors.
    frame, state, border
        The knots, the unknowns about the start of the beams, and the covariance of the border.
    """

    T: Array
    covariance: Array
    clocks: Array
    middles: Array
    motion: Array
    residuals: Array
    weights: Array
    times: Array
    lidar: IntArray
    axes: Array
    at: Array
    T_walk_target: Array
    spread: Array
    clock_windows: tuple[Array, ...]
    clock_steps: Array
    random: Array
    parts: tuple[Part, ...]
    off_along: Array
    converged: bool
    cost: float
    frame: Frame
    state: State
    border: Array

    @property
    def T_target_source(self) -> Array:
        """(4, 4) of a pair."""
        return np.asarray(self.T[1])

    @property
    def offset(self) -> float:
        """By how much the source's clock is ahead, of a pair, s."""
        return float(self.clocks[1, 0])

    @property
    def clock_sigmas(self) -> Array:
        """(L,) 1 σ of each clock's offset, s: with half of a step that may have happened."""
        known = np.sqrt(np.diag(self.covariance)[OFFSET :: OFFSET + 1])
        _, step, sigma = self.clock_steps[1:].T
        return np.asarray(np.r_[0.0, np.hypot(known, (np.abs(step) > DOUBTED * sigma) * step / 2)])

    @property
    def left_out(self) -> float:
        """Share of the rows that have less weight than half, of the two LiDARs that lose most."""
        count = np.bincount(self.lidar)
        lost = np.bincount(self.lidar[self.weights.min(axis=1) < 0.5], minlength=len(count))
        worst = np.argsort(lost / np.maximum(count, 1))[-2:]
        return float(lost[worst].sum() / max(count[worst].sum(), 1))


def adjust(start: Poses, tracks: Sequence[Track], seen: Sequence[Seen], radius: float) -> Adjusted:
    """Adjust a walk from a start.

    Parameters
    ----------
    start
        Poses and clocks of all LiDARs, as those of `find_starts`.
    tracks, seen
        Of each LiDAR, the target first.
    radius
        Of the pole, metres.
    """
    frame, lidars = frame_of(start, tracks, seen, radius), len(seen)
    state = State(
        first_coefs(frame, start, tracks),
        start.T,
        np.stack([start.offsets, np.zeros(lidars)], axis=1),
        np.zeros(len(frame.sigma)),
    )
    motion, spread = np.array(NOISE), np.tile([1.0, 0.0], (lidars, 1))
    # Draws for the uncertainty of the motion: equal inputs give equal answers.
    draws = np.random.default_rng(0).normal(size=(4 * frame.count, DRAWS))
    stated, posed = of_each(lidars, OFFSET + 1), of_each(lidars, OFFSET)
    converged = False
    for number in range(MAX_STEPS):
        system = linearised(frame, state, spread)
        weights = _weights(system.residuals)
        step = _solve(frame, state, system, weights, motion, draws)
        moved = (np.abs(step.border) / np.sqrt(np.diag(step.covariance)))[stated]
        # The uncertainty of hits follows the motion and is not differentiated: full steps may
        # go to and fro about the end.
        part = 1.0 if number < FULL_STEPS else 0.5
        state = moved_by(frame, state, part * step.coefs, part * step.border)
        grown = (np.maximum(step.motion, LEAST_MOTION) / motion) ** FASTER
        motion = np.maximum(motion * grown, LEAST_MOTION)
        if number > 2:
            spread = _spread(frame, system, weights, step.leverage)
        if number >= FULL_STEPS and moved.max() < REST and np.abs(np.log(grown)).max() < SETTLED:
            converged = True
            break
    system = linearised(frame, state, spread)
    weights = _weights(system.residuals)
    step = _solve(frame, state, system, weights, motion, draws)
    at = np.asarray(frame.first + KNOT * np.arange(frame.count - 3))
    size = np.abs(system.residuals)
    robust = np.where(size < HUBER, 0.5 * size**2, HUBER * np.minimum(size, BEYOND) - HUBER**2 / 2)
    own = _known(frame, state)
    second = curvature(state.coefs) ** 2 * KNOT / motion
    cost = robust.sum() + 0.5 * (own @ frame.precision @ own) + 0.5 * second.sum()
    cost += 0.5 * len(second) * np.log(motion).sum()
    parts = tuple(_parts(frame, state, step.covariance))
    systematic = joint_covariance(parts)[6:, 6:]
    sigma = np.where(np.isfinite(system.sigma[:, 0]), system.sigma[:, 0], 0.0)
    # What steps in the clock of a pair's target is a step in the source's.
    tested = range(lidars) if lidars > 2 else (1,)
    clocks = {k: _clock(k, frame, state, system, weights, motion, draws) for k in tested}
    none = np.zeros((0, 3)), np.zeros(3)
    windows, steps = zip(*(clocks.get(k, none) for k in range(lidars)), strict=True)
    return Adjusted(
        state.T,
        step.covariance[np.ix_(stated, stated)],
        state.clocks,
        frame.middles,
        motion,
        system.residuals,
        weights,
        system.times,
        system.lidar,
        axes_at(frame, state.coefs, at),
        at,
        frame.T_walk_target,
        spread,
        windows,
        np.array(steps),
        step.covariance[np.ix_(posed, posed)] - systematic,
        parts,
        sigma * system.residuals[:, 0],
        converged,
        float(cost),
        frame,
        state,
        step.covariance,
    )


def moved_by(frame: Frame, state: State, coefs: Array, border: Array) -> State:
    """Take a step."""
    own = border[: frame.first_error].reshape(-1, OF_LIDAR)
    T = [se3.retract(each, step) for each, step in zip(state.T[1:], own[:, POSE], strict=True)]
    return State(
        state.coefs + coefs,
        np.stack([state.T[0], *T]),
        state.clocks + np.vstack([np.zeros(2), own[:, OFFSET:]]),
        state.errors + border[frame.first_error :],
    )


def _known(frame: Frame, state: State) -> Array:
    """(C,) the unknowns of the border of which something is known beforehand, 0 of all others."""
    own = np.zeros((len(state.T) - 1, OF_LIDAR))
    own[:, DRIFT_AT] = state.clocks[1:, 1]
    return np.concatenate([own.ravel(), state.errors])


def in_recordings(found: Adjusted, *frames: Array) -> Adjusted:
    """Express what was found about the start of the beams in the frames of the recordings.

    Parameters
    ----------
    found
        As `adjust` gives it.
    frames
        (4, 4) of each LiDAR from its beams to its recording, as `Track.T_recording_beams`.
    """
    J = steps_in_recordings(found, *frames)
    place = np.arange(len(found.covariance))
    clock = place % (OFFSET + 1) == OFFSET
    whole = np.eye(len(place))
    whole[np.ix_(~clock, ~clock)] = J
    wide = block_diag(np.eye(6), J)
    return replace(
        found,
        T=frames[0] @ found.T @ np.stack([se3.inverse(each) for each in frames]),
        covariance=whole @ found.covariance @ whole.T,
        random=J @ found.random @ J.T,
        parts=tuple(replace(part, root=wide @ part.root) for part in found.parts),
        T_walk_target=found.T_walk_target @ se3.inverse(frames[0]),
    )


def steps_in_recordings(found: Adjusted, *frames: Array) -> Array:
    """Give the matrix that takes errors ``[φ, δ]`` of all poses to the frames of `in_recordings`.

    They are those of other origins, on other axes: (6 (L − 1), 6 (L − 1)).
    """
    R, blocks = frames[0][:3, :3], []
    for T, own in zip(frames[0] @ found.T[1:], frames[1:], strict=True):
        J = np.zeros((6, 6))
        J[:3, :3] = J[3:, 3:] = R
        J[3:, :3] = -se3.hat((T @ se3.inverse(own))[:3, 3] - T[:3, 3]) @ R
        blocks.append(J)
    return np.asarray(block_diag(*blocks))


def _weights(residuals: Array) -> Array:
    size = np.abs(residuals)
    return np.asarray(np.where(size > BEYOND, 0.0, np.minimum(1.0, HUBER / np.maximum(size, 1e-9))))


def _spread(frame: Frame, system: System, weights: Array, leverage: Array) -> Array:
    """What rows scatter by more than stated: along beams a factor, across an angle, (L, 2).

    The splines take up a part of the scatter, the leverage of the rows. Along, no factor is less
    than 1; across, the variance of an angle is added to that of the hits: beams that do
    not point where they should, and the glow of tape, move the edges of the pole.
    """
    found = np.ones((len(frame.seen), 2))
    for lidar in range(len(found)):
        own = system.lidar == lidar
        w, sigma = weights[own], system.sigma[own]
        # Rows that leave the same open across are one, each a part of it.
        share = np.stack([np.ones(len(w)), 1 / frame.seen[lidar].rows.sharing], axis=1)
        left = (w * (share - np.minimum(leverage[own], 0.95 * share))).sum(axis=0)
        known = np.isfinite(sigma[:, 1])
        off = np.where(known[:, None], sigma, 0.0) * system.residuals[own]
        stated = system.stated[own]
        along = (w * off**2)[known, 0] / stated[known, 0] ** 2
        found[lidar, 0] = max(1.0, float(np.sqrt(along.sum() / max(left[0], 1.0))))
        swung = JITTERS[:, None] * frame.seen[lidar].rows.ranges[known]
        across = (w * off**2)[known, 1] / (stated[known, 1] ** 2 + swung**2)
        found[lidar, 1] = JITTERS[int(np.argmax(across.sum(axis=1) <= left[1]))]
    return found


class _Step(NamedTuple):
    coefs: Array
    border: Array
    covariance: Array
    motion: Array
    leverage: Array


def _solve(
    frame: Frame,
    state: State,
    system: System,
    weights: Array,
    noise: Array,
    draws: Array,
) -> _Step:
    """One step, the covariance of the border, and the noise of the motion that follows."""
    w = weights.reshape(-1)
    r = system.residuals.reshape(-1)
    factor, side, corner = _normal(frame, system, w, noise)
    known = _known(frame, state)
    held = frame.precision @ np.r_[known, np.zeros(len(corner) - len(known))]
    corner += frame.precision
    second = curvature(state.coefs) * KNOT / noise
    pull = np.zeros_like(state.coefs)
    for k, part in enumerate(np.array([1.0, -2.0, 1.0]) / KNOT**2):
        pull[k : len(pull) - 2 + k] += part * second
    g_coefs = system.by_coefs.T @ (w * r) + pull.ravel()
    g_border = _by_border(system, w * r) + held
    # One of the two triangular solutions is enough, and its square is half of a product.
    half, _ = dtbtrs(factor, side, uplo="L")
    covariance = _inverse(corner - half.T @ half)
    alone = cho_solve_banded((factor, True), g_coefs)
    border = -covariance @ (g_border - side.T @ alone)
    coefs = -cho_solve_banded((factor, True), g_coefs + side @ border)
    # Draws of the posterior show how much of the motion the data leave uncertain (EM).
    upper = np.zeros_like(factor)
    for k in range(len(factor)):
        upper[-1 - k, k:] = factor[k, : factor.shape[1] - k]
    draws = solve_banded((0, len(factor) - 1), upper, draws)
    leverage = weights * np.mean((system.by_coefs @ draws) ** 2, axis=1).reshape(-1, 2)
    moved = state.coefs + coefs.reshape(-1, 4)
    total = np.mean(curvature(moved) ** 2, axis=0)
    for draw in draws.T:
        total = total + np.mean(curvature(draw.reshape(-1, 4)) ** 2, axis=0) / draws.shape[1]
    found = KNOT * total
    both = np.repeat([found[:2].mean(), found[2:].mean()], 2)
    return _Step(coefs.reshape(-1, 4), border, covariance, both, leverage)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix, in a third of the time where it is positive definite."""
    factor, fault = dpotrf(matrix, lower=1)
    if fault:
        return np.asarray(np.linalg.inv(matrix))
    found, _ = dpotri(factor, lower=1)
    return np.asarray(np.tril(found) + np.tril(found, -1).T)


def _normal(frame: Frame, system: System, w: Array, noise: Array) -> tuple[Array, Array, Array]:
    """The Cholesky factor of the splines' band, side and corner of the normal equations.

    What many rows have in common is multiplied densely, in a third of the time.
    """
    J, R, first = system.by_coefs, system.by_rings, system.by_coefs.indices[::32]
    band, below = curvature_band(frame.count, noise), np.tril_indices(16)
    by_coefs, weights = J.data.reshape(-1, 2, 16), w.reshape(-1, 2, 1)
    order = np.argsort(first, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(first[order])) + 1):
        own = by_coefs[rows].reshape(-1, 16)
        block = own.T @ (weights[rows] * by_coefs[rows]).reshape(-1, 16)
        band[below[0] - below[1], first[rows[0]] + below[1]] += block[below]
    weights_of_R = np.repeat(w, np.diff(R.indptr))
    weighted = csr_array((weights_of_R * R.data, R.indices, R.indptr), shape=R.shape)
    side = (J.T.tocsr() @ weighted).toarray(order="F")
    corner = (R.T @ weighted).toarray()
    for lidar, columns in enumerate(system.columns):
        is_own = system.lidar == lidar
        both = np.repeat(is_own, 2)
        own = system.by_lidar[is_own].reshape(-1, len(columns))
        weighted_own = w[both, None] * own
        side[:, columns] += J[both].T @ weighted_own
        corner[np.ix_(columns, columns)] += own.T @ weighted_own
        across = weighted[both].T @ own
        corner[:, columns] += across
        corner[columns] += across.T
    return cholesky_banded(band, lower=True), side, corner


def _by_border(system: System, values: Array) -> Array:
    """Sum up values (2 N,) of the residuals times derivatives by the border (C,)."""
    total = system.by_rings.T @ values
    for lidar, columns in enumerate(system.columns):
        is_own = system.lidar == lidar
        own = system.by_lidar[is_own].reshape(-1, len(columns))
        total[columns] += own.T @ values[np.repeat(is_own, 2)]
    return np.asarray(total)


def information_of(frame: Frame, system: System, weights: Array, noise: Array) -> Array:
    """What residuals with weights (2 N,) say of the border, its prior left out: (C, C)."""
    factor, side, corner = _normal(frame, system, weights, noise)
    return np.asarray(corner - side.T @ cho_solve_banded((factor, True), side))


def _parts(frame: Frame, state: State, covariance: Array) -> Iterator[Part]:
    """What each error adds to the poses: where what is known of it is off by 1 σ, so are they."""
    at, poses = 0, of_each(len(frame.seen), OFFSET)
    for lidar, bands in enumerate(frame.bands):
        for name, unit, count in (*DEVICE_NAMES, *((*kind, len(bands)) for kind in RING_NAMES)):
            own = np.arange(at, at + count)
            moved = covariance[np.ix_(poses, frame.first_error + own)] / frame.sigma[own]
            estimated = float(state.errors[at]) if count == 1 else None
            root = np.vstack([np.zeros((6, count)), moved])
            yield Part(name, lidar, float(frame.sigma[at]), unit, estimated, root)
            at += count


def _offsets(
    lidar: int,
    frame: Frame,
    state: State,
    system: System,
    weights: Array,
    motion: Array,
    draws: Array,
    place: IntArray,
) -> tuple[Array, Array]:
    """Give the rows of a LiDAR with each place (N,), from 0 on, a separate offset.

    Returns the offsets (K,) relative to that of all, s, and their covariance (K, K).
    """
    number = int(place.max()) + 1
    own = np.flatnonzero((system.lidar == lidar) & (place >= 0))
    at = (2 * own[:, None] + [0, 1]).ravel(), np.repeat(place[own], 2)
    slopes = system.offset_slopes[own].ravel()
    windows = csr_array((slopes, at), shape=(system.residuals.size, number))
    precision = block_diag(frame.precision, np.eye(number))
    # The target has no offset of its own: another is held in its place.
    held = OF_LIDAR * max(lidar - 1, 0) + OFFSET
    precision[held, held] = HELD**-2
    step = _solve(
        replace(frame, precision=precision),
        state,
        system._replace(by_rings=csr_array(hstack([system.by_rings, windows]))),
        weights,
        motion,
        draws,
    )
    of_windows = slice(len(frame.precision), None)
    return step.border[of_windows], step.covariance[of_windows, of_windows]


def _clock(
    lidar: int,
    frame: Frame,
    state: State,
    system: System,
    weights: Array,
    motion: Array,
    draws: Array,
) -> tuple[Array, Array]:
    """Where the offset of a clock changes: its `Adjusted.clock_windows` and `clock_steps`.

    A step at t is tested against a steady offset by all of the walk: with offsets b of short
    windows, their covariance C and h = 1 from t on, its best estimate is::

        hᵀ P b / hᵀ P h,    P = C⁻¹ − C⁻¹ 1 1ᵀ C⁻¹ / (1ᵀ C⁻¹ 1),

    with the variance 1 / hᵀ P h. The likeliest t is taken.
    """
    is_own = system.lidar == lidar
    counted = (weights > 0).all(axis=1)

    def windows_of(length: float, fewest: int) -> tuple[Array, Array, Array]:
        """When windows that both see begin, each offset, and their covariance."""
        place = ((system.times - frame.first) / length).astype(np.int64)
        counts = [
            np.bincount(place[counted & whose], minlength=place.max() + 1)
            for whose in (is_own, ~is_own)
        ]
        number = np.flatnonzero(np.minimum(*counts) >= fewest)
        if len(number) < 2:
            return np.zeros(0), np.zeros(0), np.zeros((0, 0))
        common = np.isin(place, number)
        own = np.where(common, np.searchsorted(number, place), -1)
        # What one LiDAR alone sees would show a step only by a jerk of the pole, which people make.
        both = weights * common[:, None]
        offset, covariance = _offsets(lidar, frame, state, system, both, motion, draws, own)
        return np.asarray(frame.first + length * number), offset, covariance

    begin, offset, covariance = windows_of(WINDOW, FEWEST_IN_WINDOW)
    windows = np.stack([begin + WINDOW / 2, offset, np.sqrt(np.diag(covariance))], axis=1)
    begin, offset, covariance = windows_of(SHORT, 1)
    if not len(begin):
        return windows, np.zeros(3)
    P = np.linalg.inv(covariance)
    P -= np.outer(P.sum(axis=1), P.sum(axis=0)) / P.sum()
    after = np.triu(np.ones(P.shape))[1:]
    precision = np.einsum("ki,ij,kj->k", after, P, after)
    score = after @ P @ offset
    k = int(np.argmax(score**2 / precision))
    step = score[k] / precision[k], precision[k] ** -0.5
    return windows, np.array([begin[k + 1], *step])
