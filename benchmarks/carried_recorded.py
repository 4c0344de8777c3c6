"""Walks planted into real recordings: is the transform found that planted them?

Usage:
    python benchmarks/carried_recorded.py data --draws 12
    python benchmarks/carried_recorded.py data --packets hesai_64 hesai_xt32 --first 5100 --draws 6

A frame of PandaSet, Pandar64 and PandarGT, is repeated as the background of a walk, its stamps
later by 0.1 s each time. Pole, hand and person are met by its beams, those that returned and those
between them, each at its own time. Elevations, firing times, the order of the beams, what hides the
pole and what else is bright are real; the ranges to the pole have errors that are drawn. `data` is
the folder with the recordings. Seeds below 1000 tune; seeds from 5000 state.

With --packets the background is two recordings of packets, turn after turn, with rings, times and
order of the beams as they are decoded. They are of different rooms, too small for a walk: what is
near in the direction of the walk is taken out, and both stand where a seed says.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from carried import AT, CHI2, WRONG_CLOCK, Missed
from insertion.inserting import RING_BIAS, TAPE_OFFSET
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import SWEEP_SECONDS, Sensor, sensor_or_auto
from retropole.carried.walk import calibrate_walk
from retropole.io import open_recording
from retropole.simulation.raycast import meet
from retropole.simulation.recorded import RecordedBeams, recorded_beams
from retropole.simulation.walks import Walk, draw_walk
from semireal import load

PAIR, AHEAD, CLEAR = "pandaset 05", 6.5, (2.0, 2.0)
"""The walk is so far ahead, within the view of the PandarGT, and within half extents, metres."""

RANGE_NOISE, CLOCK, BRIGHT, DARK = 0.01, 2.0, 255.0, 10.0
"""1 σ of a range, metres; clocks differ by up to so much, s; intensities of tape and of others."""


BEARING, ROOM = float(np.radians(60.0)), 9.0
"""So far to either side of the walk, rad, what is nearer to the LiDAR is taken out, metres."""

WHOLE, TILT = 0.9, float(np.radians(3.0))
"""A turn has so large a share of the most points; 1 σ of a LiDAR's tilt about two axes, rad."""


class Lidar(NamedTuple):
    """Turns of a recording with their beams, one after the other; its sensor, and its pose (4, 4)
    in the walk's frame.
    """

    turns: Sequence[tuple[PointCloud, RecordedBeams]]
    sensor: Sensor | None
    T_walk_lidar: Array


def of_packets(path: Path) -> list[tuple[PointCloud, RecordedBeams]]:
    """Read the whole turns of packets, one return of each beam, with room for a walk at −x."""
    recording = open_recording(path)
    clouds = [frame.cloud for frame in recording.read(range(recording.count))]
    most = max(map(len, clouds))
    turns = []
    for cloud in clouds:
        # The first turn and the last may be parts. Both returns of a beam have one time.
        if len(cloud) < WHOLE * most:
            continue
        assert cloud.ring is not None
        assert cloud.time is not None
        beams = np.unique(np.stack([cloud.ring, cloud.time], axis=1), axis=0, return_index=True)[1]
        cloud = cloud.select(np.sort(beams))
        found = recorded_beams(cloud)
        level = -found.directions[:, 0] / np.linalg.norm(found.directions[:, :2], axis=1)
        is_near = (level > np.cos(BEARING)) & (found.ranges < ROOM)
        turns.append((cloud, replace(found, ranges=np.where(is_near, np.inf, found.ranges))))
    return turns


def drawn_poses(rng: np.random.Generator) -> list[Array]:
    """Draw where two LiDARs stand about a walk, whose −x axes are towards it: (4, 4) each."""
    first, between = rng.uniform(0, 2 * np.pi), rng.uniform(np.pi / 3, np.pi)
    poses = []
    for bearing in (first, first + between):
        R = Rotation.from_euler("zyx", [bearing, *rng.normal(0, TILT, 2)]).as_matrix()
        away, height = rng.uniform(4.5, 6.0), rng.uniform(1.0, 1.6)
        place = away * np.array([np.cos(bearing), np.sin(bearing), 0.0]) + [0, 0, height]
        poses.append(se3.from_rt(R, place))
    return poses


def where_to_walk(target: PointCloud, source: PointCloud, T: Array) -> Array:
    """(4, 4) from the walk's frame to the target's: on the ground, in the middle of both views."""
    ahead = T[:3, :3] @ source.xyz.mean(axis=0)
    middle = AHEAD * ahead[:2] / np.linalg.norm(ahead[:2])
    near = np.linalg.norm(target.xyz[:, :2] - middle, axis=1) < 2.0
    ground = float(np.quantile(target.xyz[near, 2], 0.05))
    return se3.from_rt(np.eye(3), np.r_[middle, ground])


def times_of(cloud: PointCloud, beams: RecordedBeams) -> Array:
    """Times (M,) of beams: of one put back, that of the return next to it and of the turn since."""
    assert cloud.time is not None
    azimuth = np.arctan2(beams.directions[:, 1], beams.directions[:, 0])
    own = np.lexsort((cloud.time, beams.rings[: len(cloud)]))
    turned, after = _wrapped(np.diff(azimuth[own])), np.diff(cloud.time[own])
    rate = float(np.median(turned[after > 0] / after[after > 0]))
    since = _wrapped(azimuth - azimuth[beams.like]) / rate if len(azimuth) > len(cloud) else 0.0
    return np.asarray(cloud.time[beams.like] + since)


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def planted(
    lidar: Lidar, walk: Walk, clock: float, rng: np.random.Generator
) -> Iterator[PointCloud]:
    """Record a walk sweep by sweep with the beams of a recording."""
    most = max(int(beams.rings.max()) for _, beams in lidar.turns)
    rings = RING_BIAS * rng.normal(size=max(most, 0) + 1)
    offset = TAPE_OFFSET * rng.normal()
    width = 0.003 if lidar.sensor is None else lidar.sensor.divergence
    T_lidar_walk = se3.inverse(lidar.T_walk_lidar)
    R, start = T_lidar_walk[:3, :3], lidar.T_walk_lidar[:3, 3]
    for k in range(int(walk.seconds / SWEEP_SECONDS)):
        cloud, beams = lidar.turns[k % len(lidar.turns)]
        assert cloud.intensity is not None
        bias = np.r_[rings, 0.0][beams.rings] + offset
        rays = beams.directions @ R
        times = times_of(cloud, beams)
        times += SWEEP_SECONDS * k - times.min()
        toward = walk.hand(times[:1])[0] - start
        near = np.flatnonzero(rays @ toward > np.cos(0.5) * np.linalg.norm(toward))
        ranges, bright = beams.ranges.copy(), cloud.intensity[beams.like]
        for part in walk.parts(times[near]):
            found = meet(start - part.middle, part.axis, rays[near], part.size, width).ranges
            own = near[found < ranges[near]]
            ranges[own] = found[found < ranges[near]]
            bright[own] = BRIGHT if part.material.retro else DARK
            ranges[own] += bias[own] * part.material.retro
        moved = ranges != beams.ranges
        ranges[moved] += RANGE_NOISE * rng.normal(size=np.count_nonzero(moved))
        there = np.isfinite(ranges)
        xyz = ranges[there, None] * beams.directions[there]
        ring = None if cloud.ring is None else beams.rings[there]
        yield PointCloud(xyz, bright[there], ring, times[there] + clock)


def main() -> None:
    """Print a line for each walk, and the sum of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--packets", nargs=2, metavar="FOLDER")
    parser.add_argument("--sensors", nargs=2, default=["auto", "auto"], help="of the packets")
    args = parser.parse_args()
    if args.packets:
        sensors = [sensor_or_auto(name) for name in args.sensors]
        files = [args.data / "packets" / name / "packets.db3" for name in args.packets]
        turns = [of_packets(path) for path in files]
    else:
        given = load(PAIR, args.data)
        T_walk_target = se3.inverse(where_to_walk(given.target, given.source, given.T))
        sensors, poses = list(given.sensors), [T_walk_target, T_walk_target @ given.T]
        turns = [[(cloud, recorded_beams(cloud))] for cloud in (given.target, given.source)]
    rows: list[Missed] = []
    for seed in range(args.first, args.first + args.draws):
        rng = np.random.default_rng(seed)
        if args.packets:
            poses = drawn_poses(rng)
        walk = draw_walk(rng, args.seconds, CLEAR, [pose[:3, 3] for pose in poses])
        clock = float(rng.uniform(-CLOCK, CLOCK))
        truth = se3.inverse(poses[0]) @ poses[1]
        target, source = (
            planted(Lidar(*each), walk, late, rng.spawn(1)[0])
            for *each, late in zip(turns, sensors, poses, (0.0, clock), strict=True)
        )
        try:
            found = calibrate_walk(target, source, sensors=(sensors[0], sensors[1]))
        except Refusal as refusal:
            print(f"{seed} refused, {refusal.reason.code}: {refusal}", flush=True)
            continue
        alone = Missed.by(found.T_target_source, found.covariance, truth)
        off = clock - found.offset
        rows.append(alone)
        print(
            f"{seed} at {AT:g} m {alone.words}; clock {1e3 * off:+.2f} ms "
            f"({1e3 * found.offset_sigma:.2f}){' WRONG' * (abs(off) > WRONG_CLOCK)}",
            flush=True,
        )
    print(f"answered {len(rows)} of {args.draws}")
    if rows:
        errors = 1e3 * np.array([row.error for row in rows])
        print(
            f"median {np.median(errors):.1f} mm at {AT:g} m, largest {errors.max():.1f}; within "
            f"95 %: {np.mean([row.squares <= CHI2 for row in rows]):.0%}"
        )


if __name__ == "__main__":
    main()
