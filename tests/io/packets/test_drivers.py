"""Messages of drivers give the packets that were put in, in every layout and encoding."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io.packets.drivers import LAYOUTS, datagrams
from retropole.io.recordings import PACKET_MESSAGES


def test_the_types_are_those_that_are_listed() -> None:
    assert set(LAYOUTS) == PACKET_MESSAGES


def written(kind: str, layout: dict[str, str], *, is_ros1: bool) -> tuple[bytes, list[bytes]]:
    """Write a message of two packets, or of one, and give these besides."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    package, name = kind.split("/")[0], layout["frame"].rpartition("\n")[2].partition("[")[0]
    types = get_types_from_msg(layout["frame"], kind)
    has_packets = "packet" in layout
    inner = f"{package}/msg/{name}" if has_packets else kind
    if has_packets:
        types |= get_types_from_msg(layout["packet"], inner)
    store.register(types)
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
    assert {each.time for each in found} == {5.0}


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", bytes(5000), b"\xff" * 5000])
def test_other_bytes_are_no_message(data: bytes) -> None:
    pytest.importorskip("rosbags", reason="needs pip install 'retropole[ros]'")
    with pytest.raises(ReadError, match="is no pandar_msgs/msg/PandarScan"):
        list(datagrams(iter([(0, data, "cdr")]), "pandar_msgs/msg/PandarScan"))
