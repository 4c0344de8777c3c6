"""A simulated street as files and as a bag, for all commands."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.io import read_cloud
from tests.cli.commands import retropole_here


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    words = "simulate", "street", "--seed", 1, "--out", folder
    # Few points: what is tested here are the commands.
    done = retropole_here(*words, "--sensor", "VLP-16")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="session")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same street by LiDARs of 64 rings: where many points are needed."""
    folder = tmp_path_factory.mktemp("dense")
    done = retropole_here("simulate", "street", "--seed", 1, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="session")
def truth(scene: Path) -> Array:
    return np.array(json.loads((scene / "truth.json").read_text())["T_target_source"])


@pytest.fixture(scope="session")
def clouds(scene: Path) -> tuple[PointCloud, PointCloud]:
    return read_cloud(scene / "lidar0.pcd"), read_cloud(scene / "lidar1.pcd")


@pytest.fixture(scope="session")
def bag(clouds: tuple[PointCloud, PointCloud], tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")
    from tests.bags import points_of, write_bag

    points = [points_of(cloud) for cloud in clouds]
    folder = tmp_path_factory.mktemp("bag")
    return write_bag(folder, "mcap", {"/front": points[:1], "/rear": points[1:]})


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have no cluster for what a fleet does: that is tried elsewhere."""
    from tests.fleet.fleets import here

    @contextmanager
    def connected(scheduler: str | None, workers: int | None) -> Iterator[None]:
        yield

    monkeypatch.setattr("retropole.fleet.engine.connected", connected)
    monkeypatch.setattr("retropole.fleet.engine.outcomes", lambda client, tasks: here(tasks))
    monkeypatch.setattr("retropole.fleet.engine.mapped", lambda client, do, given: map(do, given))
