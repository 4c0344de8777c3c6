"""Bags for the tests, written by rosbags."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from retropole.base.datatypes import PointCloud

CLOUDS = "sensor_msgs/msg/PointCloud2"
KINDS = ("bag", "db3", "mcap", "db3 folder", "mcap folder")
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
START, STEP = 1_700_000_000_000_000_000, 100_000_000


def points_of(cloud: PointCloud, kind: str = "<f4") -> NDArray[Any]:
    """Make a record array of a cloud's columns."""
    columns: dict[str, NDArray[Any]] = {
        "x": cloud.xyz[:, 0],
        "y": cloud.xyz[:, 1],
        "z": cloud.xyz[:, 2],
    }
    if cloud.intensity is not None:
        columns["intensity"] = cloud.intensity
    if cloud.ring is not None:
        columns["ring"] = cloud.ring
    points = np.zeros(len(cloud), [(name, "<u2" if name == "ring" else kind) for name in columns])
    for name, column in columns.items():
        points[name] = column
    return points


def message(
    points: NDArray[Any],
    store: Any,
    *,
    row_padding: int = 0,
    frame_id: str = "lidar",
    stamp: int = 10**9,
) -> Any:
    """Make a PointCloud2 of a record array (N,) or (height, width), laid out as that is."""
    rows = np.atleast_2d(points)
    kind, types = points.dtype, store.types
    fields, big = [], False
    for name, (own, offset, *_) in (kind.fields or {}).items():
        base, shape = own.subdtype or (own, (1,))
        big |= base.byteorder == ">"
        number = DATATYPES[base.str[1:]]
        fields.append(
            types["sensor_msgs/msg/PointField"](
                name=name, offset=offset, datatype=number, count=shape[0]
            )
        )
    data = b"".join(row.tobytes() + b"\xaa" * row_padding for row in rows)
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    seq = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return types[CLOUDS](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **seq),
        height=rows.shape[0],
        width=rows.shape[1],
        fields=fields,
        is_bigendian=big,
        point_step=kind.itemsize,
        row_step=kind.itemsize * rows.shape[1] + row_padding,
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )


def write_bag(
    folder: Path,
    kind: str,
    topics: Mapping[str, Sequence[NDArray[Any]]],
    *,
    store: Stores | None = None,
    compression: Any = None,
    ahead: Mapping[str, float] | None = None,
    **layout: Any,
) -> Path:
    """Write record arrays as messages, 10 a second and topic by topic in turn; give the bag.

    The stamps of a topic are some seconds `ahead` of the recorder's clock, else 1 s after 1970.
    """
    ros1 = kind == "bag"
    types = get_typestore(store or (Stores.ROS1_NOETIC if ros1 else Stores.LATEST))
    path = folder / ("recording.bag" if ros1 else "recording")
    writer: Any
    if ros1:
        writer = Writer1(path)
        if compression is not None:
            writer.set_compression(compression)
    else:
        plugin = StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression is not None:
            writer.set_compression(*compression)
    with writer:
        connections = {
            name: writer.add_connection(name, CLOUDS, typestore=types) for name in topics
        }
        connections["/said"] = writer.add_connection(
            "/said", "std_msgs/msg/String", typestore=types
        )
        text = types.types["std_msgs/msg/String"](data="word")
        for k in range(max((len(clouds) for clouds in topics.values()), default=0)):
            for name, clouds in topics.items():
                if k < len(clouds):
                    if ahead is not None:
                        layout["stamp"] = START + k * STEP + round(1e9 * ahead[name])
                    made = message(clouds[k], types, **layout)
                    data = types.serialize_ros1 if ros1 else types.serialize_cdr
                    writer.write(connections[name], START + k * STEP, data(made, CLOUDS))
            data = types.serialize_ros1 if ros1 else types.serialize_cdr
            writer.write(connections["/said"], START + k * STEP, data(text, "std_msgs/msg/String"))
    if ros1 or "folder" in kind:
        return path
    return next(path.glob(f"*.{kind}*"))
