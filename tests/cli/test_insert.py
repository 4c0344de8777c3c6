"""`retropole simulate --into`: poles in recordings, as files that other commands read."""

import json
from pathlib import Path

import numpy as np

from retropole.datatypes import Array, PointCloud
from retropole.io import read_cloud
from tests.cli.commands import retropole_here


def test_poles_are_put_into_recordings(
    scene: Path, truth: Array, clouds: tuple[PointCloud, PointCloud], tmp_path: Path
) -> None:
    recordings = scene / "lidar0.pcd", scene / "lidar1.pcd"
    matrix = tmp_path / "T.txt"
    np.savetxt(matrix, truth)
    for transform in (matrix, scene / "truth.json"):
        words = ("simulate", "--into", *recordings, "--transform", transform, "--seed", 5)
        done = retropole_here(*words, "--poles", 1, "--radius", 0.03, "--out", tmp_path / "s")
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("written: ")
        written = json.loads((tmp_path / "s" / "truth.json").read_text())
        np.testing.assert_allclose(written["T_target_source"], truth, atol=1e-9)
        assert written["sensors"] == ["auto", "auto"]
        (pole,) = written["poles"]
        assert pole["radius_m"] == 0.03
        for k, name in enumerate(("target", "source")):
            cloud = read_cloud(tmp_path / "s" / f"lidar{k}.pcd")
            before = clouds[k].xyz
            changed = np.any(np.abs(cloud.xyz[: len(before)] - before) > 1e-4, axis=1)
            added = len(cloud) - len(before)
            assert np.count_nonzero(changed) + added == pole[f"returns_{name}"] >= 8


def test_a_scene_or_recordings_and_a_transform(scene: Path) -> None:
    recordings = scene / "lidar0.pcd", scene / "lidar1.pcd"
    for words, message in (
        ((), "give a SCENE, or --into"),
        (("street", "--into", *recordings), "give a SCENE, or --into"),
        (("--into", *recordings), "need each other"),
        (("street", "--transform", scene / "truth.json"), "need each other"),
    ):
        done = retropole_here("simulate", *words)
        assert done.returncode == 2
        assert message in done.stderr
