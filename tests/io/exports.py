"""A cloud as programs of makers and surveyors export it: text, and Livox' messages in a bag."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retropole.base.datatypes import Array, PointCloud

Maker = Callable[[PointCloud], bytes]

LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\n"
    "uint8 line\n"
)
LIVOX_MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "{package}/CustomPoint[] points\n"
)
START = 1_700_000_000_000_000_000
"""Time of the first message, ns; one follows every 0.1 s."""


def rows(*columns: NDArray[Any], separator: str = ",") -> str:
    """Write columns of numbers, whole ones as such and others to 0.1 mm."""
    words = [
        [f"{value}" for value in column.tolist()]
        if column.dtype.kind in "iuU"
        else [f"{value:.4f}" for value in column.tolist()]
        for column in columns
    ]
    return "".join(separator.join(row) + "\n" for row in zip(*words, strict=True))


def parts(cloud: PointCloud) -> tuple[Array, Array, Array, NDArray[Any], NDArray[Any], Array]:
    """Give x, y, z, whole intensities and rings, and zeros."""
    assert cloud.intensity is not None
    ring = np.zeros(len(cloud), int) if cloud.ring is None else cloud.ring
    x, y, z = cloud.xyz.T
    return x, y, z, np.rint(cloud.intensity).astype(int), ring, np.zeros(len(cloud), int)


def livox_viewer(cloud: PointCloud) -> bytes:
    x, y, z, intensity, _, zero = parts(cloud)
    head = "Version,Slot ID,LiDAR Index,Rsvd,Error Code,Timestamp Type,Data Type,Timestamp,X,Y,Z,"
    head += "Reflectivity,Tag,Ori_x,Ori_y,Ori_z,Ori_radius,Ori_theta,Ori_phi\n"
    five, code = zero + 5, np.full(len(cloud), "0x0000001F")
    time = 2_444_124_311_890 + 10_000 * np.arange(len(cloud))
    raw = np.rint(1000 * cloud.xyz).astype(int).T
    own = [five, zero + 1, zero + 1, zero, code, zero, zero, time, x, y, z, intensity, zero, *raw]
    return (head + rows(*own, zero, zero, zero)).encode()


def livox_viewer_2(cloud: PointCloud) -> bytes:
    x, y, z, intensity, _, zero = parts(cloud)
    head = "Version,LiDAR Index,Rsvd,Error Code,Timestamp Type,Data Type,Timestamp,X,Y,Z,"
    head += "Reflectivity,Tag,Ori_x\n47MDN540030520,0.0,0.0,0.0,0.0,0.0,0.0,2,9,12975552\n"
    own = [zero, zero, zero, zero, zero, zero + 2, zero + 1, x, y, z, intensity, zero, zero]
    return (head + rows(*own)).encode()


def veloview(cloud: PointCloud) -> bytes:
    x, y, z, intensity, ring, zero = parts(cloud)
    head = '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","intensity","laser_id","azimuth",'
    head += '"distance_m","adjustedtime","timestamp","vertical_angle"\n'
    azimuth = np.rint(100 * np.degrees(np.arctan2(x, y))).astype(int) % 36_000
    time = 1_000_000 + np.arange(len(cloud))
    length = np.linalg.norm(cloud.xyz, axis=1)
    own = [x, y, z, intensity, ring, azimuth, length, time + 10**9, time, zero]
    return (head + rows(*own)).encode()


def veloview_3(cloud: PointCloud) -> bytes:
    """Write what older versions do: ParaView's names, and X, Y, Z besides."""
    x, y, z, intensity, ring, zero = parts(cloud)
    head = '"Points:0","Points:1","Points:2","X","Y","Z","intensity","laser_id","timestamp"\n'
    return (head + rows(x, y, z, x, y, z, intensity, ring, zero)).encode()


def pandarview(cloud: PointCloud) -> bytes:
    x, y, z, intensity, ring, zero = parts(cloud)
    head = '"Points:0","Points:1","Points:2","intensity","laser_id","azimuth","distance_m",'
    return (head + '"timestamp"\n' + rows(x, y, z, intensity, ring, zero, x, zero)).encode()


def ouster(cloud: PointCloud) -> bytes:
    x, y, z, intensity, ring, zero = parts(cloud)
    head = "TIMESTAMP (ns), ROW, DESTAGGERED IMAGE COLUMN, MEASUREMENT_ID, RANGE (mm), "
    head += "SIGNAL (photons), REFLECTIVITY (%), NEAR_IR (photons), X1 (m), Y1 (m), Z1 (m)\n"
    own = [zero + 10**15, ring, zero, zero, zero, intensity, zero + 7, zero, x, y, z]
    return (head + rows(*own, separator=", ")).encode()


def ouster_in_mm(cloud: PointCloud) -> bytes:
    """Write what older versions of Ouster's program do: comments, and millimetres."""
    _, _, _, intensity, _, zero = parts(cloud)
    head = "# frame num: 0\n# TIMESTAMP (ns), SIGNAL (photons), X1 (mm), Y1 (mm), Z1 (mm)\n"
    whole = np.rint(1000 * cloud.xyz).astype(int).T
    return (head + rows(zero + 10**15, intensity, *whole, separator=", ")).encode()


def cloudcompare(cloud: PointCloud) -> bytes:
    x, y, z, intensity, *_ = parts(cloud)
    body = rows(x, y, z, intensity, separator=" ")
    return f"//X Y Z Intensity\n{len(cloud)}\n{body}".encode()


def counted(cloud: PointCloud) -> bytes:
    x, y, z, intensity, *_ = parts(cloud)
    return f"{len(cloud)}\n{rows(x, y, z, intensity, separator=' ')}".encode()


def leica(cloud: PointCloud) -> bytes:
    """Write a .pts, its intensities 16 times those of the cloud, from -2048 up."""
    x, y, z, intensity, _, zero = parts(cloud)
    colours = [zero + 255, zero, zero + 3]
    body = rows(x, y, z, 16 * intensity - 2048, *colours, separator=" ")
    return f"{len(cloud)}\r\n{body}".encode()


def spreadsheet(cloud: PointCloud) -> bytes:
    """Write what a spreadsheet does where the comma is the decimal mark."""
    x, y, z, intensity, *_ = parts(cloud)
    text = "X;Y;Z;Intensity\n" + rows(x, y, z, intensity, separator=";").replace(".", ",")
    return codecs.BOM_UTF8 + text.encode()


def unicode_text(cloud: PointCloud) -> bytes:
    """Write tabs in UTF-16, as "Unicode text" of a spreadsheet and PowerShell have it."""
    x, y, z, intensity, *_ = parts(cloud)
    text = "X\tY\tZ\tIntensity\n" + rows(x, y, z, intensity, separator="\t")
    return text.replace("\n", "\r\n").encode("utf-16")


def commas_and_blanks(cloud: PointCloud) -> bytes:
    x, y, z, intensity, *_ = parts(cloud)
    return rows(x, y, z, intensity, separator=" ").replace(".", ",").encode()


EXPORTS: dict[str, Maker] = {
    "livox viewer.csv": livox_viewer,
    "livox viewer 2.csv": livox_viewer_2,
    "veloview.csv": veloview,
    "veloview 3.csv": veloview_3,
    "pandarview.csv": pandarview,
    "ouster.csv": ouster,
    "ouster in mm.csv": ouster_in_mm,
    "cloudcompare.txt": cloudcompare,
    "counted.asc": counted,
    "counted.xyz": counted,
    "counted.pts": counted,
    "leica.pts": leica,
    "spreadsheet.csv": spreadsheet,
    "unicode text.txt": unicode_text,
    "commas and blanks.txt": commas_and_blanks,
}
"""By the name of a file of the program, what it writes."""


def livox_store(package: str, ros1: bool) -> Any:
    """Make rosbags know the messages of a driver of Livox."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
    point = get_types_from_msg(LIVOX_POINT, f"{package}/msg/CustomPoint")
    message = LIVOX_MESSAGE.format(package=package)
    store.register({**point, **get_types_from_msg(message, f"{package}/msg/CustomMsg")})
    return store


def livox_message(cloud: PointCloud, store: Any, package: str, timebase: int) -> Any:
    """Make a message of a cloud, one point every microsecond."""
    types = store.types
    x, y, z, intensity, line, _ = parts(cloud)
    made = types[f"{package}/msg/CustomPoint"]
    points = [
        made(offset_time=1000 * k, x=a, y=b, z=c, reflectivity=i, tag=16, line=n)
        for k, (a, b, c, i, n) in enumerate(
            zip(*(each.tolist() for each in (x, y, z, intensity, line)), strict=True)
        )
    ]
    header = types["std_msgs/msg/Header"]
    seq = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    return types[f"{package}/msg/CustomMsg"](
        header=header(stamp=stamp, frame_id="livox_frame", **seq),
        timebase=timebase,
        point_num=len(points),
        lidar_id=0,
        rsvd=np.zeros(3, np.uint8),
        points=points,
    )


def write_livox_bag(
    folder: Path, clouds: list[PointCloud], package: str, kind: str, topic: str = "/livox/lidar"
) -> Path:
    """Write a bag (``bag``, ``db3`` or ``mcap``) with a message of a driver of Livox per cloud."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    ros1 = kind == "bag"
    store = livox_store(package, ros1)
    path = folder / ("livox.bag" if ros1 else "livox")
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer: Any = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin)
    name = f"{package}/msg/CustomMsg"
    write = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        connection = writer.add_connection(topic, name, typestore=store)
        for k, cloud in enumerate(clouds):
            stamp = START + 100_000_000 * k
            made = livox_message(cloud, store, package, stamp)
            writer.write(connection, stamp, write(made, name))
    return path
