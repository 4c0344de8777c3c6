"""Bags that rosbags wrote, and those of others, give the points that were put in."""

import sqlite3
import struct
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

from retropole.base.datatypes import PointCloud
from retropole.base.errors import MissingExtraError, ReadError, UsageError
from retropole.export.transform import LONGEST_NAME as LONGEST_EXPORTED
from retropole.io import (
    BAGS,
    chosen_frames,
    open_recording,
    read_cloud,
    read_frames,
    read_recording,
    sha256_of,
)
from retropole.io.live.files import BagSource
from retropole.io.live.replay import ReplaySource
from retropole.io.recordings import clock_offset
from retropole.io.ros import columns_of, frame_of
from tests.bags import CLOUDS, KINDS, START, message, points_of, write_bag
from tests.io.clouds import assert_same, random_cloud
from tests.io.exports import START as LIVOX_START
from tests.io.exports import livox_message, livox_store, write_livox_bag
from tests.io.files import required
from tests.paths import SHARED

STORE = get_typestore(Stores.LATEST)

FORMATS = SHARED / "formats"

ROS1 = Stores.ROS1_NOETIC
ROS2 = [store for store in Stores if store.value.startswith("ros2")]


def shared(name: str) -> Path:
    path = FORMATS / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_back_what_was_written(tmp_path: Path, kind: str) -> None:
    clouds = [random_cloud(seed, 40 + seed) for seed in range(5)]
    path = write_bag(tmp_path, kind, {"/points": [points_of(cloud) for cloud in clouds]})
    frames = list(read_frames(path))
    assert [frame.number for frame in frames] == [0, 1, 2, 3, 4]
    for frame, cloud in zip(frames, clouds, strict=True):
        assert_same(frame.cloud, cloud)
        assert frame.frame_id == "lidar"
        assert frame.stamp == pytest.approx(START / 1e9 + 0.1 * frame.number)
    whole = read_cloud(path)
    np.testing.assert_array_equal(whole.xyz, np.concatenate([cloud.xyz for cloud in clouds]))
    np.testing.assert_array_equal(whole.frame, np.repeat(range(5), [40, 41, 42, 43, 44]))
    assert whole.source == str(path)
    assert whole.recorded == pytest.approx((START / 1e9, START / 1e9 + 0.4))
    assert len(sha256_of(path)) == 64


@pytest.mark.parametrize("kind", KINDS)
def test_how_far_a_clock_is_ahead_of_the_recorders(tmp_path: Path, kind: str) -> None:
    """By the stamps of messages, or by the times of points, where these are dates."""
    cloud = random_cloud(0, 40)
    points = [points_of(cloud)] * 3
    own = np.zeros(40, [*points[0].dtype.descr, ("timestamp", "<f8")])
    for name in required(points[0].dtype.names):
        own[name] = points[0][name]
    own["timestamp"] = START / 1e9 - 18.1 + np.arange(40) / 400
    topics = {"/front": points, "/rear": points, "/timed": [own]}
    ahead = {"/front": 36.9, "/rear": -0.1, "/timed": 36.9}
    path = write_bag(tmp_path, kind, topics, ahead=ahead)
    for topic, expected in (("/front", 36.9), ("/rear", -0.1), ("/timed", -18.1)):
        offset = clock_offset(read_recording(path, topic=topic).headers)
        assert offset == pytest.approx(expected, abs=1e-3)
    # Where a message has no stamp, nothing is known.
    unstamped = {"/front": -START / 1e9}
    (tmp_path / "none").mkdir()
    path = write_bag(tmp_path / "none", kind, {"/front": points[:1]}, ahead=unstamped)
    assert clock_offset(read_recording(path).headers) is None


@pytest.mark.parametrize("store", ROS2, ids=lambda store: store.value)
def test_every_ros_2_is_read(tmp_path: Path, store: Stores) -> None:
    cloud = random_cloud()
    path = write_bag(tmp_path, "db3", {"/points": [points_of(cloud)]}, store=store)
    assert_same(read_cloud(path), cloud)


def test_definitions_of_messages_are_not_needed(tmp_path: Path) -> None:
    cloud = random_cloud()
    path = write_bag(tmp_path, "db3", {"/points": [points_of(cloud)]})
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM message_definitions")
    assert_same(read_cloud(path), cloud)


@pytest.mark.parametrize(
    ("kind", "compression"),
    [
        ("bag", Writer1.CompressionFormat.BZ2),
        ("bag", Writer1.CompressionFormat.LZ4),
        ("mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
        ("db3 folder", (CompressionMode.FILE, CompressionFormat.ZSTD)),
        ("db3 folder", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ],
)
def test_compressed_bags_are_read(tmp_path: Path, kind: str, compression: object) -> None:
    cloud = random_cloud()
    path = write_bag(tmp_path, kind, {"/points": [points_of(cloud)]}, compression=compression)
    assert_same(read_cloud(path), cloud)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
@pytest.mark.parametrize("indexed", [True, False])
def test_an_mcap_of_any_profile_is_read_with_or_without_an_index(
    tmp_path: Path, encoding: str, indexed: bool
) -> None:
    from mcap.writer import IndexType, Writer

    clouds = [random_cloud(seed) for seed in range(4)]
    store = get_typestore(ROS1 if encoding == "ros1" else Stores.LATEST)
    write = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    writer: Any = Writer(
        str(tmp_path / "a.mcap"),
        index_types=IndexType.ALL if indexed else IndexType.NONE,
        use_statistics=indexed,
        repeat_channels=indexed,
        repeat_schemas=indexed,
        use_summary_offsets=indexed,
    )
    writer.start()
    name = CLOUDS.replace("/msg", "") if encoding == "ros1" else CLOUDS
    schema = writer.register_schema(name, f"{encoding}msg", b"")
    channel = writer.register_channel("/points", encoding, schema)
    for k, cloud in enumerate(clouds):
        data = write(message(points_of(cloud), store), CLOUDS)
        writer.add_message(channel, log_time=k, data=bytes(data), publish_time=k)
    writer.finish()
    frames = list(read_frames(tmp_path / "a.mcap"))
    assert len(frames) == 4
    for frame, cloud in zip(frames, clouds, strict=True):
        assert_same(frame.cloud, cloud)


LAYOUTS = {
    "double": np.dtype([(name, "<f8") for name in ("x", "y", "z", "intensity")] + [("ring", "u1")]),
    "big-endian": np.dtype([(n, ">f4") for n in ("x", "y", "z", "intensity")] + [("ring", ">u2")]),
    "uint16": np.dtype([(n, "<f4") for n in "xyz"] + [("intensity", "<u2"), ("ring", "<u2")]),
    "uint8": np.dtype([(n, "<f4") for n in "xyz"] + [("reflectivity", "u1"), ("channel", "u1")]),
    "order": np.dtype([("line", "u1"), *((n, "<f4") for n in ("intensity", "z", "y", "x"))]),
    "padding": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2"],
            "offsets": [0, 4, 8, 16, 24],
            "itemsize": 48,
        }
    ),
    "several values": np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4", (2,)), ("ring", "<i4")]
    ),
}


def laid_out(cloud: PointCloud, kind: np.dtype[Any]) -> NDArray[Any]:
    points = np.zeros(len(cloud), kind)
    for name in kind.names or ():
        column = {
            **dict(zip("xyz", cloud.xyz.T, strict=True)),
            **dict.fromkeys(("intensity", "reflectivity"), cloud.intensity),
            **dict.fromkeys(("ring", "channel", "line"), cloud.ring),
        }[name]
        points[name] = column if points[name].ndim == 1 else np.column_stack([column, 0 * column])
    return points


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize(("rows", "row_padding"), [(1, 0), (5, 0), (5, 13)])
def test_any_layout_gives_the_same_points(
    tmp_path: Path, layout: str, kind: str, rows: int, row_padding: int
) -> None:
    cloud = random_cloud(3)
    points = laid_out(cloud, LAYOUTS[layout]).reshape(rows, -1)
    path = write_bag(tmp_path, kind, {"/points": [points]}, row_padding=row_padding)
    assert_same(read_cloud(path), cloud)


def test_time_by_any_of_its_names(tmp_path: Path) -> None:
    for name in ("time", "t", "timestamp", "offset_time"):
        points = np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4"), (name, "<f8")])
        points["x"], points[name] = 1, [0.5, 1, 1.5, 2]
        folder = tmp_path / name
        folder.mkdir()
        read = read_cloud(write_bag(folder, "bag", {"/points": [points]}))
        np.testing.assert_array_equal(read.time, points[name])


UNIX = 1_700_000_000.0

DRIVERS: dict[str, tuple[list[tuple[str, str]], str, float]] = {
    "livox_ros_driver2": ([("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")], "timestamp", 1e9),
    "rslidar_sdk": ([("ring", "<u2"), ("timestamp", "<f8")], "timestamp", 1),
    "hesai_ros_driver": ([("ring", "<u2"), ("timestamp", "<f8")], "timestamp", 1),
    "seyond": ([("timestamp", "<f8"), ("flags", "u1"), ("elongation", "u1")], "timestamp", 1),
    "ouster": ([("t", "<u4"), ("reflectivity", "<u2"), ("ring", "<u2")], "t", 1e9),
    "nebula": (
        [("return_type", "u1"), ("channel", "<u2"), ("time_stamp", "<u4")],
        "time_stamp",
        1e9,
    ),
}
"""Of drivers: fields besides x, y, z and intensity, that of times, and what a second counts."""


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("intensity", ["<f4", "<u2", "u1"])
def test_clouds_of_drivers(tmp_path: Path, driver: str, intensity: str) -> None:
    fields, name, unit = DRIVERS[driver]
    kind = [*((axis, "<f4") for axis in "xyz"), ("intensity", intensity), *fields]
    points, start = np.zeros(8, kind), 0.0 if "u" in dict(fields)[name] else UNIX
    points["x"], points["intensity"] = np.arange(1, 9), np.arange(8) * 30
    points[name] = (start + np.arange(8) * 0.01) * unit
    read = read_cloud(write_bag(tmp_path, "bag", {"/points": [points]}))
    np.testing.assert_array_equal(read.xyz[:, 0], points["x"])
    np.testing.assert_array_equal(required(read.intensity), points["intensity"])
    np.testing.assert_allclose(required(read.time) - start, np.arange(8) * 0.01, atol=1e-6)
    assert (read.ring is None) == (driver == "seyond")


def test_second_returns_are_left_out(tmp_path: Path) -> None:
    """As Seyond's driver marks them."""
    kind = [*((axis, "<f4") for axis in "xyz"), ("intensity", "<f4"), ("is_2nd_return", "u1")]
    points = np.zeros(9, kind)
    points["x"], points["is_2nd_return"] = np.arange(9), np.arange(9) % 3 == 1
    read = read_cloud(write_bag(tmp_path, "bag", {"/points": [points]}))
    assert read.xyz[:, 0].tolist() == [2, 3, 5, 6, 8]
    assert (read.dropped, read.notes) == (1, ("3 second returns (is_2nd_return) are left out",))


def test_no_returns_are_dropped_and_counted_in_every_frame(tmp_path: Path) -> None:
    some, none = random_cloud(1), random_cloud(2)
    some.xyz[:7], some.xyz[7:9] = np.nan, 0
    none.xyz[:] = np.nan
    clouds = [some, none, random_cloud(4)]
    points = [*map(points_of, clouds), points_of(random_cloud(5))[:0]]
    path = write_bag(tmp_path, "mcap", {"/points": points})
    read = read_cloud(path)
    assert (len(read), read.dropped) == (50 - 9 + 50, 9 + 50)
    np.testing.assert_array_equal(np.unique(required(read.frame)), [0, 2])
    with pytest.raises(ReadError, match="none of the 50 points in 2 frames"):
        read_cloud(path, frames=slice(1, None, 2))


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_is_chosen_or_requested(tmp_path: Path, kind: str) -> None:
    front, rear = random_cloud(1), random_cloud(2)
    path = write_bag(
        tmp_path, kind, {"/front": [points_of(front)] * 2, "/rear": [points_of(rear)], "/mute": []}
    )
    assert_same(read_cloud(path, topic="/rear"), rear)
    assert open_recording(path, topic="/front").count == 2
    with pytest.raises(ReadError, match=r"2 topics .* /front \(2 messages\), /rear \(1 message\)"):
        read_cloud(path)
    with pytest.raises(ReadError, match=r"no topic /absent; .* /front"):
        read_cloud(path, topic="/absent")
    with pytest.raises(ReadError, match=r"/said is of std_msgs/msg/String"):
        read_cloud(path, topic="/said")
    with pytest.raises(ReadError, match="/mute has no messages"):
        read_cloud(path, topic="/mute")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_clouds_says_what_it_has(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path, kind, {})
    with pytest.raises(ReadError, match=r"no topic of sensor_msgs|not a readable bag"):
        read_cloud(path)


def test_a_topic_of_another_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n")
    with pytest.raises(UsageError, match="has no topics"):
        read_cloud(tmp_path / "a.csv", topic="/points")


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_sliced_as_a_list(tmp_path: Path, kind: str) -> None:
    clouds = [random_cloud(seed) for seed in range(7)]
    path = write_bag(tmp_path, kind, {"/points": [points_of(cloud) for cloud in clouds]})
    for wanted in (slice(2, 4), slice(-2, None), slice(None, None, 3), slice(5, 99), slice(3, 4)):
        numbers = list(range(7))[wanted]
        read = read_cloud(path, frames=wanted)
        np.testing.assert_array_equal(read.xyz, np.concatenate([clouds[k].xyz for k in numbers]))
        expected = None if len(numbers) == 1 else np.repeat(numbers, 50)
        np.testing.assert_array_equal(read.frame, expected)
    with pytest.raises(ReadError, match="has 7 frames, numbered from 0; none is in 7:9"):
        read_cloud(path, frames=slice(7, 9))
    with pytest.raises(UsageError, match="step cannot be -1"):
        read_cloud(path, frames=slice(None, None, -1))


def test_of_a_long_recording_some_frames_are_read_evenly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = [random_cloud(seed) for seed in range(30)]
    path = write_bag(tmp_path, "bag", {"/points": [points_of(cloud) for cloud in clouds]})
    monkeypatch.setattr("retropole.io.recordings.MAX_RECORDING_POINTS", 500)
    assert chosen_frames(open_recording(path)) == range(0, 30, 3)
    read = read_cloud(path)
    assert len(read) == 500
    np.testing.assert_array_equal(np.unique(required(read.frame)), range(0, 30, 3))
    assert len(read_cloud(path, frames=slice(None))) == 1500


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_memory_does_not_grow_with_the_length_of_a_bag(tmp_path: Path, kind: str) -> None:
    points = points_of(random_cloud(0, 20_000))
    peaks = []
    for length in (6, 60):
        folder = tmp_path / str(length)
        folder.mkdir()
        path = write_bag(folder, kind, {"/points": [points] * length})
        read_cloud(path, frames=slice(1))  # what is imported and cached is not the bag's
        tracemalloc.start()
        assert sum(len(frame.cloud) for frame in read_frames(path)) == length * 20_000
        assert len(read_cloud(path, frames=slice(-1, None))) == 20_000
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.25 * peaks[0]


@pytest.mark.parametrize("suffix", BAGS)
@pytest.mark.parametrize("content", [b"", b"no bag at all", bytes(5000)])
def test_other_files_are_named(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"recording{suffix}"
    path.write_bytes(content)
    with pytest.raises(ReadError, match=rf"recording\{suffix}: is (empty|not a readable bag)"):
        read_cloud(path)


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_a_bag_cut_short_never_gives_other_points(tmp_path: Path, kind: str) -> None:
    clouds = [random_cloud(seed, 400) for seed in range(12)]
    path = write_bag(tmp_path, kind, {"/points": [points_of(cloud) for cloud in clouds]})
    content = path.read_bytes()
    for part in np.linspace(0.02, 0.98, 25):
        path.write_bytes(content[: int(part * len(content))])
        with pytest.raises(ReadError, match=f"recording.*{kind}"):
            read_cloud(path)


def test_missing_rosbags_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[ros\]"):
        read_cloud(tmp_path / "a.bag")


def test_a_folder_of_bags_asks_for_one(tmp_path: Path) -> None:
    (tmp_path / "a.bag").touch()
    (tmp_path / "b.bag").touch()
    with pytest.raises(ReadError, match=r"give one of them: a\.bag, b\.bag"):
        read_cloud(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 51}, "do not fit its 900 bytes"),
        ({"height": 2}, "do not fit its 900 bytes"),
        ({"point_step": 17}, "field ring ends at byte 18, a point has 17"),
        ({"point_step": 0}, "ends at byte"),
        ({"data": np.zeros(17, np.uint8)}, "do not fit its 17 bytes"),
    ],
)
def test_layouts_that_contradict_themselves(change: dict[str, object], reason: str) -> None:
    made = message(points_of(random_cloud()), get_typestore(ROS1))
    for name, value in change.items():
        object.__setattr__(made, name, value)
    with pytest.raises(ReadError, match=reason):
        columns_of(made)


def test_unknown_datatypes_are_refused_and_no_count_is_one() -> None:
    made = message(points_of(random_cloud()), get_typestore(ROS1))
    object.__setattr__(made.fields[0], "count", 0)
    assert columns_of(made)["x"].shape == (50,)
    object.__setattr__(made.fields[0], "datatype", 9)
    with pytest.raises(ReadError, match="field x has datatype 9, expected 1 to 8"):
        columns_of(made)


def test_a_wrong_row_step_of_packed_rows_does_no_harm() -> None:
    points = points_of(random_cloud()).reshape(5, 10)
    made = message(points, get_typestore(ROS1))
    for wrong in (0, 18, 900):
        object.__setattr__(made, "row_step", wrong)
        np.testing.assert_array_equal(columns_of(made)["x"], points["x"].reshape(-1))


def test_a_bag_of_sick_is_read_as_rosbags_reads_it() -> None:
    path = shared("bag/rms_1xxx_lms_1xx_movement_off.bag")
    with pytest.raises(ReadError, match=r"3 topics of point clouds.*/cloud \(89 messages\)"):
        read_cloud(path)
    read = read_cloud(path, topic="/cloud")
    store, rows = get_typestore(ROS1), []
    with Reader1(path) as reader:
        wanted = [own for own in reader.connections if own.topic == "/cloud"]
        for _, _, data in reader.messages(connections=wanted):
            made: Any = store.deserialize_ros1(data, CLOUDS)
            rows.append(made.data.view("<f4").reshape(-1, made.point_step // 4)[:, :4])
    table = np.concatenate(rows).astype(float)
    kept = np.isfinite(table[:, :3]).all(axis=1) & table[:, :3].any(axis=1)
    assert (len(read), read.dropped) == (int(kept.sum()), int((~kept).sum())) == (45_804, 2_345)
    np.testing.assert_array_equal(read.xyz, table[kept, :3])
    np.testing.assert_array_equal(read.intensity, table[kept, 3])
    assert len(np.unique(required(read.frame))) == 89


def test_messages_of_ros_1_in_an_mcap_are_read_as_pypcd4_reads_them() -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    from mcap.reader import make_reader

    path = shared("mcap/test.mcap")
    read = read_cloud(path)
    store, tables = get_typestore(ROS1), []
    with path.open("rb") as file:
        for _, _, entry in make_reader(file).iter_messages(topics=["/os1_cloud_node/points"]):
            made = store.deserialize_ros1(entry.data, CLOUDS)
            names = ("x", "y", "z", "intensity", "ring")
            tables.append(pypcd4.PointCloud.from_msg(made).numpy(names))
    table = np.concatenate(tables).astype(float)
    kept = np.isfinite(table[:, :3]).all(axis=1) & table[:, :3].any(axis=1)
    assert (len(read), read.dropped) == (int(kept.sum()), int((~kept).sum())) == (91_525, 170_619)
    np.testing.assert_array_equal(read.xyz, table[kept, :3])
    np.testing.assert_array_equal(read.intensity, table[kept, 3])
    np.testing.assert_array_equal(read.ring, table[kept, 4])


@pytest.mark.parametrize("name", ["run%41", "run#1", "run?mode=rwc", "50%", "ünï ☃", "-x"])
@pytest.mark.parametrize("kind", ["db3", "db3 folder"])
def test_a_bag_is_read_whatever_its_name_means_in_an_address(
    kind: str, name: str, tmp_path: Path
) -> None:
    cloud = random_cloud()
    right = write_bag(tmp_path / "a", kind, {"/points": [points_of(cloud)]})
    other = write_bag(tmp_path / "b", kind, {"/points": [points_of(cloud.select(np.arange(3)))]})
    path = tmp_path / f"{name}{right.suffix}"
    right.rename(path)
    other.rename(tmp_path / f"runA{right.suffix}")
    assert len(read_cloud(path)) == len(cloud)


def test_an_upper_case_suffix_is_a_suffix(tmp_path: Path) -> None:
    cloud = random_cloud()
    path = write_bag(tmp_path, "db3", {"/points": [points_of(cloud)]})
    upper = path.rename(path.with_name("RUN.DB3"))
    assert len(read_cloud(upper)) == len(cloud)


def test_a_file_inside_a_bag_is_read_whatever_its_name_means_in_an_address(
    tmp_path: Path,
) -> None:
    cloud = random_cloud()
    folder = write_bag(tmp_path, "db3 folder", {"/points": [points_of(cloud)]})
    (file,) = folder.glob("*.db3")
    (folder / "runA.db3").write_bytes(b"another")
    odd = file.rename(file.with_name("run%41.db3"))
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(file.name, odd.name))
    assert_same(read_cloud(folder), cloud)


def test_more_points_than_bytes_for_them_are_refused() -> None:
    made = message(points_of(random_cloud()), get_typestore(ROS1))
    count = 2**22 + 1
    for entry in made.fields:
        object.__setattr__(entry, "offset", 0)
        object.__setattr__(entry, "datatype", 2)
    for name, value in {
        "width": count,
        "point_step": 1,
        "row_step": count,
        "data": np.ones(count, np.uint8),
    }.items():
        object.__setattr__(made, name, value)
    with pytest.raises(ReadError, match="4,194,305 points of 1 bytes"):
        columns_of(made)
    object.__setattr__(made, "width", count - 1)
    assert len(columns_of(made)["x"]) == count - 1


def test_what_others_wrote_is_not_kept_without_end() -> None:
    cloud = random_cloud(1)
    made: Any = message(points_of(cloud), STORE)
    made.header.frame_id = "f" * 5_000_000
    frame = frame_of("", "/points", 0, 0, bytes(STORE.serialize_cdr(made, CLOUDS)), "cdr")
    # No export takes it for a whole one.
    assert LONGEST_EXPORTED < len(frame.frame_id) <= 1000
    with pytest.raises(ReadError, match="69,206,016 bytes, up to"):
        frame_of("", "/points", 0, 0, bytes(66 * 2**20), "cdr")
    with pytest.raises(ReadError) as caught:
        frame_of("", "t" * 5_000_000, 0, 0, b"", "cdr")
    assert len(str(caught.value)) <= 300


class TestLivox:
    """``CustomMsg``, which Livox' drivers send where ``xfer_format`` is 1."""

    @pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
    @pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
    def test_the_points_are_those_of_the_driver(
        self, tmp_path: Path, package: str, kind: str
    ) -> None:
        clouds = [random_cloud(seed, 40 + seed) for seed in range(3)]
        path = write_livox_bag(tmp_path, [*clouds, random_cloud(9, 0)], package, kind)
        frames = list(read_frames(path))
        for frame, cloud in zip(frames, clouds, strict=False):
            assert_same(frame.cloud, cloud)
            assert frame.frame_id == "livox_frame"
            assert frame.stamp == pytest.approx(LIVOX_START / 1e9 + 0.1 * frame.number)
            times = required(frame.stamp) + 1e-6 * np.arange(len(cloud))
            assert np.abs(required(frame.cloud.time) - times).max() < 5e-7
            assert frame.cloud.notes == ()
        assert (len(frames), len(frames[3].cloud)) == (4, 0)
        whole = read_cloud(path, topic="/livox/lidar")
        np.testing.assert_array_equal(whole.xyz, np.concatenate([each.xyz for each in clouds]))
        assert whole.recorded == pytest.approx((LIVOX_START / 1e9, LIVOX_START / 1e9 + 0.2))
        with closing(ReplaySource(path)) as source:
            played = source.newest(5)
        assert_same(required(played).cloud, clouds[0])
        if kind != "bag":
            with closing(BagSource(path)) as growing:
                newest = required(growing.newest(5))
            assert (newest.number, newest.frame_id, len(newest.cloud)) == (3, "livox_frame", 0)

    def test_an_older_package_and_a_topic_that_is_none(self, tmp_path: Path) -> None:
        cloud = random_cloud()
        path = write_livox_bag(tmp_path, [cloud], "livox_interfaces", "mcap")
        assert_same(read_cloud(path), cloud)
        with pytest.raises(ReadError, match=r"no topic /absent; .* /livox/lidar \(1 message\)"):
            read_cloud(path, topic="/absent")

    @pytest.mark.parametrize("encoding", ["ros1", "cdr"])
    def test_a_number_of_points_that_lies_takes_no_memory(self, encoding: str) -> None:
        is_plain = encoding == "ros1"
        store = livox_store("livox_ros_driver2", ros1=is_plain)
        write = store.serialize_ros1 if is_plain else store.serialize_cdr
        name = "livox_ros_driver2/msg/CustomMsg"
        made = livox_message(random_cloud(), store, "livox_ros_driver2", 5)
        data = bytearray(write(made, name))
        promised = data.index(struct.pack("<QI", 5, 50)) + 8

        def decoded(changed: bytes) -> PointCloud:
            return frame_of("", "/a", 3, 0, changed, encoding, name).cloud

        # The number in the header is of no use; that of the array is what counts.
        data[promised : promised + 4] = struct.pack("<I", 2**32 - 1)
        (note,) = decoded(bytes(data)).notes
        assert note.startswith("point_num is not the number of points")
        for at, value in ((promised + 8, 2**32 - 1), (promised + 8, 49), (promised + 8, 51)):
            changed = bytearray(data)
            changed[at : at + 4] = struct.pack("<I", value)
            tracemalloc.start()
            with pytest.raises(ReadError, match=f"message 3 of /a: promises {value:,} points"):
                decoded(bytes(changed))
            assert tracemalloc.get_traced_memory()[1] < 10**6
            tracemalloc.stop()
        for end in range(0, len(data) - 4, 37):
            with pytest.raises(ReadError, match=r"message 3 of /a: (is not a readable|promises)"):
                decoded(bytes(data[:end]))
