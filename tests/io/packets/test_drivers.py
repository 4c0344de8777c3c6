"""Messages of drivers give the packets that were put in, in every layout and encoding."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from retropole.base.errors import ReadError
from retropole.io import read_frames, read_recording
from retropole.io.packets import capture
from retropole.io.packets.drivers import LAYOUTS, datagrams
from retropole.io.recordings import PACKET_MESSAGES, clock_offset
from tests.io.files import required
from tests.io.packets.sending import bag_of
from tests.paths import SHARED


def test_the_types_are_those_that_are_listed() -> None:
    assert set(LAYOUTS) == PACKET_MESSAGES


def name_of(layout: dict[str, str]) -> str:
    """Name the type of the packets of a message."""
    return layout["frame"].rpartition("\n")[2].partition("[")[0]


def store_of(kind: str, layout: dict[str, str], *, is_ros1: bool) -> Any:
    """Give a store of types with a message and its packets."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    types = get_types_from_msg(layout["frame"], kind)
    if "packet" in layout:
        inner = f"{kind.partition('/')[0]}/msg/{name_of(layout)}"
        types |= get_types_from_msg(layout["packet"], inner)
    store.register(types)
    return store


def written(kind: str, layout: dict[str, str], *, is_ros1: bool) -> tuple[bytes, list[bytes]]:
    """Write a message of two packets, or of one, and give these besides."""
    has_packets = "packet" in layout
    store, inner = store_of(kind, layout, is_ros1=is_ros1), kind
    if has_packets:
        inner = f"{kind.partition('/')[0]}/msg/{name_of(layout)}"
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    seq = {"seq": 0} if is_ros1 else {}
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **seq)
    text = layout["packet" if has_packets else "frame"]
    sizes = [each.partition("uint8[")[2].partition("]")[0] for each in text.split("\n")]
    length = int(max(sizes, key=len) or 1080)
    sent = [bytes([k + 1]) * (1206 if "size" in text else length) for k in range(1 + has_packets)]
    values: dict[str, Callable[[bytes], Any]] = {
        "stamp": lambda data: stamp,
        "header": lambda data: header,
        "is_difop": lambda data: 0,
        "is_frame_begin": lambda data: 1,
        "size": len,
        "data": lambda data: np.frombuffer(
            data.ljust(length if max(sizes, key=len) else 0, b"\xaa"), np.uint8
        ),
    }
    made: Any = store.types[inner]
    names = [field.name for field in fields(made) if field.name in values]
    packets = [made(**{name: values[name](data) for name in names}) for data in sent]
    if not has_packets:
        whole = packets[0]
    else:
        own = {"header": header} if "header" in layout["frame"] else {}
        whole = store.types[kind](**own, packets=packets)
    write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    return bytes(write(whole, kind)), sent


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize(
    ("kind", "k"), [(kind, k) for kind, own in LAYOUTS.items() for k in range(len(own))]
)
def test_packets_come_out_as_they_went_in(kind: str, k: int, is_ros1: bool) -> None:
    pytest.importorskip("rosbags", reason="needs pip install 'retropole[ros]'")
    data, sent = written(kind, LAYOUTS[kind][k], is_ros1=is_ros1)
    messages = [(5_000_000_000, data, "ros1" if is_ros1 else "cdr")] * 2
    found = list(datagrams(iter(messages), kind))
    assert [each.payload for each in found] == sent * 2
    # Packets that say when they came go before the message.
    says = "stamp" in LAYOUTS[kind][k].get("packet", LAYOUTS[kind][k]["frame"])
    assert {each.time for each in found} == {1.0 if says else 5.0}


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", bytes(5000), b"\xff" * 5000])
def test_other_bytes_are_no_message(data: bytes) -> None:
    pytest.importorskip("rosbags", reason="needs pip install 'retropole[ros]'")
    with pytest.raises(ReadError, match="is not a known pandar_msgs/msg/PandarScan"):
        list(datagrams(iter([(0, data, "cdr")]), "pandar_msgs/msg/PandarScan"))


@pytest.mark.parametrize("is_ros1", [True, False])
def test_a_bag_of_a_velodyne_gives_what_its_capture_gives(tmp_path: Path, is_ros1: bool) -> None:
    pytest.importorskip("velodyne_decoder")
    path = SHARED / "formats" / "velodyne" / "sample_velodyne_vlp16_gps.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    kind = "velodyne_msgs/msg/VelodyneScan"
    store = store_of(kind, LAYOUTS[kind][0], is_ros1=is_ros1)
    types: Any = store.types
    time, packet = types["builtin_interfaces/msg/Time"], types["velodyne_msgs/msg/VelodynePacket"]
    packets = [
        packet(
            stamp=time(sec=int(own.time), nanosec=round(own.time % 1 * 1e9)),
            data=np.frombuffer(own.payload, np.uint8),
        )
        for own, *_ in capture.similar_packets(path, capture.walk(path), lambda _: None)
        if len(own.payload) == 1206
    ]
    seq = {"seq": 0} if is_ros1 else {}
    header = types["std_msgs/msg/Header"](stamp=time(sec=1, nanosec=0), frame_id="", **seq)
    scans = [types[kind](header=header, packets=packets[k : k + 76]) for k in range(0, 300, 76)]
    bag = tmp_path / ("a.bag" if is_ros1 else "a")
    writer = Writer1(bag) if is_ros1 else Writer2(bag, version=8)
    with writer:
        own = writer.add_connection("/velodyne_packets", kind, typestore=store)
        for k, scan in enumerate(scans):
            write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(own, 1_700_000_000_000_000_000 + k * 100_000_000, write(scan, kind))
    recorded = next(iter(read_frames(path)))
    first, second, *_ = read_frames(bag)
    assert (first.cloud.model, recorded.cloud.model) == ("VLP-16", "VLP-16")
    np.testing.assert_array_equal(first.cloud.xyz, recorded.cloud.xyz)
    np.testing.assert_allclose(required(first.cloud.time), required(recorded.cloud.time), atol=1e-4)
    assert len(second.cloud) > 10_000


@pytest.mark.parametrize(
    ("name", "days"), [("robosense_helios32", 2399.4), ("hesai_xt32", 1265.9), ("hesai_64", 929.6)]
)
def test_a_clock_that_was_never_set_is_that_far_behind(
    tmp_path: Path, name: str, days: float
) -> None:
    """These units count from dates of 2017 to 2020; their bags are of 2023."""
    offset = clock_offset(read_recording(bag_of(name, tmp_path)).headers)
    assert required(offset) / -86400 == pytest.approx(days, abs=0.1)
