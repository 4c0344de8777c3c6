"""Walks planted into real recordings: is the transform found that planted them?

Usage:
    python benchmarks/carried_recorded.py data --draws 12

A frame of PandaSet, Pandar64 and PandarGT, is repeated as the background of a walk, its stamps
later by 0.1 s each time. Pole, hand and person are met by its beams, those that returned and those
between them, each at its own time. Elevations, firing times, the order of the beams, what hides the
pole and what else is bright are real; the ranges to the pole have errors that are drawn. `data` is
the folder with the recordings. Seeds below 1000 tune; seeds from 5000 state.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from carried import AT, CHI2, WRONG_CLOCK, Missed
from insertion.inserting import RING_BIAS, TAPE_OFFSET
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import SWEEP_SECONDS, Sensor
from retropole.carried.walk import calibrate_walk
from retropole.simulation.raycast import meet
from retropole.simulation.recorded import RecordedBeams, recorded_beams
from retropole.simulation.walks import Walk, draw_walk
from semireal import load

PAIR, AHEAD, CLEAR = "pandaset 05", 6.5, (2.0, 2.0)
"""The walk is so far ahead, within the view of the PandarGT, and within half extents, metres."""

RANGE_NOISE, CLOCK, BRIGHT, DARK = 0.01, 2.0, 255.0, 10.0
"""1 σ of a range, metres; clocks differ by up to so much, s; intensities of tape and of others."""


def where_to_walk(target: PointCloud, source: PointCloud, T: Array) -> Array:
    """(4, 4) from the walk's frame to the target's: on the ground, in the middle of both views."""
    ahead = T[:3, :3] @ source.xyz.mean(axis=0)
    middle = AHEAD * ahead[:2] / np.linalg.norm(ahead[:2])
    near = np.linalg.norm(target.xyz[:, :2] - middle, axis=1) < 2.0
    ground = float(np.quantile(target.xyz[near, 2], 0.05))
    return se3.from_rt(np.eye(3), np.r_[middle, ground])


def planted(
    cloud: PointCloud,
    beams: RecordedBeams,
    walk: Walk,
    T_lidar_walk: Array,
    sensor: Sensor | None,
    clock: float,
    rng: np.random.Generator,
) -> Iterator[PointCloud]:
    """Record a walk sweep by sweep with the beams of a recording."""
    assert cloud.time is not None
    assert cloud.intensity is not None
    within = (cloud.time - cloud.time.min())[beams.like]
    rings = RING_BIAS * rng.normal(size=max(int(beams.rings.max()), 0) + 1)
    bias = np.r_[rings, 0.0][beams.rings] + TAPE_OFFSET * rng.normal()
    width = 0.003 if sensor is None else sensor.divergence
    R, start = T_lidar_walk[:3, :3], se3.inverse(T_lidar_walk)[:3, 3]
    rays = beams.directions @ R
    for k in range(int(walk.seconds / SWEEP_SECONDS)):
        times = within + SWEEP_SECONDS * k
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
        yield PointCloud(xyz, bright[there], time=times[there] + clock)


def main() -> None:
    """Print a line for each walk, and the sum of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    given = load(PAIR, args.data)
    T_target_walk = where_to_walk(given.target, given.source, given.T)
    clouds = (given.target, given.source)
    beams = [recorded_beams(cloud) for cloud in clouds]
    T_walk_target = se3.inverse(T_target_walk)
    poses = T_walk_target, T_walk_target @ given.T
    rows: list[Missed] = []
    for seed in range(args.first, args.first + args.draws):
        rng = np.random.default_rng(seed)
        walk = draw_walk(rng, args.seconds, CLEAR, [pose[:3, 3] for pose in poses])
        clock = float(rng.uniform(-CLOCK, CLOCK))
        target, source = (
            planted(cloud, beam, walk, se3.inverse(pose), sensor, late, rng.spawn(1)[0])
            for cloud, beam, pose, sensor, late in zip(
                clouds, beams, poses, given.sensors, (0.0, clock), strict=True
            )
        )
        try:
            found = calibrate_walk(target, source, sensors=given.sensors)
        except Refusal as refusal:
            print(f"{seed} refused, {refusal.reason.code}: {refusal}", flush=True)
            continue
        alone = Missed.by(found.T_target_source, found.covariance, given.T)
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
