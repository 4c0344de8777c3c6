"""Two recordings of a walk: the same answer whichever way they are stored, named and clocked."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.api.simulation import simulate_walk, write_walk
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.base.sensors import find_sensor
from retropole.export.recording import Track, write_recording
from retropole.io import open_recording, read_frames, write_pcd
from retropole.io.recordings import Frame, chosen_frames
from retropole.io.timed import timed_frames

NAMED = {"sensor": "VLP-16", "options": rp.RunConfig(carried=True)}
START = 1.7e9

Frames = dict[str, list[Frame]]


@pytest.mark.parametrize("option", [{"poles": 2}, {"up": True}, {"hypothesis": "a"}])
def test_what_is_of_standing_poles_is_refused(option: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(option))):
        rp.calibrate("a", "b", options=rp.RunConfig(carried=True, **option))  # type: ignore[arg-type]


def test_one_sweep_is_no_walk() -> None:
    cloud = PointCloud(np.random.default_rng(0).normal(size=(50, 3)), np.arange(50.0))
    with pytest.raises(UsageError, match="many sweeps"):
        rp.calibrate(cloud, replace(cloud, xyz=-cloud.xyz), options=rp.RunConfig(carried=True))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk of 10 s, as files, with its truth."""
    out = tmp_path_factory.mktemp("walk")
    write_walk(simulate_walk("street", 2, frames=100), out, 2)
    return out


@pytest.fixture(scope="module")
def answer(folder: Path) -> rp.CalibrationResult:
    return rp.calibrate(folder / "lidar0", folder / "lidar1", **NAMED)  # type: ignore[arg-type]


def differs(one: rp.CalibrationResult, other: rp.CalibrationResult) -> tuple[float, float, float]:
    """By how much two answers differ: rad, m and s."""
    assert one.walk is not None
    assert other.walk is not None
    off = se3.difference(one.required_transform(), other.required_transform())
    return (*off, abs(one.walk.clock_offset_s - other.walk.clock_offset_s))


@pytest.mark.full
def test_a_written_walk_is_answered_within_what_is_stated(
    folder: Path, answer: rp.CalibrationResult, tmp_path: Path
) -> None:
    import json

    truth = json.loads((folder / "truth.json").read_text())
    assert answer.status == "ok"
    assert answer.walk is not None
    assert answer.covariance is not None
    step = se3.local(answer.required_transform(), np.array(truth["T_target_source"]))
    assert step @ np.linalg.solve(answer.covariance, step) < 22.5
    clock = answer.walk.clock_offset_s - truth["clock_offset_s"]
    assert abs(clock) < 4 * answer.walk.clock_sigma_s
    assert [each.threshold for each in answer.document.inputs] == 2 * [
        find_sensor("VLP-16").threshold
    ]
    answer.save(tmp_path)
    again = rp.load_result(tmp_path)
    assert 'id="walk"' in again.report(tmp_path / "again.html").read_text()


@pytest.mark.full
def test_swapped_recordings_give_the_inverse(folder: Path, answer: rp.CalibrationResult) -> None:
    swapped = rp.calibrate(folder / "lidar1", folder / "lidar0", **NAMED)  # type: ignore[arg-type]
    assert swapped.walk is not None
    assert answer.walk is not None
    back = se3.inverse(swapped.required_transform())
    off = se3.difference(back, answer.required_transform())
    assert off.translation < 1e-3
    assert off.rotation < 1e-4
    sum_of_both = swapped.walk.clock_offset_s + answer.walk.clock_offset_s
    assert abs(sum_of_both) < 0.5 * answer.walk.clock_sigma_s


def as_bag(frames: Frames, folder: Path, change: Callable[[Frame], Frame]) -> list[str | Path]:
    """Write one bag of both."""
    path = folder / "walk.mcap"
    topics = {f"/{name}": Track(name, [*map(change, own)]) for name, own in frames.items()}
    path.write_bytes(write_recording(topics))
    return [path, path]


def begun(frame: Frame) -> float:
    assert frame.cloud.time is not None
    return START + float(frame.cloud.time.min())


def changed(folder: Path, times: str, shift: float) -> tuple[Frames, Callable[[Frame], Frame]]:
    """Read a walk, its source's clock ahead by some seconds, and say how its times are stored."""
    frames = {name: list(read_frames(folder / name)) for name in ("lidar0", "lidar1")}

    def change(frame: Frame) -> Frame:
        cloud = frame.cloud
        assert cloud.time is not None
        within = {"none": None, "absolute": cloud.time}.get(times, cloud.time - cloud.time.min())
        return replace(frame, stamp=begun(frame), cloud=replace(cloud, time=within))

    frames["lidar1"] = [
        replace(each, cloud=replace(each.cloud, time=each.cloud.time + shift))  # type: ignore[operator, arg-type]
        for each in frames["lidar1"]
    ]
    return frames, change


@pytest.mark.full
@pytest.mark.parametrize(("times", "shift"), [("none", 0.0), ("from each sweep", 3.0)])
def test_files_of_any_kind_give_the_same_answer(
    folder: Path, answer: rp.CalibrationResult, tmp_path: Path, times: str, shift: float
) -> None:
    frames, change = changed(folder, times, shift)
    both = as_bag(frames, tmp_path, change)
    topics = {"topic": ("/lidar0", "/lidar1")}
    found = rp.calibrate(both[0], both[1], **NAMED, **topics)  # type: ignore[arg-type]
    rotation, translation, offset = differs(found, answer)
    assert rotation < 1e-5
    assert translation < 1e-4
    assert abs(offset - shift) < 1e-5


@pytest.mark.full
@pytest.mark.parametrize("times", ["absolute", "in names"])
def test_files_of_any_kind_give_the_same_sweeps(folder: Path, tmp_path: Path, times: str) -> None:
    """What is found in equal sweeps is the same: they need not be searched again."""
    frames, change = changed(folder, times, 0.0)
    if times == "in names":
        for each in frames["lidar1"]:
            write_pcd(tmp_path / "lidar1" / f"{begun(each):.6f}.pcd", change(each).cloud)
        recording = open_recording(tmp_path / "lidar1")
    else:
        recording = open_recording(as_bag(frames, tmp_path, change)[1], topic="/lidar1")
    read = timed_frames(recording, chosen_frames(recording, slice(None)))
    later = []
    for one, other in zip(read, frames["lidar1"], strict=True):
        assert one.cloud.time is not None
        assert other.cloud.time is not None
        np.testing.assert_array_equal(one.cloud.xyz, other.cloud.xyz)
        later.append(one.cloud.time - other.cloud.time)
    # By whatever clock, it is the same throughout.
    assert np.ptp(np.concatenate(later)) < 1e-5
