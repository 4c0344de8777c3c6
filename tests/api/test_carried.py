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
from retropole.base.description import Site, SiteLidar
from retropole.base.errors import UsageError
from retropole.base.sensors import find_sensor
from retropole.export.recording import Track, write_recording
from retropole.io import open_recording, read_frames, write_pcd
from retropole.io.recordings import Frame, chosen_frames
from retropole.io.timed import timed_frames
from retropole.result import encode

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
    # Robust weights depend a little on whose clock counts: a fraction of what is stated.
    assert off.translation < 2e-3
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


@pytest.mark.full
def test_three_lidars_of_a_site_file_are_answered_within_what_is_stated(tmp_path: Path) -> None:
    import json

    write_walk(simulate_walk("street", 3, frames=120, lidars=3), tmp_path, 3)
    path = tmp_path / "site.toml"
    path.write_text(path.read_text() + '[reference]\nlidar = "lidar1"\n')
    answer = rp.calibrate_site(path)
    assert answer.status in ("ok", "warn"), answer.reasons
    truth = json.loads((tmp_path / "truth.json").read_text())["lidars"]
    T = np.array([each["T_world_lidar"] for each in truth])
    for a, b in ((0, 1), (1, 2), (0, 2)):
        names = f"lidar{a}", f"lidar{b}"
        step = se3.local(answer.T(*names), se3.inverse(T[a]) @ T[b])
        assert step @ np.linalg.solve(answer.covariance(*names), step) < 22.5
    document = answer.document
    assert document.walk is not None
    np.testing.assert_array_equal(document.lidars[1].covariance, 0.0)
    own = document.walk.lidars
    for k in (0, 2):
        clock = truth[k]["clock_offset_s"] - truth[1]["clock_offset_s"]
        assert abs(own[k].clock_offset_s - clock) < max(5 * own[k].clock_sigma_s, 1e-3)
    assert own[1].clock_offset_s == own[1].clock_sigma_s == 0.0
    assert [each.threshold for each in document.inputs] == 3 * [find_sensor("VLP-16").threshold]
    answer.save(tmp_path / "out")
    again = rp.load_site_result(tmp_path / "out").document
    assert again.walk is not None
    assert encode(again.walk) == encode(document.walk)
    assert again.config.carried
    # One of them is another LiDAR's once more.
    text = path.read_text().replace('recordings = ["lidar2"]', 'recordings = ["lidar0"]')
    path.write_text(text)
    assert rp.calibrate_site(path).reasons[0].code == "same_recording"


def test_a_site_put_together_in_python_has_one_placement_of_a_walk() -> None:
    cloud = PointCloud(np.ones((3, 3)), np.ones(3))
    lidars = tuple(SiteLidar(name, (cloud, cloud)) for name in "ab")
    with pytest.raises(UsageError, match="a walk has one placement"):
        rp.calibrate_site(Site("s", lidars, ("1", "2"), carried=True))
    one = tuple(replace(each, clouds=(cloud,)) for each in lidars)
    moved = replace(one[1], clouds=(replace(cloud, xyz=2 * cloud.xyz),))
    with pytest.raises(UsageError, match="many sweeps"):
        rp.calibrate_site(Site("s", (one[0], moved), ("1",), carried=True))
