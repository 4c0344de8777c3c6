"""Where the beams of a cloud start, and the axis that they turn about, by its rings.

A program that has moved a cloud into the frame of a vehicle mostly leaves no word of where the
LiDAR was. Its rings still tell: the beams of one ring make a cone, and the cones of all rings have
their apex and their axis in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from .rings import RING_SAMPLE, elevations, off_ring

SAMPLE = 20_000
"""Points, evenly taken, that the cones are fitted to: 150 on each of 128 rings."""

FEW = 4
"""Every so many of them tell first whether there are cones at all, within twice the spread: where a
sweep was undistorted in motion, there are none, from whichever start."""

MOST, CONE_SPREAD = 0.9, float(np.radians(0.1))
"""Rings are cones where so many of their points lie so near to them, rad. Drivers compute points
from the angles of the beams, so that all of them do: 0.0004° on a Pandar64. Of 144 moved clouds,
simulated, 143 came back within 1 mm; false cones have 0.18° and more."""

LEAST_RATIO = 2.0
"""One in twenty ranges is so many times shorter than one in twenty others, at least: seen from far
away all points have one elevation, whatever their ring."""

MAX_FIT_STEPS, FIT_STEP = 40, 1e-7
"""Steps of the fit, and the one to stop at, rad and m."""

DENSEST_CELL = 1.0
"""The fit also starts from the fullest cube of this side, metres: most points are near a LiDAR."""


@dataclass(frozen=True, eq=False)
class Cones:
    """Apex (3,) and axis (3,) of the cones of all rings, and the spread about them, rad."""

    apex: Array
    axis: Array
    spread: float


def with_beam_origin(cloud: PointCloud) -> PointCloud:
    """Give the cloud the beam origin and the axis that its rings tell.

    Parameters
    ----------
    cloud
        In any frame, with rings that are rings (`rings.with_trusted_rings`) or none.

    Returns
    -------
    PointCloud
        The cloud itself where its rings agree with its origin and axis already, and where they tell
        no other: rings of a rosette are no cones, nor are those of a sweep undistorted in motion.
    """
    if cloud.ring is None or len(cloud) < MAX_FIT_STEPS:
        return cloud
    part = slice(None, None, 1 + (len(cloud) - 1) // RING_SAMPLE)
    if _spread(cloud.xyz[part], cloud.ring[part], cloud.origin, cloud.axis) <= CONE_SPREAD:
        return cloud
    part = slice(None, None, 1 + (len(cloud) - 1) // SAMPLE)
    points, ring = cloud.xyz[part], np.unique(cloud.ring[part], return_inverse=True)[1]
    if ring.max() == 0:
        return cloud
    for start in (cloud.origin, _densest(points), np.median(points, axis=0)):
        about = fit_cones(points[::FEW], ring[::FEW], start)
        if about.spread > 2 * CONE_SPREAD:
            continue
        found = fit_cones(points, ring, about.apex)
        near, far = np.quantile(np.linalg.norm(points - found.apex, axis=1), [0.05, 0.95])
        if found.spread <= CONE_SPREAD and far > LEAST_RATIO * near:
            along = found.axis if found.axis @ cloud.axis >= 0.0 else -found.axis
            return replace(cloud, origin=found.apex, axis=along)
    return cloud


def fit_cones(points: Array, ring: IntArray, start: Array) -> Cones:
    """Fit cones with one apex and one axis to the rings, by Levenberg–Marquardt.

    Of each point the distance ``(p − o)·a − s_k |p − o|`` from the cone of its ring is made small,
    with the sine s_k of each ring's elevation eliminated, and outliers weighed down in the end.

    Parameters
    ----------
    points, ring
        (N, 3) metres, and (N,) numbers of rings from 0 up.
    start
        (3,) where the apex is looked for first.
    """
    apex, damping = start, 1e-3
    axis = _axis_of(points - apex, ring)
    weights = np.ones(len(points))
    for iteration in range(MAX_FIT_STEPS):
        residuals = _distances(points, ring, apex, axis, weights)[0]
        # What the start is off by makes no point an outlier.
        scale = max(
            1.4826 * float(np.median(np.abs(residuals))),
            float(np.sqrt(np.mean(residuals**2))) * 0.5**iteration,
        )
        weights = 1.0 / (1.0 + (residuals / (3.0 * scale + 1e-9)) ** 2) ** 2
        residuals, ray, ranges, sine = _distances(points, ring, apex, axis, weights)
        aside = np.linalg.svd(axis[None])[2][1:]
        J = np.concatenate([ray @ aside.T, sine[:, None] * ray / ranges[:, None] - axis], axis=1)
        share = _means(J / ranges[:, None], ring, weights * ranges**2)
        J = J - ranges[:, None] * share[ring]
        H, gradient = (J.T * weights) @ J, (J.T * weights) @ residuals
        cost = float(weights @ residuals**2)
        for _ in range(8):
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(5), gradient)
            turned = axis + aside.T @ step[:2]
            turned /= np.linalg.norm(turned)
            tried = _distances(points, ring, apex + step[2:], turned, weights)[0]
            if float(weights @ tried**2) <= cost:
                break
            damping *= 10.0
        else:
            break
        apex, axis, damping = apex + step[2:], turned, max(damping / 10.0, 1e-12)
        if np.abs(step).max() < FIT_STEP:
            break
    return Cones(apex, axis, _spread(points, ring, apex, axis))


def _distances(
    points: Array, ring: IntArray, apex: Array, axis: Array, weights: Array
) -> tuple[Array, Array, Array, Array]:
    """Distances (N,) from the cones, rays (N, 3), ranges (N,), and the sine (N,) of each ring."""
    ray = points - apex
    ranges = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    along = ray @ axis
    sine = _means((along / ranges)[:, None], ring, weights * ranges**2)[ring, 0]
    return along - sine * ranges, ray, ranges, sine


def _means(values: Array, ring: IntArray, weights: Array) -> Array:
    """(K, D) weighted means of values (N, D) on each ring."""
    total = np.maximum(np.bincount(ring, weights), 1e-300)
    return np.stack([np.bincount(ring, weights * column) / total for column in values.T], axis=1)


def _axis_of(ray: Array, ring: IntArray) -> Array:
    """Direction (3,) along which the beams of a ring differ least, seen from the apex."""
    unit = ray / np.maximum(np.linalg.norm(ray, axis=1), 1e-9)[:, None]
    off = unit - _means(unit, ring, np.ones(len(unit)))[ring]
    return np.asarray(np.linalg.eigh(off.T @ off)[1][:, 0])


def _densest(points: Array) -> Array:
    """Mean (3,) of the points in the fullest cube."""
    cells = np.floor(points / DENSEST_CELL)
    _, label, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(points[label == np.argmax(count)].mean(axis=0))


def _spread(points: Array, ring: IntArray, apex: Array, axis: Array) -> float:
    """Angle within which `MOST` of the points lie about the median elevation of their ring, rad."""
    return float(np.quantile(off_ring(elevations(points - apex, axis), ring), MOST))
