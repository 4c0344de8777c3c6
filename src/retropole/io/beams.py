"""What the beams of a cloud show: whether its rings are rings, where beams start, and which sensor.

Converters fill the field of the rings with zeros, or with the number of the column or the packet.
A program that has moved a cloud into the frame of a vehicle mostly leaves no word of where the
LiDAR was. Its rings still show it: the beams of one ring make a cone, and the cones of all rings
have their apex and their axis in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import Array, IntArray, PointCloud, kept
from ..base.se3 import lengths
from ..base.sensors import SENSORS, Sensor

MAX_RINGS = 256
"""No LiDAR of the table of sensors has more than 128 rings; more numbers are columns or packets."""

RING_SAMPLE = 5_000
"""Points, evenly taken, whose elevations are compared: 40 on each of 128 rings."""

MAX_RING_SPREAD = float(np.radians(0.5))
"""Half of the points of a ring lie within this of its elevation, rad, where the cloud is in its
sensor's frame."""


def rings_fault(cloud: PointCloud) -> str:
    """State why the rings of a cloud are invalid; nothing if they are valid, or if it has none.

    A cloud that another program has moved keeps its rings: their elevations are lost, but the
    points of one ring still follow each other.

    Parameters
    ----------
    cloud
        In any frame.
    """
    if cloud.ring is None or len(cloud) == 0:
        return ""
    if np.ptp(cloud.ring) == 0:
        return f"all {len(cloud):,} points have the ring {cloud.ring[0]}"
    # Counting takes a sort; a field with few values needs none.
    values = len(np.unique(cloud.ring)) if np.ptp(cloud.ring) >= MAX_RINGS else 0
    if values > MAX_RINGS:
        return f"{values:,} different rings, more than any LiDAR has"
    spread = ring_spread(cloud)
    if spread <= MAX_RING_SPREAD or _rings_cohere(cloud.xyz, cloud.ring):
        return ""
    return (
        f"half of the points of a ring lie {np.degrees(spread):.1f}° and more from its elevation, "
        "and neighbours are on different rings"
    )


def with_trusted_rings(cloud: PointCloud) -> PointCloud:
    """Leave out rings that are none; the cloud itself where they are."""
    return replace(cloud, ring=None) if rings_fault(cloud) else cloud


def ring_spread(cloud: PointCloud) -> float:
    """How far the points of a ring typically lie from its median elevation, rad, seen from the
    cloud's origin; infinite for a cloud without rings.
    """
    if cloud.ring is None or len(cloud) == 0:
        return float("inf")
    part = slice(None, None, 1 + (len(cloud) - 1) // RING_SAMPLE)
    elevation = elevations(cloud.xyz[part] - cloud.origin, cloud.axis)
    return float(np.median(off_ring(elevation, cloud.ring[part])))


def elevations(rays: Array, axis: Array) -> Array:
    """Elevations (N,) of rays (N, 3) above the plane across a unit axis (3,), rad."""
    return np.asarray(np.arcsin(np.clip(rays @ axis / lengths(rays), -1.0, 1.0)))


BEYOND_VIEW = float(np.radians(2.0))
"""So far beyond the field of view of the table a ring's elevation is none of the sensor, rad. Units
of one model differ by some tenths of a degree; the largest step between rings at the end of a field
of view is 10° (RS-LiDAR-32), inside it."""

MANY_BEYOND = 0.05
"""Part of the points of a cloud without rings that may be beyond it: near returns, since not all
beams start in one point."""


def is_wider(cloud: PointCloud, sensor: Sensor) -> bool:
    """Whether a cloud has azimuths over more than a sensor sees, wherever its first one is."""
    if sensor.sees_all_around:
        return False
    return azimuth_arc(cloud) > sensor.turn + 2 * BEYOND_VIEW


def azimuth_arc(cloud: PointCloud) -> float:
    """Width of the smallest range of azimuths about a cloud's axis that contains all but
    `MANY_BEYOND` of its points, rad; the cloud has the origin and the axis of its beams.
    """
    rays = cloud.xyz[:: 1 + (len(cloud) - 1) // RING_SAMPLE] - cloud.origin
    first = np.cross(cloud.axis, np.eye(3)[int(np.argmin(np.abs(cloud.axis)))])
    second = np.cross(cloud.axis, first)
    azimuth = np.sort(np.arctan2(rays @ second, rays @ first))
    most = int(np.ceil((1 - MANY_BEYOND) * len(azimuth))) - 1
    ends = np.concatenate([azimuth, azimuth + 2 * np.pi])
    return float(np.min(ends[most : most + len(azimuth)] - azimuth))


def off_ring(elevation: Array, ring: IntArray) -> Array:
    """How far elevations (N,) are from the median of their rings (N,), in order of the rings."""
    order = np.lexsort((elevation, ring))
    elevation, ring = elevation[order], ring[order]
    first = np.flatnonzero(np.r_[True, ring[1:] != ring[:-1]])
    count = np.diff(np.r_[first, len(ring)])
    return np.asarray(np.abs(elevation - np.repeat(elevation[first + count // 2], count)))


def _rings_cohere(xyz: Array, ring: IntArray) -> bool:
    """Whether nearest neighbours are on one ring more often than by chance."""
    sample = np.linspace(0, len(xyz) - 1, 500).astype(int)
    _, nearest = cKDTree(xyz).query(xyz[sample], 2)
    share = float(np.mean(ring[nearest[:, 1]] == ring[sample]))
    _, counts = np.unique(ring, return_counts=True)
    chance = float(np.sum((counts / counts.sum()) ** 2))
    # In simulated streets, quays and corridors 0.48 (Pandar64) to 1.0 (VLP-16) of the nearest
    # neighbours are on the same ring.
    return share >= max(0.25, min(3.0 * chance, 0.9))


SAMPLE = 20_000
"""Points, evenly taken, that the cones are fitted to: 150 on each of 128 rings."""

MOST, CONE_SPREAD = 0.9, float(np.radians(0.1))
"""Rings are cones where this share of their points lies this near to them, rad. Drivers compute
points from the angles of the beams, so that all of them do: 0.0004° on a Pandar64. Of 144 moved
clouds, simulated, 143 came back within 1 mm; false cones have 0.18° and more."""

MAX_FIT_STEPS = 40
"""Steps of the fit."""


@dataclass(frozen=True, eq=False)
class Cones:
    """Apex (3,) and axis (3,) of the cones of all rings, and the spread about them, rad."""

    apex: Array
    axis: Array
    spread: float


def with_beam_origin(cloud: PointCloud) -> PointCloud:
    """Give the cloud the beam origin and the axis by its rings.

    Parameters
    ----------
    cloud
        In any frame, with rings that are rings (`rings.with_trusted_rings`) or none.

    Returns
    -------
    PointCloud
        The cloud itself if its rings agree with its origin and axis already, or if they show no
        other: rings of a rosette are not cones, nor are those of a sweep undistorted in motion.
    """
    if cloud.ring is None or len(cloud) < MAX_FIT_STEPS:
        return cloud
    located = _axis_from_rings(cloud)
    return cloud if located is None else replace(cloud, origin=located.apex, axis=located.axis)


@kept
def _axis_from_rings(cloud: PointCloud) -> Cones | None:
    """The cones of the rings of a cloud, their axis to the side of that of the cloud; None if it
    has these origin and axis already, and if there are none.
    """
    assert cloud.ring is not None
    part = slice(None, None, 1 + (len(cloud) - 1) // RING_SAMPLE)
    if _spread(cloud.xyz[part], cloud.ring[part], cloud.origin, cloud.axis) <= CONE_SPREAD:
        return None
    part = slice(None, None, 1 + (len(cloud) - 1) // SAMPLE)
    points, ring = cloud.xyz[part], np.unique(cloud.ring[part], return_inverse=True)[1]
    if ring.max() == 0:
        return None
    for start in (cloud.origin, densest(points), np.median(points, axis=0)):
        # A part shows first whether there are cones at all: where a sweep was undistorted in
        # motion, there are none, from whichever start.
        about = fit_cones(points[::4], ring[::4], start)
        if about.spread > 2 * CONE_SPREAD:
            continue
        found = fit_cones(points, ring, about.apex)
        near, far = np.quantile(np.linalg.norm(points - found.apex, axis=1), [0.05, 0.95])
        # Seen from far away all points have one elevation, whatever their ring.
        if found.spread <= CONE_SPREAD and far > 2.0 * near:
            along = found.axis if found.axis @ cloud.axis >= 0.0 else -found.axis
            return replace(found, axis=along)
    return None


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
        if np.abs(step).max() < 1e-7:
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


def densest(points: Array) -> Array:
    """Mean (3,) of the points in the fullest cube of 1 m."""
    # Most points are near a LiDAR.
    cells = np.floor(points)
    _, label, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(points[label == np.argmax(count)].mean(axis=0))


def _spread(points: Array, ring: IntArray, apex: Array, axis: Array) -> float:
    """Angle within which `MOST` of the points lie about the median elevation of their ring, rad."""
    return float(np.quantile(off_ring(elevations(points - apex, axis), ring), MOST))


MIN_RING_POINTS = 20
"""Rings with fewer points are left out: their median elevation is not reliable, and a few points
may carry a wrong number."""

RING_TOLERANCE, RING_TOLERANCE_OF_STEP = np.radians(0.35), 0.3
"""How far a ring's elevation may be from that of the table, rad, or as a part of the step between
rings, whichever is larger. Units of one model differ, and near returns show that beams do not
start in one point."""

POINT_TOLERANCE, MIN_SEPARATION = np.radians(0.1), 4
"""Without rings: how far a point's elevation may be from that of a ring of the table, rad; for
sensors whose rings are at least this many times as far from each other."""

MIN_SEEN_SHARE = 0.5
"""Share of the sensor's rings that must have returns: outdoors the sky gives none."""


def guess_sensors(cloud: PointCloud, named: Sensor | None = None) -> list[str]:
    """Name the sensors whose elevations a cloud has; empty if no sensor fits.

    With rings, the elevation of each ring is compared with the table; without, the elevations of
    all points are, for sensors whose rings are far enough from each other. Sensors with the same
    elevations are all named. A cloud that was rotated out of its sensor's frame fits none, unless
    its rings show where it was.

    Parameters
    ----------
    cloud
        In the sensor's frame, or with the origin and the axis of its beams.
    named
        A sensor to try besides those of the table.
    """
    cloud = with_beam_origin(cloud)
    # More take time and change nothing.
    part = cloud.select(np.arange(0, len(cloud), max(1, len(cloud) // 200_000)))
    ray = part.xyz - part.origin
    ranges, elevation = np.linalg.norm(ray, axis=1), elevations(ray, part.axis)
    known = SENSORS if named is None else {**SENSORS, named.name: named}
    spinning = [sensor for sensor in known.values() if sensor.rings]
    if part.ring is not None and np.ptp(part.ring):
        rings = _ring_elevations(elevation, ranges, part.ring)
        fitting = [own for own in spinning if rings and _rings_fit(own, rings)]
    else:
        fitting = [own for own in spinning if _points_fit(own, elevation)]
    return [sensor.name for sensor in fitting if not is_wider(part, sensor)]


def _ring_elevations(elevation: Array, ranges: Array, ring: IntArray) -> dict[int, float]:
    """Find the median elevation of each ring's farther half, rad.

    Empty if the points of a ring do not share one elevation.
    """
    elevations: dict[int, float] = {}
    spreads: list[float] = []
    order = np.argsort(ring, kind="stable")
    for one in np.split(order, np.flatnonzero(np.diff(ring[order])) + 1):
        far = ranges[one]
        own = elevation[one[far >= np.median(far)]]
        if len(own) >= MIN_RING_POINTS:
            elevations[int(ring[one[0]])] = median = float(np.median(own))
            spreads.append(float(np.median(np.abs(own - median))))
    return elevations if spreads and np.median(spreads) <= MAX_RING_SPREAD else {}


def _rings_fit(sensor: Sensor, rings: dict[int, float]) -> bool:
    """Whether each ring has its elevation, counted from the lowest or highest and from 0 or 1."""
    table = sensor.elevations
    numbers = np.array(list(rings))
    elevations = np.array(list(rings.values()))
    if len(rings) < MIN_SEEN_SHARE * len(table):
        return False
    step = float(np.median(np.diff(table)))
    within = max(RING_TOLERANCE, RING_TOLERANCE_OF_STEP * step)
    return any(
        np.max(np.abs(elevations - ordered[numbers - first])) <= within
        for first in (0, 1)
        if first <= numbers.min() and numbers.max() < len(table) + first
        for ordered in (table, table[::-1])
    )


def _points_fit(sensor: Sensor, elevation: Array) -> bool:
    """Whether most points are at the elevation of a ring, and most rings have points."""
    table = sensor.elevations
    if np.diff(table).min() < MIN_SEPARATION * POINT_TOLERANCE:
        return False
    after = np.clip(np.searchsorted(table, elevation), 1, len(table) - 1)
    index = after - (elevation - table[after - 1] < table[after] - elevation)
    fitting = np.abs(elevation - table[index]) <= POINT_TOLERANCE
    seen = len(np.unique(index[fitting])) / len(table)
    return bool(np.mean(fitting) >= 0.95 and seen >= MIN_SEEN_SHARE)
