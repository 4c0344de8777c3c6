"""Roll, pitch and height of LiDARs over the ground, and their covariance.

The plane of the ground is, by definition, the one that fits its surface best (least squares of the
height, by area) within a disc about the foot of the LiDARs, and the surface is continued where
none sees it: below a LiDAR there is always a blind cone. Heights z of the ground in cells, of each
LiDAR separately, are one linear Gaussian model::

    z = a + b x + c y + g(x, y) − D e − J δ + noise

with the errors e of the LiDARs (`base.systematic`), those δ of their poses, and the shape g of the
ground: a profile that is constant along a road, and a part that varies from place to place. Both
are random fields of Matérn's kind (ν = 3/2: they may have kinks, as the crown of a road). Sizes and
lengths, the direction of the road and the noise of cells are searched, and averaged over by their
likelihood. The plane of the disc is a linear function of a, b, c and g, so its mean and covariance
are those of a regression (Rasmussen and Williams 2006, 2.7), including the uncertainty of g where
nothing is seen.

The given poses are not changed, so that the calibration between the LiDARs is kept;
the covariance is that of this estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.errors import Refusal
from ..base.systematic import (
    DEVICE_KINDS,
    MIN_ERROR_SIGMA,
    RING_KINDS,
    band_of,
    by_error,
)
from ..base.uncertainty import FLOOR_ROTATION, FLOOR_TRANSLATION
from .steps import Level
from .surface import Ground, Viewer, find_ground, level_axes, little

DISC = 10.0
"""Radius of the disc to which the plane is fitted, metres: LiDARs on vehicles see about half of
it."""

CELLS = 10
"""Cells to a radius of the disc."""

MOST_CELLS, TRIED_CELLS = 600, 250
"""Number of cells that are used, and of those used to find size and length of the shape."""

PROFILES = ((0.0, 1.0), *product((0.01, 0.05, 0.2), (0.15, 0.5, 1.5)))
"""Sizes of the profile, 1 σ in metres, and lengths as parts of the radius, that are tried: none,
and from a worn road to one between verges."""

SHAPES = tuple(product((0.0005, 0.003, 0.015), (0.3, 1.0)))
"""The same for the part that varies from place to place: from a hall's floor to a meadow."""

USUAL = (0.05, 0.5, 0.003, 0.3, 0.003)
"""Values for profile, shape and noise in the search for the direction of the road."""

DIRECTIONS, TURNS = 18, (4.0, 1.5, 0.5)
"""Directions of the road that are tried, over half a turn, and the rotation of the best to
both sides afterwards, degrees: over 10 m, 0.5° are 9 cm."""

NOISES = (0.001, 0.003, 0.01)
"""1 σ of the mean height of a cell, metres, in addition to the noise of ranges: of asphalt to
grass."""

LEAST_FALL = 0.02
"""Minimum fall of beams, as a part of their length, if they are assigned to cells by their
intersection with the plane: farther away the ground may rise towards them."""

PLANE_SIGMA = (1.0, 0.3, 0.3)
"""1 σ of the height, metres, and of both slopes against the rough axes: practically unknown."""

MIN_WEIGHT = 0.03
"""Sizes and lengths less likely than this part of the likeliest are left out."""

MIN_AREA, MIN_SPREAD, MIN_PART = 8.0, 0.5, 0.08
"""Minimum area of ground that must be seen in the disc, m², and its minimum root mean square
distance from a line: in metres, that of a strip 1.7 m wide, and as a part of the radius, which is
a half for the whole disc."""

WIDER = (1.0, 1.5, 2.25, 3.4)
"""If too little of the disc is seen, discs this many times as large are used: 6 m high on a mast
a LiDAR whose lowest ring is at −15° sees no ground within 22 m."""

MAX_TILT_SIGMA, MAX_HEIGHT_SIGMA = float(np.radians(0.6)), 0.12
"""An answer with larger 1 σ, rad and m, is refused."""

ROUNDS, CONVERGED = 3, 0.001
"""The rough axes are those of the plane after at most this many rounds; they are where they are not
tilted against it by more than this, rad: a LiDAR 6 m high has its foot 6 mm aside."""

JACOBIAN_STEP = 1e-6
"""Of central differences, metres and rad."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Mean returns of the ground in cells, separate for each LiDAR.

    Attributes
    ----------
    lidar
        (n,) which LiDAR's.
    at
        (n, 3) in rough axes, metres.
    variance
        (n,) by the noise of ranges, m².
    by_errors, by_poses
        (n, E) and (n, 6 L) derivative of the heights by the errors of all LiDARs, and their poses.
    errors
        (E,) 1 σ of each error.
    """

    lidar: IntArray
    at: Array
    variance: Array
    by_errors: Array
    by_poses: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class LidarLevel:
    """One LiDAR over the ground.

    Attributes
    ----------
    name
        What it is called.
    T_ground_lidar
        (4, 4) pose in the frame of the ground.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of the ground. Parameters fixed by the definition
        of the frame have no variance.
    roll, pitch, height
        Of the rotation (`se3.rpy_from_rotation`), rad, and of its origin over the plane, metres.
    roll_pitch_height
        (3, 3) their covariance.
    """

    name: str
    T_ground_lidar: Array
    covariance: Array
    roll: float
    pitch: float
    height: float
    roll_pitch_height: Array


@dataclass(frozen=True, eq=False)
class Leveled:
    """The ground, and the LiDARs over it.

    Attributes
    ----------
    T_ground_frame
        (4, 4) from the frame that all were given in: z the normal of the ground, the origin at the
        foot of the perpendicular from that frame's origin, x its x axis along the ground.
    lidars
        In their order.
    plane, covariance
        (3,) height, metres, and slopes of the plane against the rough axes; (3, 3).
    centre, radius, area, spread, others, ceiling
        As in `surface.Ground`.
    bend, bend_sigma
        Depth of the ground's edge below its middle, along the direction of the largest bend,
        metres, within the disc; negative if it is hollow.
    roughness
        Root mean square of the cells about the plane, metres.
    cells, residuals
        (n, 3) in rough axes, and (n,) their heights over the plane, metres.
    middle
        (3,) of the disc, on the plane, in the frame that all were given in.
    """

    T_ground_frame: Array
    lidars: tuple[LidarLevel, ...]
    plane: Array
    covariance: Array
    centre: Array
    radius: float
    area: float
    spread: float
    others: tuple[Level, ...]
    ceiling: float | None
    bend: float
    bend_sigma: float
    roughness: float
    cells: Array
    residuals: Array
    middle: Array


def level(
    viewers: Sequence[Viewer], poses: Array | None = None, radius: float | None = None
) -> Leveled:
    """Find roll, pitch and height of LiDARs over the ground.

    Parameters
    ----------
    viewers
        The LiDARs that see the ground, in one frame, in which each has its pose.
    poses
        (6 L, 6 L) covariance of all poses over ``[φ, δ]`` of each, rad and m, axes of the frame;
        None if they are exact, as that of a single LiDAR.
    radius
        Of the disc to which the plane is fitted, metres; None uses `DISC`, or a larger one of
        `WIDER`.

    Raises
    ------
    Refusal
        ``too_little_ground`` if less than `MIN_AREA` is seen, or only a strip, or only ground too
        far away to determine the ground below; ``two_grounds`` as `find_ground`.
    """
    count = 6 * len(viewers)
    joint = np.zeros((count, count)) if poses is None else poses
    ground, radius = _enough(viewers, [DISC * k for k in WIDER] if radius is None else [radius])
    for left in reversed(range(ROUNDS)):
        found = plane_of(
            cells_on(ground, viewers), joint, ground.centre, ground.radius, ground.beside
        )
        plane, covariance = found.mean[:3], found.covariance
        # The disc is about the foot of the perpendicular on the plane itself.
        if not left or np.hypot(*plane[1:]) < CONVERGED:
            break
        turned = ground_frame(plane, ground.T_rough_frame)
        ground = find_ground(viewers, radius, (turned, ground.ceiling))
    tilt, height = np.sqrt(np.diag(covariance)[1:3].max()), np.sqrt(covariance[0, 0])
    if tilt > MAX_TILT_SIGMA or height > MAX_HEIGHT_SIGMA:
        raise Refusal(
            "too_little_ground",
            f"the {ground.area:.0f} m² of visible ground determine its tilt only to "
            f"± {np.degrees(tilt):.2g}° and its height to ± {height:.2g} m within "
            f"{ground.radius:.0f} m (1 σ)",
            {"area_m2": ground.area, "tilt_rad": float(tilt), "height_m": float(height)},
        )
    rough = ground.T_rough_frame
    states = [np.r_[0:3, 3 + 6 * k : 9 + 6 * k] for k in range(len(viewers))]
    lidars = tuple(
        _over(plane, rough, viewer, covariance[np.ix_(own, own)])
        for viewer, own in zip(viewers, states, strict=True)
    )
    off = found.at[:, 2] - plane[0] - found.at[:, :2] @ plane[1:]
    middle = np.r_[ground.centre, np.r_[1.0, ground.centre] @ plane]
    return Leveled(
        ground_frame(plane, rough),
        lidars,
        plane,
        covariance[:3, :3],
        *(ground.centre, ground.radius, ground.area, ground.spread, ground.others, ground.ceiling),
        *_bend(found.mean[3:], found.shape, ground.radius),
        float(np.sqrt(np.mean(off**2))),
        found.at,
        off,
        se3.apply(se3.inverse(rough), middle[None])[0],
    )


def _enough(viewers: Sequence[Viewer], radii: Sequence[float]) -> tuple[Ground, float]:
    """Choose the first disc of which enough is seen, and its radius as given, metres."""
    refusal = None
    for radius in radii:
        try:
            ground = find_ground(viewers, radius)
        except Refusal as refused:
            if refused.code != "too_little_ground":
                raise
            refusal = refusal or refused
            continue
        if ground.area >= MIN_AREA and ground.spread >= max(MIN_SPREAD, MIN_PART * ground.radius):
            return ground, radius
        refusal = refusal or little(ground.area, ground.spread, ground.radius)
    assert refusal is not None
    raise refusal


def cells_on(ground: Ground, viewers: Sequence[Viewer]) -> Cells:
    """Average the returns on the ground in cells, with the derivatives of their heights."""
    side = ground.radius / CELLS
    up = ground.T_rough_frame[2, :3]
    while True:
        parts = [
            _lidar_cells(viewer, index, ground.T_rough_frame, side)
            for viewer, index in zip(viewers, ground.points, strict=True)
        ]
        if sum(len(part.means) for part in parts) <= MOST_CELLS:
            break
        side *= 1.2
    blocks, sigmas, by_poses, at, variance = [], [], [], [], []
    for k, (viewer, part) in enumerate(zip(viewers, parts, strict=True)):
        by, sigma = _by_errors(viewer, part, viewer.T[:3, :3].T @ up)
        blocks.append(by)
        sigmas.append(sigma)
        arm = part.means @ viewer.T[:3, :3].T
        by_pose = np.zeros((len(arm), 6 * len(viewers)))
        by_pose[:, 6 * k : 6 * k + 3] = -np.cross(arm, up)
        by_pose[:, 6 * k + 3 : 6 * k + 6] = -up
        by_poses.append(by_pose)
        at.append(se3.apply(ground.T_rough_frame @ viewer.T, part.means))
        # The scatter of returns grows with the range, since beams widen and returns are dimmer.
        square = np.sum((part.means - viewer.cloud.origin) ** 2, axis=1)
        share = np.average(part.scatter, weights=part.returns) if len(square) else 0.0
        share /= max(np.average(square, weights=part.returns) if len(square) else 1.0, 1e-9)
        variance.append(share * square / part.returns)
    table = np.zeros((sum(map(len, blocks)), sum(map(len, sigmas))))
    row = column = 0
    for block in blocks:
        table[row : row + len(block), column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    lidar = np.repeat(np.arange(len(parts)), [len(part.means) for part in parts])
    return Cells(
        lidar,
        np.concatenate(at),
        np.concatenate(variance),
        table,
        np.concatenate(by_poses),
        np.concatenate(sigmas),
    )


class _LidarCells(NamedTuple):
    """Mean returns (n, 3) of one LiDAR, own frame, their number (n,), the mean square of their
    heights about the mean (n,), m², and (n, B) shares of the bands."""

    means: Array
    returns: Array
    scatter: Array
    share: Array


def _lidar_cells(viewer: Viewer, index: IntArray, rough: Array, side: float) -> _LidarCells:
    xyz = viewer.cloud.xyz[index]
    # By the intersections of beams with the plane: by the points, noise would decide on the cell.
    T = rough @ viewer.T
    start, beams = (
        se3.apply(T, viewer.cloud.origin[None])[0],
        (xyz - viewer.cloud.origin) @ T[:3, :3].T,
    )
    fall = np.minimum(beams[:, 2], -LEAST_FALL * se3.lengths(beams))
    reached_at = start[:2] - beams[:, :2] * (start[2] / fall)[:, None]
    at = np.floor(reached_at / side).astype(np.int64)
    _, cell = np.unique(at, axis=0, return_inverse=True)
    cell, n = cell.ravel(), int(cell.max(initial=-1)) + 1
    count = np.bincount(cell, minlength=n).astype(float)
    means = np.stack([np.bincount(cell, c, minlength=n) for c in xyz.T], axis=1) / count[:, None]
    rays = xyz - viewer.cloud.origin
    rays /= np.maximum(se3.lengths(rays), 1e-9)[:, None]
    ring = viewer.cloud.ring
    lines = band_of(rays, viewer.cloud.axis) if ring is None else ring[index]
    bands, band = np.unique(lines, return_inverse=True)
    share = np.zeros((n, len(bands)))
    np.add.at(share, (cell, band.ravel()), 1.0)
    off = (xyz - means[cell]) @ T[2, :3]
    scatter = np.bincount(cell, off**2, minlength=n) / count
    return _LidarCells(means, count, scatter, share / count[:, None])


def _by_errors(viewer: Viewer, part: _LidarCells, up: Array) -> tuple[Array, Array]:
    """Derivative (n, E) of measured heights by the errors of one LiDAR, and 1 σ (E,) of these."""
    axis, toward = viewer.cloud.axis, part.means - viewer.cloud.origin
    ranges = np.maximum(se3.lengths(toward), 1e-9)
    rays = toward / ranges[:, None]
    around = np.cross(axis, rays)
    across = np.maximum(se3.lengths(around), 1e-9)
    cosine = rays @ up
    tangent = np.sqrt(1 - np.minimum(cosine**2, 1)) / np.maximum(np.abs(cosine), 1e-3)
    device, ring = by_error(
        cosine,
        ranges * (around @ up),
        ranges / across * (np.cross(rays, around) @ up),
        *(rays, axis, ranges, tangent),
        tape=False,
    )
    shape = len(ring), ring.shape[1] * part.share.shape[1]
    of_rings = (ring[:, :, None] * part.share[:, None, :]).reshape(shape)
    sigmas = [getattr(viewer.sizes, kind.field) for kind in DEVICE_KINDS]
    for kind in RING_KINDS:
        sigmas += [getattr(viewer.sizes, kind.field)] * part.share.shape[1]
    # `by_error` is of the true point by the errors of the measured one.
    return -np.concatenate([device, of_rings], axis=1), np.maximum(sigmas, MIN_ERROR_SIGMA)


class Plane(NamedTuple):
    """Posterior of the plane and the bend of the disc.

    Attributes
    ----------
    mean
        (6,) height, slopes in x and y, and the terms x², xy, y² of the shape.
    covariance
        (3 + 6 L, …) of the errors of the first three and of the poses as they were given.
    shape
        (3, 3) covariance of the last three.
    at
        (n, 3) the cells.
    """

    mean: Array
    covariance: Array
    shape: Array
    at: Array


def plane_of(cells: Cells, poses: Array, centre: Array, radius: float, beside: Array) -> Plane:
    """Find the plane of a disc from the cells; `poses` (6 L, 6 L) as `level` takes it.

    Places nearer to another level, `beside` (n, 2), than to the cells are not part of the disc.
    """
    x, y, z = cells.at.T
    planes = np.stack([np.ones_like(x), x, y], axis=1)
    scaled = np.c_[planes * PLANE_SIGMA, cells.by_errors * cells.errors]
    known = scaled @ scaled.T + cells.by_poses @ poses @ cells.by_poses.T
    order = np.random.default_rng(0).permutation(len(x))[:TRIED_CELLS]
    some = cells.at[order, :2], z[order], known[np.ix_(order, order)], cells.variance[order]
    road = _road(*some, radius)
    grid = np.array([(*p, *g, n) for p, g, n in product(PROFILES, SHAPES, NOISES)])
    fits = np.array([_log_likelihood(some, each, road, radius) for each in grid])
    weights = np.exp(fits - fits.max())
    likely = weights > MIN_WEIGHT
    grid, weights = grid[likely], weights[likely] / weights[likely].sum()
    disc = centre + _disc(radius)
    own, other = (cKDTree(each).query(disc)[0] for each in (cells.at[:, :2], beside))
    disc = disc[own < other]
    over = _functionals(disc)
    prior = np.zeros((6, 3))
    prior[:3] = np.diag(np.square(PLANE_SIGMA))
    means, inner, with_poses = [], [], []
    for each in grid:
        S = known + _shape(cells.at[:, :2], cells.at[:, :2], each, road, radius)
        S[np.diag_indices_from(S)] += cells.variance + each[4] ** 2
        to_cells = prior @ planes.T + over @ _shape(disc, cells.at[:, :2], each, road, radius)
        gain = cho_solve(cho_factor(S, lower=True, check_finite=False), to_cells.T).T
        before = over @ _shape(disc, disc, each, road, radius) @ over.T
        before[:3, :3] += prior[:3]
        means.append(gain @ z)
        inner.append(before - gain @ to_cells.T)
        with_poses.append(-gain[:3] @ cells.by_poses @ poses)
    mean = np.average(means, axis=0, weights=weights)
    off = np.array(means) - mean
    spread = np.average(inner, axis=0, weights=weights)
    spread += np.einsum("k,ki,kj->ij", weights, off, off)
    floor = np.array([FLOOR_TRANSLATION, FLOOR_ROTATION, FLOOR_ROTATION])
    joint = np.average(with_poses, axis=0, weights=weights)
    covariance = np.block([[spread[:3, :3] + np.diag(floor**2), joint], [joint.T, poses]])
    return Plane(mean, (covariance + covariance.T) / 2, spread[3:, 3:], cells.at)


_Some = tuple[Array, Array, Array, Array]
"""Places (n, 2), heights (n,), their covariance (n, n) by all but the shape, and (n,) by noise."""


def _log_likelihood(some: _Some, each: Array, road: float, radius: float) -> float:
    """Log-likelihood of a profile's size and length, a shape's, and noise (5,), up to a
    constant."""
    at, z, known, variance = some
    S = known + _shape(at, at, each, road, radius)
    S[np.diag_indices_from(S)] += variance + each[4] ** 2
    lower = cho_factor(S, lower=True, check_finite=False)
    return float(-z @ cho_solve(lower, z) / 2 - np.log(np.diag(lower[0])).sum())


def _road(at: Array, z: Array, known: Array, variance: Array, radius: float) -> float:
    """Find the direction across the road, rad."""
    some, usual = (at, z, known, variance), np.array(USUAL)
    tried: Array = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    best = 0.0
    for turn in (0.0, *np.radians(TURNS)):
        if turn:
            tried = best + np.array([-turn, 0.0, turn])
        fits = [_log_likelihood(some, usual, float(road), radius) for road in tried]
        best = float(tried[int(np.argmax(fits))])
    return best


def _shape(a: Array, b: Array, each: Array, road: float, radius: float) -> Array:
    """Covariance of the shape between places (N, 2) and (M, 2)."""
    profile, across, size, length = each[:4]
    found = size**2 * _matern(
        np.hypot(a[:, None, 0] - b[:, 0], a[:, None, 1] - b[:, 1]) / (length * radius)
    )
    if profile:
        axis = np.array([np.cos(road), np.sin(road)])
        widths = np.abs((a @ axis)[:, None] - b @ axis)
        found += profile**2 * _matern(widths / (across * radius))
    return np.asarray(found)


def _matern(apart: Array) -> Array:
    """Correlation at a distance, in lengths."""
    scaled = np.sqrt(3) * apart
    return np.asarray((1 + scaled) * np.exp(-scaled))


def _disc(radius: float) -> Array:
    """(D, 2) middles of the cells of the disc."""
    steps = (np.arange(-CELLS, CELLS) + 0.5) * radius / CELLS
    x, y = (each.ravel() for each in np.meshgrid(steps, steps, indexing="ij"))
    return np.asarray(np.stack([x, y], axis=1)[np.hypot(x, y) < radius])


def _functionals(disc: Array) -> Array:
    """(6, D) the best plane's height and slopes, and the best paraboloid's x², xy and y²."""
    x, y = disc.T
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    bent = np.c_[plane, x * x, x * y, y * y]
    return np.asarray(np.concatenate([np.linalg.pinv(plane), np.linalg.pinv(bent)[3:]]))


def _bend(terms: Array, covariance: Array, radius: float) -> tuple[float, float]:
    """Largest depth of the edge of the disc below its middle, metres, and 1 σ."""
    values, vectors = np.linalg.eigh(np.array([[terms[0], terms[1] / 2], [terms[1] / 2, terms[2]]]))
    v = vectors[:, np.argmax(np.abs(values))]
    along = -(radius**2) * np.array([v[0] ** 2, v[0] * v[1], v[1] ** 2])
    return float(along @ terms), float(np.sqrt(along @ covariance @ along))


def ground_frame(plane: Array, T_rough_frame: Array) -> Array:
    """(4, 4) frame of the ground from the frame of all, for a plane (3,) in rough axes."""
    up = T_rough_frame[:3, :3].T @ np.array([-plane[1], -plane[2], 1.0])
    up /= np.linalg.norm(up)
    on = se3.apply(se3.inverse(T_rough_frame), np.array([[0.0, 0.0, plane[0]]]))[0]
    R = level_axes(up)
    return se3.from_rt(R, -R @ ((on @ up) * up))


def _over(plane: Array, rough: Array, viewer: Viewer, covariance: Array) -> LidarLevel:
    """Pose of a LiDAR over a plane; the covariance (9, 9) is of the plane and its pose."""

    def pose(state: Array) -> Array:
        return ground_frame(plane + state[:3], rough) @ se3.retract(viewer.T, state[3:])

    def angles(T: Array) -> Array:
        return np.asarray(np.r_[se3.rpy_from_rotation(T[:3, :3])[:2], T[2, 3]])

    T = pose(np.zeros(9))
    moved = [(pose(step), pose(-step)) for step in JACOBIAN_STEP * np.eye(9)]
    J = np.stack([se3.local(b, a) for a, b in moved], axis=1) / (2 * JACOBIAN_STEP)
    own = np.stack([_turn(angles(a) - angles(b)) for a, b in moved], axis=1) / (2 * JACOBIAN_STEP)
    whole = J @ covariance @ J.T
    # Numerical differences leave rounding errors in parameters fixed by the definition of the
    # frame.
    fixed = np.diag(whole) < 1e-18
    whole[fixed] = whole[:, fixed] = 0.0
    roll, pitch, height = angles(T)
    return LidarLevel(
        viewer.name, T, whole, float(roll), float(pitch), float(height), own @ covariance @ own.T
    )


def _turn(difference: Array) -> Array:
    """Bring a difference of roll, pitch and height to the near side of the half turn."""
    roll = (difference[0] + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.r_[roll, difference[1:]])
