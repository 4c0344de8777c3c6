"""Time and peak memory of `calibrate` for 1 GiB of frames, for clouds of 5 million points, and for
bags of 100 and 1,000 frames.

    python benchmarks/limits.py

A street is simulated as both LiDARs see it, and written to a temporary folder (4 GiB): as frames,
repeated until the two folders have the size together, and as one cloud each. Every row is a command
of its own; the peak is that of its process.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.export.recording import TOPICS, write_mcap
from retropole.export.transform import Transform
from retropole.io import Frame, write_pcd
from retropole.simulation import SimulatedPair, simulate_pair

MIB = 2**20

BAGS = 100, 1000
"""Frames of each LiDAR in the two bags."""

Truth = tuple[Array, list[str]]


def write_frames(folder: Path, cloud: PointCloud, size: int) -> int:
    """Write the frames of a cloud, again and again, up to `size` bytes; give their number."""
    assert cloud.frame is not None
    frames = [cloud.select(cloud.frame == k) for k in np.unique(cloud.frame)]
    folder.mkdir()
    written, count = 0, 0
    while written < size:
        path = folder / f"{count}.pcd"
        write_pcd(path, frames[count % len(frames)])
        written += path.stat().st_size
        count += 1
    return count


def write_sized(path: Path, cloud: PointCloud, points: int) -> None:
    """Write as many points of all frames as one cloud, some of them repeated a hair aside."""
    rng = np.random.default_rng(0)
    index = np.r_[np.arange(len(cloud)), rng.integers(0, len(cloud), points)][:points]
    large = replace(cloud.select(index), frame=None)
    write_pcd(path, replace(large, xyz=large.xyz + rng.normal(0, 1e-3, large.xyz.shape)))


def write_bag(path: Path, pair: SimulatedPair, count: int) -> None:
    """Write as many frames of both LiDARs as a bag, every fourth point of those that there are."""
    frames = []
    for cloud in (pair.target, pair.source):
        assert cloud.frame is not None
        own = [np.flatnonzero(cloud.frame == k)[::4] for k in np.unique(cloud.frame)]
        each = [replace(cloud.select(index), frame=None) for index in own]
        frames.append([Frame(k, each[k % len(each)], 0.1 * k) for k in range(count)])
    path.write_bytes(write_mcap(Transform(pair.T_target_source, "target", "source"), *frames))
    print(f"{path.name}: {path.stat().st_size // MIB} MiB", flush=True)


def measure(words: list[str]) -> tuple[float, int, int, str]:
    """Run a command: its time in seconds, peak in MiB, exit code, and what it said on stderr."""
    start = time.perf_counter()
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        said = process.stderr.read().decode()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - start, usage.ru_maxrss // 1024, process.returncode, said


def write_all(
    folder: Path, scene: str, seed: int, frames: int, size: int, points: int, bags: Sequence[int]
) -> Truth:
    """Simulate the scene and write its files; give the true transform and the sensors."""
    pair = simulate_pair(scene, np.random.default_rng(seed), frames=frames)
    for role, cloud in (("target", pair.target), ("source", pair.source)):
        count = write_frames(folder / role, cloud, size)
        print(f"{role}: {count} frames of {len(cloud) // frames:,} points", flush=True)
        write_sized(folder / f"{role}.pcd", cloud, points)
        write_sized(folder / f"{role}-twice.pcd", cloud, 2 * points)
    for count in bags:
        write_bag(folder / f"{count}.mcap", pair, count)
    return pair.T_target_source, [sensor.name if sensor else "auto" for sensor in pair.sensors]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="street")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=20, help="that differ from each other")
    parser.add_argument("--mib", type=int, default=1024, help="of frames, of both together")
    parser.add_argument("--points", type=int, default=5_000_000, help="of each of the two clouds")
    parser.add_argument("--bags", type=int, nargs="*", default=BAGS, help="their frames")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # In a process of its own: what starts a process counts towards that one's peak.
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other:
            T_true, sensors = other.submit(
                write_all,
                folder,
                given.scene,
                given.seed,
                given.frames,
                given.mib * MIB // 2,
                given.points,
                given.bags,
            ).result()
        topics = ["--topic", TOPICS["target"], "--topic", TOPICS["source"]]
        one, two = ["target.pcd", "source.pcd"], ["target-twice.pcd", "source-twice.pcd"]
        print("| what | s | peak MiB | answer | off by mm, ° |\n| --- | --- | --- | --- | --- |")
        for what, words in (
            (f"{given.mib} MiB of frames", ["target", "source"]),
            ("the same, every frame asked for", ["target", "source", "--frames", ":"]),
            (f"2 × {given.points:,} points", one),
            (f"2 × {2 * given.points:,} points", two),
            *((f"bag of {n:,} frames", [f"{n}.mcap", f"{n}.mcap", *topics]) for n in given.bags),
        ):
            out = folder / "out"
            command = [sys.executable, "-m", "retropole", "calibrate", "--out", str(out)]
            command += ["--sensor", sensors[0], "--sensor", sensors[1]]
            command += [str(folder / each) for each in words[:2]] + words[2:]
            seconds, peak, code, said = measure(command)
            if code not in (0, 3):
                raise SystemExit(said)
            result = json.loads((out / "result.json").read_text())
            answer, off = result["status"], "–"
            if result["T_target_source"] is None:
                answer += f" ({result['reasons'][0]['code']})"
            else:
                apart = se3.inverse(T_true) @ np.array(result["T_target_source"])
                angle = np.degrees(se3.rotation_angle(apart[:3, :3]))
                off = f"{1000 * np.linalg.norm(apart[:3, 3]):.1f}, {angle:.3f}"
            print(f"| {what} | {seconds:.0f} | {peak:,} | {answer} | {off} |", flush=True)
            for line in said.splitlines():
                print(f"    {line}")


if __name__ == "__main__":
    main()
