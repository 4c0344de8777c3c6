"""The command merge: what it prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.io import read_cloud
from tests.api.test_merging import write_pair
from tests.cli.commands import retropole, retropole_here
from tests.paths import ROOT


def test_it_writes_a_file_and_says_what_is_in_it(tmp_path: Path) -> None:
    write_pair(tmp_path)
    done = retropole_here("merge", ".", "-o", "a.ply", "--colour", "lidar", cwd=tmp_path)
    assert done.returncode == 0
    assert "target 1 sweep, 200 points, source 1 sweep, 200 points" in done.stdout
    assert "frame: target, metres\npoints written: 400\nwritten: a.ply" in done.stdout
    assert "warning (not_confirmed): not confirmed at all" in done.stderr
    assert len(read_cloud(tmp_path / "a.ply")) == 400


def test_json_says_the_same(tmp_path: Path) -> None:
    write_pair(tmp_path)
    words = ("--surfels", "0.5", "--json", "--recording", "source=rear.pcd")
    done = retropole_here("merge", "result.json", *words, cwd=tmp_path)
    assert done.returncode == 0
    said = json.loads(done.stdout)
    assert said["schema"] == "retropole/merge/1"
    assert said["file"] is None
    assert said["lidars"][1] == {"name": "source", "sweeps": 1, "points": 200}
    assert said["surfaces"] == []
    assert said["reasons"][0]["code"] == "not_confirmed"
    assert "left out" in said["notes"][0]


def test_a_refused_result_ends_with_3_and_writes_nothing(tmp_path: Path) -> None:
    write_pair(tmp_path, status="refused")
    done = retropole_here("merge", ".", "-o", "a.laz", cwd=tmp_path)
    assert done.returncode == 3
    assert "refused (not_confirmed)" in done.stderr
    assert not (tmp_path / "a.laz").exists()


@pytest.mark.parametrize("crop", ["-1,1,-1,1", "1,-1,0,1,0,1", "a,1,0,1,0,1", "nan,1,0,1,0,1"])
def test_a_box_that_is_none_is_bad_usage(crop: str, tmp_path: Path) -> None:
    write_pair(tmp_path)
    done = retropole_here("merge", ".", "-o", "a.ply", f"--crop={crop}", cwd=tmp_path)
    assert done.returncode == 2
    assert "expected x0,x1,y0,y1,z0,z1" in done.stderr


def test_an_open_box_keeps_the_rest(tmp_path: Path) -> None:
    write_pair(tmp_path)
    done = retropole_here("merge", ".", "-o", "a.ply", "--crop", ",,,,0,", cwd=tmp_path)
    assert done.returncode == 0
    assert read_cloud(tmp_path / "a.ply").xyz[:, 2].min() >= 0


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ((), "-o is needed"),
        (("--recording", "front"), "expected NAME=VALUE"),
        (("--recording", "a=1", "--recording", "a=2"), "once for each LiDAR"),
        (("front.pcd", "rear.pcd", "--recording", "target=front.pcd", "-o", "a.ply"), "not both"),
        (("front.pcd", "-o", "a.ply"), "1 clouds are given"),
    ],
)
def test_bad_usage_says_what_is_expected(
    words: tuple[str, ...], fault: str, tmp_path: Path
) -> None:
    write_pair(tmp_path)
    done = retropole_here("merge", ".", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert fault in done.stderr


@pytest.mark.full
def test_memory_does_not_grow_with_the_sweeps(tmp_path: Path) -> None:
    """Of 40 sweeps of 50,000 points as of 10: the points alone would be 60 MB more."""
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(50_000, 3))
    rays *= 20 / np.linalg.norm(rays, axis=1)[:, None]
    from retropole.base.datatypes import PointCloud
    from retropole.io import write_pcd

    write_pair(tmp_path)
    peaks = []
    for sweeps in (10, 40):
        folder = tmp_path / str(sweeps)
        folder.mkdir()
        for k in range(sweeps):
            write_pcd(
                folder / f"{k}.pcd", PointCloud(rays * rng.uniform(0.999, 1.001, (50_000, 1)))
            )
        script = tmp_path / "run.py"
        script.write_text(
            "import sys\nfrom retropole.cli import run\nfrom tests.memory import peak_memory\n"
            "assert run(sys.argv[1:]) == 0\nprint('peak', peak_memory())\n"
        )
        import os
        import subprocess
        import sys

        words = ["merge", ".", f"{sweeps}", f"{sweeps}", "-o", "a.ply", "--voxel", "0.2", "-q"]
        done = subprocess.run(
            [sys.executable, script, *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        peaks.append(int(done.stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 20e6


@pytest.mark.full
def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    import os
    import signal
    import subprocess
    import sys
    import time

    write_pair(tmp_path, sweeps=400)
    there = {path.name for path in tmp_path.iterdir()}
    for _ in range(3):
        command = [sys.executable, "-m", "retropole", "merge", ".", "-o", "a.ply"]
        process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE)
        until = time.monotonic() + 60
        while not any("unfinished" in p.name for p in tmp_path.iterdir()):
            if process.poll() is not None or time.monotonic() > until:
                break
            time.sleep(0.002)
        os.kill(process.pid, signal.SIGINT)
        code = process.wait(timeout=60)
        assert code in (0, 130)
        if code == 130:
            assert {path.name for path in tmp_path.iterdir()} == there
            return
    pytest.skip("it was done before it was interrupted")


def test_it_is_a_command_that_starts() -> None:
    done = retropole("merge", "--help")
    assert done.returncode == 0
    assert "Exit code:" in done.stdout
