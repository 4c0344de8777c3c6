"""Both clouds and their transform as an MCAP file, read back by rosbags and by our own reader."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.export import Transform, inverted
from retropole.export.recording import TOPICS, frames_of, write_mcap
from retropole.io import Frame, read_cloud, read_recording, write_pcd
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'retropole[ros]'")
T = se3.random(np.random.default_rng(1))


def cloud_of(seed: int, count: int = 50) -> PointCloud:
    """Draw a cloud that float32 holds as it is."""
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.normal(0.0, 5.0, (count, 3)).astype(np.float32).astype(float),
        intensity=rng.integers(0, 255, count).astype(float),
        ring=rng.integers(0, 32, count),
        time=1.7e9 + rng.uniform(0.0, 0.1, count),
    )


def written(folder: Path, transform: Transform, *clouds: list[Frame]) -> Path:
    path = folder / "a.mcap"
    path.write_bytes(write_mcap(transform, *clouds))
    return path


def messages(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, time and message of all, as rosbags reads them by the definitions in the file."""
    pytest.importorskip("apsw", reason="needs rosbags 0.11, which reads a file without its folder")
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    with Reader(path) as reader:
        for own in reader.connections:
            store.register(get_types_from_msg(own.msgdef.data, own.msgtype))
        return [
            (own.topic, time, store.deserialize_cdr(data, own.msgtype))
            for own, time, data in reader.messages()
        ]


@pytest.mark.parametrize("is_inverse", [False, True])
def test_rosbags_reads_each_cloud_in_its_frame_and_the_transform(
    is_inverse: bool, tmp_path: Path
) -> None:
    transform = Transform(T, "front", "rear lidar")
    if is_inverse:
        transform = inverted(transform)
    clouds = {"target": cloud_of(1), "source": cloud_of(2)}
    path = written(tmp_path, transform, *([Frame(0, own, 1.7e9)] for own in clouds.values()))
    found = messages(path)
    assert [topic for topic, *_ in found] == ["/tf_static", *TOPICS.values()]
    assert {time for _, time, _ in found} == {1_700_000_000_000_000_000}
    (stamped,) = found[0][2].transforms
    assert stamped.header.frame_id == ("rear lidar" if is_inverse else "front")
    assert stamped.child_frame_id == ("front" if is_inverse else "rear lidar")
    t, q = stamped.transform.translation, stamped.transform.rotation
    pose = se3.from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))
    np.testing.assert_allclose(pose, se3.inverse(T) if is_inverse else T, rtol=0, atol=1e-12)
    for (_, _, message), (role, cloud) in zip(found[1:], clouds.items(), strict=True):
        assert message.header.frame_id == {"target": "front", "source": "rear lidar"}[role]
        assert (message.height, message.width) == (1, len(cloud))
        assert (message.is_bigendian, message.is_dense) == (False, True)
        layout = {own.name: (own.datatype, own.offset) for own in message.fields}
        assert layout["x"] == (7, 0)
        assert message.row_step == message.point_step * message.width == len(message.data)
        xyz = np.ndarray((len(cloud), 3), "<f4", message.data, strides=(message.point_step, 4))
        np.testing.assert_array_equal(xyz, cloud.xyz)


def test_our_reader_gives_the_clouds_back(tmp_path: Path) -> None:
    target, source = [cloud_of(k) for k in (1, 2, 3)], cloud_of(4)
    source = replace(source, xyz=source.xyz + 1e-9, ring=source.ring, time=None)
    frames = [Frame(k, own, 1.7e9 + 0.1 * k) for k, own in enumerate(target)]
    path = written(tmp_path, Transform(T, "a", "b"), frames, [Frame(0, source, 1.7e9)])
    read = read_recording(path, topic=TOPICS["target"])
    np.testing.assert_allclose(read.cloud.recorded or (), (1.7e9, 1.7e9 + 0.2), rtol=0, atol=1e-6)
    for given, back in zip(target, frames_of(read), strict=True):
        for name in ("xyz", "intensity", "ring", "time"):
            np.testing.assert_array_equal(getattr(back.cloud, name), getattr(given, name))
    # Where float32 would lose something, all stays.
    np.testing.assert_array_equal(read_cloud(path, topic=TOPICS["source"]).xyz, source.xyz)


def test_times_that_are_not_known_of_both_start_at_zero(tmp_path: Path) -> None:
    frames = [Frame(k, cloud_of(k)) for k in range(2)]
    path = written(tmp_path, Transform(T, "a", "b"), frames, [Frame(0, cloud_of(3), 1.7e9)])
    times = [(topic, time) for topic, time, _ in messages(path)]
    target, source = TOPICS.values()
    assert times == [("/tf_static", 0), (target, 0), (source, 0), (target, 100_000_000)]
    assert read_cloud(path, topic=target).recorded is None


def test_late_listeners_receive_the_transform() -> None:
    from mcap.reader import make_reader

    data = write_mcap(Transform(T, "a", "b"), [Frame(0, cloud_of(1))], [Frame(0, cloud_of(2))])
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    about = {own.topic: own.metadata["offered_qos_profiles"] for own in summary.channels.values()}
    assert "durability: 1" in about["/tf_static"]
    assert {own.encoding for own in summary.schemas.values()} == {"ros2msg"}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    pair = rp.simulate("street", seed=1)
    for name, cloud in (("front.pcd", pair.target), ("rear.pcd", pair.source)):
        write_pcd(folder / name, cloud)
    rp.calibrate(folder / "front.pcd", folder / "rear.pcd").save(folder / "out")
    return folder


def test_a_calibration_from_the_export_gives_the_same_answer(saved: Path) -> None:
    path = saved / "aligned.mcap"
    done = retropole_here("export", saved / "out", "--to", "mcap", "--out", path)
    assert (done.returncode, done.stderr) == (0, "")
    first = rp.load_result(saved / "out")
    again = rp.calibrate(path, path, topic=(TOPICS["target"], TOPICS["source"]))
    assert again.T_target_source is not None
    assert first.T_target_source is not None
    np.testing.assert_array_equal(again.T_target_source, first.T_target_source)
    assert again.status == first.status


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--to", "mcap"), "needs --out"),
        (("--to", "json", "clouds"), "only --to mcap takes clouds"),
        (("--to", "mcap", "--out", "a.mcap", "one.pcd"), "1 clouds are given"),
    ],
)
def test_bad_usage_says_why(saved: Path, words: tuple[str, ...], reason: str) -> None:
    done = retropole_here("export", saved / "out", *words)
    assert done.returncode == 2
    assert reason in done.stderr


def test_a_bare_transform_needs_the_clouds(saved: Path, tmp_path: Path) -> None:
    matrix, out = tmp_path / "T.json", tmp_path / "a.mcap"
    assert retropole_here("export", saved / "out", "--to", "json", "--out", matrix).returncode == 0
    words = ("export", matrix, "--to", "mcap", "--out", out)
    done = retropole_here(*words)
    assert done.returncode == 2
    assert "names no clouds" in done.stderr
    assert not out.exists()
    done = retropole_here(*words, saved / "front.pcd", saved / "rear.pcd")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(messages(out)) == 3


def test_what_the_copy_cannot_say_is_reported(saved: Path, tmp_path: Path) -> None:
    moved = read_cloud(saved / "front.pcd").transformed(se3.from_rt(np.eye(3), np.ones(3)))
    write_pcd(tmp_path / "moved.pcd", moved)
    words = (tmp_path / "moved.pcd", saved / "rear.pcd", "--to", "mcap", "--out", tmp_path / "a")
    done = retropole_here("export", saved / "out", *words)
    assert done.returncode == 0
    assert "its beams start at [1.0, 1.0, 1.0]" in done.stderr
    assert "is not the file that the run read" in done.stderr
