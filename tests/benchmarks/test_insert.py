"""`benchmarks/insert.py`: poles in recordings, as files that commands read."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from retropole.io import read_cloud
from retropole.simulation import SimulatedPair, simulate_pair, write_pair
from tests.paths import ROOT

pytestmark = pytest.mark.full


def insert(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks" / "insert.py"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.fixture(scope="module")
def folder(street: SimulatedPair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("street")
    write_pair(street, out)
    return out


def test_poles_are_put_into_recordings(folder: Path, street: SimulatedPair, tmp_path: Path) -> None:
    recordings = folder / "lidar0.pcd", folder / "lidar1.pcd"
    matrix = tmp_path / "T.txt"
    np.savetxt(matrix, street.T_target_source)
    for transform in (matrix, folder / "truth.json"):
        words = (*recordings, "--transform", transform, "--seed", 5, "--poles", 1)
        done = insert(*words, "--radius", 0.03, "--out", tmp_path / "s")
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("written: ")
        written = json.loads((tmp_path / "s" / "truth.json").read_text())
        np.testing.assert_allclose(written["T_target_source"], street.T_target_source, atol=1e-9)
        assert written["sensors"] == ["auto", "auto"]
        (pole,) = written["poles"]
        assert pole["radius_m"] == 0.03
        for k, name in enumerate(("target", "source")):
            cloud = read_cloud(tmp_path / "s" / f"lidar{k}.pcd")
            before = read_cloud(recordings[k]).xyz
            changed = np.any(np.abs(cloud.xyz[: len(before)] - before) > 1e-4, axis=1)
            added = len(cloud) - len(before)
            assert np.count_nonzero(changed) + added == pole[f"returns_{name}"] >= 8


def test_what_is_missing_or_wrong_is_reported(folder: Path) -> None:
    recordings = folder / "lidar0.pcd", folder / "lidar1.pcd"
    truth = folder / "truth.json"
    for words, message in (
        (recordings, "--transform"),
        ((*recordings, "--transform", folder / "no.txt"), "no.txt"),
        ((*recordings, "--transform", truth, "--poles", 0), "poles is 0"),
        ((*recordings, "--transform", truth, "--sensor-target", "moon"), "moon"),
    ):
        done = insert(*words)
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr


def test_the_help_has_an_example() -> None:
    done = insert("--help")
    assert done.returncode == 0
    assert "python benchmarks/insert.py front.pcd rear.pcd --transform" in done.stdout
