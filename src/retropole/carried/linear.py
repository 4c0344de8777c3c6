"""The equations of a walk, linearised: residuals of all rows and their derivatives.

The frame W, the splines, and what each unknown does to a row (`adjustment` has the equations). The
border has pose and clock of each LiDAR but the first, whose frame and time are those of all, and
the systematic errors of every LiDAR (`base.systematic`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.systematic import RING_KINDS, Sizes, band_of
from .rows import Rows, left_open
from .start import Poses
from .track import Track

KNOT = 0.1
"""Between two knots of the splines, s: half of it gives the same answer."""

DRIFT = 30e-6
"""1 σ of by how much the clocks' rates differ: quartz oscillators are within ± 50 ppm."""

BEYOND_EDGE = 0.5
"""1 σ of how deep hits are whose beam passes next to the pole, as a part of its radius: at its edge
where a part of the beam hits it, as deep as the rest where tape glows (chosen)."""

DEEPER_AFAR = 1e-3
"""1 σ of how the depth of hits changes with the range beyond the model: the farther, the less of
a beam's edge is bright enough. In simulated fields it was 0.1 to 1.1 mm for each metre (tuning
seeds 25 to 29)."""

POSE, OFFSET, DRIFT_AT, OF_LIDAR = slice(0, 6), 6, 7, 8
"""Among the unknowns of the border that are of one LiDAR: its pose, the offset of its clock and the
drift; and how many they are. Those of the second LiDAR come first."""

DEVICE_NAMES = (
    ("range offset", "m", 1),
    ("range scale", "1", 1),
    ("encoder", "rad", 2),
    ("wobble of the axis", "rad", 2),
    ("bent scan lines", "rad", 4),
    ("elevation of all beams", "rad", 1),
    ("width of the beam", "1", 1),
    ("depth at the edges of the pole", "1", 1),
)
RING_NAMES = tuple((kind.name, kind.unit) for kind in RING_KINDS)
"""Errors of a whole LiDAR in their order, their units and how many of each, and of each ring."""

DEVICE = sum(count for _, _, count in DEVICE_NAMES)
"""Errors of a whole LiDAR, after which come those of its rings."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What one LiDAR saw: its rows, and the sizes of its errors."""

    rows: Rows
    sizes: Sizes


class State(NamedTuple):
    """Coefficients (M, 4) of the splines, poses (L, 4, 4), clocks (L, 2), and errors (E,).

    Each clock has by how much it is ahead, s, and the drift of that.
    """

    coefs: Array
    T: Array
    clocks: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class Frame:
    """What does not change from step to step.

    The frame W, the knots, the middle of the time that each LiDAR shares with the first, 1 σ (E,)
    of the errors, and the prior of the border, the inverse (C, C) of a covariance.
    """

    T_walk_target: Array
    first: float
    middles: Array
    count: int
    radius: float
    seen: tuple[Seen, ...]
    bands: tuple[IntArray, ...]
    sigma: Array
    precision: Array

    @property
    def first_error(self) -> int:
        """Where the errors begin in the border."""
        return OF_LIDAR * (len(self.seen) - 1)


def of_each(lidars: int, own: int) -> IntArray:
    """Places in the border of the first unknowns of each LiDAR but the first: pose, offset, …"""
    return np.asarray((OF_LIDAR * np.arange(lidars - 1)[:, None] + np.arange(own)).ravel())


def frame_of(start: Poses, tracks: Sequence[Track], seen: Sequence[Seen], radius: float) -> Frame:
    """Lay the frame W and the knots about the walk as a start has it."""
    target = tracks[0]
    up = target.directions.mean(axis=0)
    up /= np.linalg.norm(up)
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    R = np.stack([side, np.cross(up, side), up])
    T = se3.from_rt(R, -R @ target.points.mean(axis=0))
    times = [each.rows.times - ahead for each, ahead in zip(seen, start.offsets, strict=True)]
    first = min(float(own.min()) for own in times) - 0.5
    last = max(float(own.max()) for own in times) + 0.5
    count = int(np.ceil((last - first) / KNOT)) + 3
    bands, prior = [], []
    for each in seen:
        band = np.unique(ring_bands(each.rows))
        s = each.sizes
        bands.append(band)
        prior.append(
            np.array(
                [
                    np.hypot(s.zero, s.tape),
                    np.hypot(s.scale, DEEPER_AFAR),
                    s.encoder,
                    s.encoder,
                    s.wobble,
                    s.wobble,
                ]
                + 4 * [s.bend]
                + [s.elevation, s.width, BEYOND_EDGE]
            )
        )
        prior.append(np.repeat([s.ring_range, s.ring_elevation, s.ring_azimuth], len(band)))
    sigma, others = np.concatenate(prior), len(seen) - 1
    precision = np.diag(np.r_[np.full(OF_LIDAR * others, 1e-6), sigma**-2])
    # Rates are relative to that of the first clock, which errs as any other.
    drifts = OF_LIDAR * np.arange(others) + DRIFT_AT
    rates = DRIFT**2 / 2 * (np.eye(others) + 1)
    precision[np.ix_(drifts, drifts)] = np.linalg.inv(rates)
    middles = np.array([_middle(times[0], own) for own in times])
    return Frame(T, first, middles, count, radius, tuple(seen), tuple(bands), sigma, precision)


def _middle(target: Array, own: Array) -> float:
    """Middle of the time in which a LiDAR and the first see the pole; or of what it sees alone."""
    both = np.r_[target, own]
    begin, end = (max(target.min(), own.min()), min(target.max(), own.max()))
    return float(both[(both >= begin) & (both <= end)].mean() if end > begin else own.mean())


def ring_bands(rows: Rows) -> IntArray:
    """(N,) whose errors each row shares: its ring's, or where there are none, its elevation's."""
    if rows.rings[0] >= 0:
        return rows.rings
    return band_of(rows.directions, np.array([0.0, 0.0, 1.0]))


class System(NamedTuple):
    """Linearised rows: residuals (N, 2) in σ, and derivatives by splines and border.

    Those by the unknowns of a whole LiDAR are (N, 2, K) in `by_lidar`, at its places `columns`
    (L, K) in the border; those by all else of the border are in `by_rings`.
    """

    residuals: Array
    by_coefs: csr_array
    by_lidar: Array
    columns: IntArray
    by_rings: csr_array
    times: Array
    lidar: IntArray
    offset_slopes: Array
    sigma: Array
    stated: Array


def _basis(u: Array) -> Array:
    """(N, 4) uniform cubic B-splines at a part u (N,) of a knot interval."""
    return np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 3 * (u + u**2 - u**3) + 1, u**3], 1) / 6


def _slope(u: Array) -> Array:
    """(N, 4) their derivatives by time."""
    parts = [-((1 - u) ** 2), 3 * u**2 - 4 * u, 1 + 2 * u - 3 * u**2, u**2]
    return np.stack(parts, axis=1) / (2 * KNOT)


def _interval(frame: Frame, times: Array) -> tuple[IntArray, Array]:
    place = np.clip((times - frame.first) / KNOT, 0, frame.count - 3 - 1e-9)
    number = place.astype(np.int64)
    return number, place - number


def axes_at(frame: Frame, coefs: Array, times: Array) -> Array:
    """Give (N, 4) x, y, u and v at times (N,)."""
    number, u = _interval(frame, times)
    near = coefs[number[:, None] + np.arange(4)]
    return np.asarray(np.einsum("nk,nkc->nc", _basis(u), near))


def first_coefs(frame: Frame, start: Poses, tracks: Sequence[Track]) -> Array:
    """Splines through the lines of all tracks."""
    lines, times = [], []
    for track, T, ahead in zip(tracks, start.T, start.offsets, strict=True):
        T_walk = frame.T_walk_target @ T
        point, along = se3.apply(T_walk, track.points), track.directions @ T_walk[:3, :3].T
        kept = np.abs(along[:, 2]) > 0.3
        slope = along[kept, :2] / along[kept, 2:]
        lines.append(np.hstack([point[kept, :2] - slope * point[kept, 2:], slope]))
        times.append(track.times[kept] - ahead)
    at = np.concatenate(times)
    number, u = _interval(frame, at)
    rows, weight = _basis(u), 1 / 0.02**2
    band = np.zeros((4, frame.count))
    right = np.zeros((frame.count, 4))
    for a in range(4):
        np.add.at(right, number + a, weight * rows[:, a, None] * np.concatenate(lines))
        for b in range(a + 1):
            np.add.at(band[a - b], number + b, weight * rows[:, a] * rows[:, b])
    band += curvature_band(frame.count, np.array([0.2]))[:4]
    return np.asarray(cho_solve_banded((cholesky_banded(band, lower=True), True), right))


def curvature(coefs: Array) -> Array:
    """Give (M − 2, 4) second derivatives at the knots."""
    return np.diff(coefs, n=2, axis=0) / KNOT**2


def curvature_band(count: int, noise: Array) -> Array:
    """Give the lower band of the prior's matrix, for an interleaved spline of each noise."""
    own = np.zeros((3, count))
    stencil = np.array([1.0, -2.0, 1.0]) / KNOT**2
    for a in range(3):
        for b in range(a + 1):
            own[a - b, b : count - 2 + b] += stencil[a] * stencil[b] * KNOT
    own[0] += 1e-8
    several = len(noise)
    band = np.zeros((4 * several, count * several))
    for k in range(3):
        band[k * several] = (own[k][:, None] / noise).ravel()
    return band


def linearised(frame: Frame, state: State, spread: Array) -> System:
    """Linearise the rows of all LiDARs."""
    every = range(len(frame.seen))
    parts = [_of_lidar(frame, state, lidar, spread[lidar]) for lidar in every]
    both = _Linear(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    counts = [len(part.residuals) for part in parts]
    del parts  # as large as all that is made of them
    # Columns of one interval follow each other: x, y, u and v of each of its four coefficients.
    J = _sparse(
        both.by_coefs.reshape(-1, 2, 16),
        4 * both.interval[:, None] + np.arange(16),
        4 * frame.count,
    )
    R = _sparse(both.by_ring, both.ring_columns, len(frame.precision))
    columns = [
        np.r_[
            OF_LIDAR * max(lidar - 1, 0) + np.arange(OF_LIDAR),
            _errors_of(frame, state, lidar)[1] + np.arange(DEVICE),
        ]
        for lidar in every
    ]
    return System(
        both.residuals, J, both.by_lidar, np.array(columns), R, both.times,
        np.repeat(every, counts), both.by_clock, both.sigma, both.stated,
    )  # fmt: skip


def _sparse(values: Array, columns: IntArray, size: int) -> csr_array:
    """Make a matrix (2 N, size) of values (N, 2, K) at columns (N, K)."""
    rows, _, width = values.shape
    # Half as wide as NumPy's, indices take less memory and time.
    ends = np.arange(0, 2 * rows * width + 1, width, dtype=np.int32)
    twice = np.repeat(columns.astype(np.int32), 2, axis=0)
    return csr_array((values.reshape(-1), twice.reshape(-1), ends), shape=(2 * rows, size))


class _Linear(NamedTuple):
    """Linearised rows of one LiDAR.

    Residuals (N, 2), knot intervals (N,), derivatives by splines (N, 2, 4, 4), by the unknowns of
    the whole LiDAR (N, 2, K), by those of rings (N, 2, 3) with their columns (N, 3), and by the
    offset of its clock (N, 2), times (N,), σ and what is stated of it (N, 2).
    """

    residuals: Array
    interval: IntArray
    by_coefs: Array
    by_lidar: Array
    by_ring: Array
    ring_columns: IntArray
    by_clock: Array
    times: Array
    sigma: Array
    stated: Array


def _of_lidar(frame: Frame, state: State, lidar: int, spread: Array) -> _Linear:
    """Linearise the rows of one LiDAR."""
    rows = frame.seen[lidar].rows
    band = np.searchsorted(frame.bands[lidar], ring_bands(rows))
    errors, first = _errors_of(frame, state, lidar)
    count = len(frame.bands[lidar])
    own = errors[DEVICE:].reshape(3, count)[:, band]
    d = rows.directions
    level = np.linalg.norm(d[:, :2], axis=1)
    cosine, sine = d[:, 0] / level, d[:, 1] / level
    twice, thrice = (cosine + 1j * sine) ** 2, (cosine + 1j * sine) ** 3
    bends = [twice.real, twice.imag, thrice.real, thrice.imag, np.ones_like(level)]
    east = np.stack([-sine, cosine, 0 * sine], axis=1)
    north = np.cross(d, east)
    turn = errors[2] * cosine + errors[3] * sine + own[2]
    lift = errors[4] * cosine + errors[5] * sine + errors[6:11] @ bends + own[1]
    true = d + (turn * level)[:, None] * east + lift[:, None] * north
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    ranges = rows.ranges - errors[0] - errors[1] * rows.ranges - own[0]

    T_walk = frame.T_walk_target @ state.T[lidar]
    R = T_walk[:3, :3]
    ahead, drift = state.clocks[lidar]
    late = rows.times - ahead - frame.middles[lidar]
    times = rows.times - ahead - drift * late
    number, u = _interval(frame, times)
    near = state.coefs[number[:, None] + np.arange(4)]
    basis = _basis(u)
    axis = np.einsum("nk,nkc->nc", basis, near)
    moving = np.einsum("nk,nkc->nc", _slope(u), near)

    ray, e_east = true @ R.T, east @ R.T
    n = np.concatenate([axis[:, 2:], np.ones((len(axis), 1))], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    b1, b2, sideways = _across(ray, n)
    lever = np.abs(np.einsum("ni,ni->n", e_east, b2)) * ranges * level
    left = left_open(rows, lever, frame.radius, errors[11])
    wider = left_open(rows, lever, frame.radius, errors[11] + 0.1)
    depth = left.depth + errors[12] * frame.radius * left.beyond
    P = ranges[:, None] * ray + T_walk[:3, 3]
    Z = P[:, 2] + depth / sideways * ray[:, 2]
    e = P[:, :2] + (depth / sideways)[:, None] * ray[:, :2] - axis[:, :2] - axis[:, 2:] * Z[:, None]

    b = np.stack([b1, b2], axis=1)
    common = np.sqrt(rows.sharing)
    ranging = rows.range_noise * sideways / np.sqrt(rows.hits)
    stated = np.stack(
        [np.hypot(ranging, left.depth_sigma * common), left.sigma * common],
        axis=1,
    )
    sigma = np.stack(
        [spread[0] * stated[:, 0], np.hypot(stated[:, 1], spread[1] * rows.ranges)], axis=1
    )
    # Where hits are missing, the depth is not known either.
    sigma[~np.isfinite(sigma[:, 1])] = np.inf
    b = b / sigma[:, :, None]
    residual = np.einsum("nri,ni->nr", b[:, :, :2], e)
    # Derivatives where the beam should have hit the pole: at what was measured, their errors and
    # those of the residuals are the same ones, and what multiplies them does not vanish.
    back = np.einsum("ni,ni->n", b1[:, :2], e) / sideways
    aside = np.einsum("ni,ni->n", b2[:, :2], e)
    ranges = ranges - back
    ray = (ranges + depth / sideways)[:, None] * ray - aside[:, None] * b2
    Z = T_walk[2, 3] + ray[:, 2]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    b1, b2, sideways = _across(ray, n)
    b = np.stack([b1, b2], axis=1) / sigma[:, :, None]
    e_east = e_east - np.einsum("ni,ni->n", e_east, ray)[:, None] * ray
    e_north = np.cross(ray, e_east)
    # By the splines: x and y at the basis, u and v at it times the height.
    by_axis = -np.concatenate([b[:, :, :2], b[:, :, :2] * Z[:, None, None]], axis=2)
    by_coefs = basis[:, None, :, None] * by_axis[:, :, None, :]
    # Later on the clock is earlier in the walk: the axis is where it was.
    speed = moving[:, :2] + moving[:, 2:] * Z[:, None]
    by_clock = np.einsum("nri,ni->nr", b[:, :, :2], speed)
    by_pose = np.zeros((len(d), 2, OF_LIDAR))
    if lidar:
        arm = (ranges + depth / sideways)[:, None] * (ray @ frame.T_walk_target[:3, :3])
        b_target = b @ frame.T_walk_target[:3, :3]
        turned = np.cross(arm[:, None], b_target)
        by_pose = np.concatenate(
            [turned, b_target, by_clock[:, :, None], (by_clock * late[:, None])[:, :, None]], axis=2
        )
    along = -np.einsum("nri,ni->nr", b, ray)
    right = np.einsum("nri,ni->nr", b, e_east) * (ranges * level)[:, None]
    up = np.einsum("nri,ni->nr", b, e_north) * ranges[:, None]
    deeper = (
        np.einsum("nri,ni->nr", b, ray) * ((wider.depth - left.depth) / (0.1 * sideways))[:, None]
    )
    beyond = np.einsum("nri,ni->nr", b, ray) * (frame.radius * left.beyond / sideways)[:, None]
    by_device = np.stack(
        [along, along * ranges[:, None], right * cosine[:, None], right * sine[:, None]]
        + [up * each[:, None] for each in (cosine, sine, *bends)]
        + [deeper, beyond],
        axis=2,
    )
    return _Linear(
        residual, number, by_coefs, np.concatenate([by_pose, by_device], 2),
        np.stack([along, up, right], axis=2),
        first + DEVICE + band[:, None] + count * np.arange(3), by_clock, times, sigma, stated,
    )  # fmt: skip


def _across(ray: Array, n: Array) -> tuple[Array, Array, Array]:
    """Beams (N, 3) across axes (N, 3), what is across both, and the sine of the angle between."""
    across = ray - np.einsum("ni,ni->n", ray, n)[:, None] * n
    sideways = np.linalg.norm(across, axis=1)
    b1 = across / sideways[:, None]
    return b1, np.cross(n, b1), sideways


def _errors_of(frame: Frame, state: State, lidar: int) -> tuple[Array, int]:
    """Errors of a LiDAR, and their index in the border."""
    sizes = [DEVICE + 3 * len(bands) for bands in frame.bands]
    first = sum(sizes[:lidar])
    return state.errors[first : first + sizes[lidar]], frame.first_error + first
