"""A LiDAR in a hall that moves a little while it records: small, and the motion is known."""

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, Scan
from retropole.surfaces.scans import find_poles

HALF = np.array([6.0, 5.0, 2.0])
"""Half of the sides of the hall, metres."""

SWEEP = 0.1


def beams() -> Array:
    """Unit vectors of 24 rings, each of 240 beams."""
    azimuth = np.radians(np.arange(0.0, 360.0, 1.5))
    elevation = np.radians(np.linspace(-35.0, 25.0, 24))
    level, up = np.cos(elevation), np.sin(elevation)
    x, y = np.cos(azimuth)[:, None] * level, np.sin(azimuth)[:, None] * level
    return np.stack(np.broadcast_arrays(x, y, up), axis=-1).reshape(-1, 3)


def recorded(
    motions: Array,
    rng: np.random.Generator,
    noise: float = 0.01,
    *,
    parts: int = 8,
    at: Array | None = None,
) -> PointCloud:
    """Record with turn and shift (F × parts, 6) of each part of each sweep, one after the other.

    At rest the LiDAR stands in the middle of the hall, or at `at` (3,), with the axes of the hall.
    """
    rests = np.zeros(3) if at is None else at
    rays = beams()
    part = np.arange(len(rays)) * parts // len(rays)
    xyz, time, frame = [], [], []
    for k, own in enumerate(motions.reshape(-1, parts, 6)):
        for p in range(parts):
            mine = rays[part == p]
            R, origin = se3.exp_so3(own[p, :3]), rests + own[p, 3:]
            world = mine @ R.T
            towards = np.where(world > 0, HALF - origin, HALF + origin)
            away = towards / np.maximum(np.abs(world), 1e-12)
            ranges = away.min(axis=1) + noise * rng.normal(size=len(mine))
            xyz.append(ranges[:, None] * mine)
            time.append(np.full(len(mine), (k + (p + 0.5) / parts) * SWEEP))
            frame.append(np.full(len(mine), k))
    at, when = np.concatenate(time), np.concatenate(frame).astype(np.int64)
    return PointCloud(np.concatenate(xyz), time=at, frame=when)


def swaying(
    sweeps: int,
    sigma: float,
    frequency: float,
    rng: np.random.Generator,
    parts: int = 8,
    *,
    second: float = 0.0,
) -> Array:
    """(sweeps × parts, 6) motion of a mast about a level axis, 5 m above its foot, 1 σ in rad.

    `second` is the size of a mode three times as fast, of that of the first.
    """
    times = (np.arange(sweeps * parts) + 0.5) * SWEEP / parts
    turn = np.zeros((len(times), 3))
    for size, hz in ((sigma, frequency), (second * sigma, 3 * frequency)):
        heading, phase = rng.uniform(0, 2 * np.pi, 2)
        angle = np.sqrt(2) * size * np.sin(2 * np.pi * hz * times + phase)
        turn += angle[:, None] * np.array([np.cos(heading), np.sin(heading), 0.0])
    return np.concatenate([turn, np.cross(turn, [0.0, 0.0, 5.0])], axis=1)


def scan_on_mast(motion: Array, T: Array, rng: np.random.Generator) -> Scan:
    """Record with a LiDAR whose pose in the hall, at rest, is `T`, on a mast that moves in it.

    `motion` (sweeps × parts, 6) is of what is in the middle of the hall.
    """
    at = T[:3, 3]
    beside = motion.copy()
    beside[:, 3:] += np.cross(motion[:, :3], at)
    cloud = recorded(beside, rng, at=at).transformed(se3.from_rt(T[:3, :3].T, np.zeros(3)))
    scan = find_poles(cloud, sensor=None, threshold=None, radius=0.02, search=False)
    assert scan.motion is not None
    return scan
