"""A carried pole as two LiDARs in empty space see it, without noise, and the truth about it."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.carried.track import Track
from retropole.simulation.raycast import meet

RADIUS = 0.02
STEP = float(np.radians(0.2))
ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))


class SeenWalk(NamedTuple):
    """Tracks of the target and the source, their true pose (4, 4) and clock offset, s."""

    tracks: tuple[Track, Track]
    T_target_source: Array
    offset: float


REST = 1.5
"""How long a pole rests, s, within every four."""


def axis_at(times: Array, lean: float = 0.25, rests: bool = False) -> tuple[Array, Array]:
    """Where a pole is, (N, 3), and where it points, (N, 3), at times (N,), s."""
    if rests:
        # It comes to rest smoothly, for 1.5 of each 4 s.
        fine = np.arange(0.0, 40.0, 0.01)
        speed = np.clip(np.abs((fine + 2.0) % 4.0 - 2.0) - REST / 2, 0.0, 0.4) / 0.4
        times = np.interp(times, fine, np.cumsum(speed) * 0.01)
    middle = np.stack([4 + np.sin(0.6 * times), 1.5 * np.cos(0.45 * times), 0 * times], axis=1)
    slope = lean * np.stack([np.sin(1.1 * times), np.cos(0.9 * times + 1)], axis=1)
    along = np.concatenate([slope, np.ones((len(times), 1))], axis=1)
    return middle, along / np.linalg.norm(along, axis=1, keepdims=True)


Axis = Callable[[Array], tuple[Array, Array]]
"""Where a pole is and where it points at times, as `axis_at`."""


def _track(T_world_lidar: Array, ahead: float, seconds: float, axis: Axis, phase: float) -> Track:
    """What a LiDAR whose clock is ahead by some seconds sees, sweep by sweep."""
    parts = []
    for k in range(int(10 * seconds)):
        begun = 0.1 * k + phase
        place = se3.apply(se3.inverse(T_world_lidar), axis(np.array([begun + 0.05]))[0])
        about = np.arctan2(place[0, 1], place[0, 0])
        # Azimuths go round once in a sweep.
        number = np.arange(-14, 15) + round(about / STEP)
        azimuth = np.repeat(number * STEP, len(ELEVATIONS))
        ring = np.tile(np.arange(len(ELEVATIONS)), len(number))
        elevation = ELEVATIONS[ring]
        rays = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)], axis=1
        )
        rays = np.concatenate([rays, np.sin(elevation)[:, None]], axis=1)
        time = begun + (azimuth / (2 * np.pi) % 1.0) * 0.1
        middle, along = axis(time)
        world = rays @ T_world_lidar[:3, :3].T
        found = meet(T_world_lidar[:3, 3] - middle, along, world, (RADIUS, 2.0), 0.0).ranges
        hit = np.isfinite(found)
        parts.append((found[hit, None] * rays[hit], time[hit] + ahead, ring[hit]))
    parts = [part for part in parts if len(part[0]) > 5]
    true = np.array([part[1].mean() - ahead for part in parts])
    middle, along = axis(true)
    T = se3.inverse(T_world_lidar)
    xyz, stamps, rings = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Track(
        times=true + ahead,
        points=se3.apply(T, middle),
        directions=along @ T[:3, :3].T,
        xyz=xyz,
        stamps=stamps,
        rings=rings,
        sweep=np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]),
        is_whole=np.ones(len(xyz), dtype=bool),
        sweeps=int(10 * seconds),
        crowded=0.0,
    )


def seen_walk(
    seconds: float = 12.0,
    lean: float = 0.25,
    offset: float = 0.731,
    rests: bool = False,
    axis: Axis | None = None,
) -> SeenWalk:
    """Walk before two LiDARs, the source's clock ahead by an offset, s."""
    axis = axis or partial(axis_at, lean=lean, rests=rests)
    turn = se3.exp_so3(np.array([0.05, -0.04, 2.3]))
    T = se3.from_rt(turn, np.array([8.0, 1.0, 0.3]))
    return SeenWalk(
        (
            _track(np.eye(4), 0.0, seconds, axis, 0.0),
            _track(T, offset, seconds, axis, 0.037),
        ),
        T,
        offset,
    )


def seen_by_all(seconds: float = 6.0) -> tuple[list[Track], Array]:
    """Walk before three LiDARs: their tracks, each by its own clock, and poses (3, 4, 4)."""
    turns = np.array([[0.0, 0.0, 0.0], [0.05, -0.04, 2.3], [-0.03, 0.06, -1.7]])
    places = np.array([[0.0, 0.0, 0.0], [8.0, 1.0, 0.3], [4.0, 6.0, -0.2]])
    poses = se3.from_rt(np.array([se3.exp_so3(turn) for turn in turns]), places)
    tracks = [
        _track(T, ahead, seconds, partial(axis_at, lean=0.25, rests=False), phase)
        for T, ahead, phase in zip(poses, (0.0, 0.731, -0.42), (0.0, 0.037, 0.071), strict=True)
    ]
    return tracks, poses
