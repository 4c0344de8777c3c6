"""Clouds and transforms as messages of ROS 2: both clouds as an MCAP file, ``/tf_static`` by DDS.

Foxglove and RViz draw the file (the extra ``ros``) as it is: each cloud is in the frame of its
LiDAR, and ``/tf_static`` places the frames. The types are those of ROS 2 Humble, which later ones
have kept. To publish takes no ROS (the extra ``live``).
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, PointCloud
from ..base.errors import MissingExtraError
from ..io import Frame, ReadRecording
from ..io.fields import NANOSECONDS, records_of
from ..io.live.dds import domain_or_default, message_of, message_type, participant
from ..io.recordings import CLOUDS
from ..io.ros import DATATYPES
from .transform import Transform, to_quaternion

TOPICS = {"target": "/target/points", "source": "/source/points"}
"""Where the clouds are, by what their LiDAR is in the calibration; the names of frames may be
anything, those of topics may not."""

TRANSFORMS, TRANSFORM_TOPIC = "tf2_msgs/msg/TFMessage", "/tf_static"

_LATCHED = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: 1
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""
"""Keep last, reliable, transient local: who listens to ``/tf_static`` late gets it all the same,
also by ``ros2 bag play``."""


class Track(NamedTuple):
    """What is recorded on one topic: the name of its frame, and clouds in it."""

    frame: str
    frames: Sequence[Frame]


def frames_of(read: ReadRecording) -> list[Frame]:
    """Split a cloud into the frames that it was read from, those with points."""
    number = read.cloud.frame
    if number is None:
        return [Frame(0, read.cloud, read.headers[0].stamp)]
    parts = ((header, number == header.number) for header in read.headers)
    return [
        Frame(header.number, read.cloud.select(own), header.stamp)
        for header, own in parts
        if own.any()
    ]


def write_mcap(transform: Transform, target: Sequence[Frame], source: Sequence[Frame]) -> bytes:
    """Write both LiDARs' frames, each in that LiDAR's frame, and the transform between them.

    Coordinates and intensities are float32 where that loses nothing, else float64. Messages have
    the times of recording where both recordings have them; else they start at zero.

    Parameters
    ----------
    transform
        Its `roles` say which frame is whose.
    target, source
        Frames of the clouds, in the frames of their LiDARs, metres.

    Returns
    -------
    bytes
        An MCAP file of the profile ``ros2``: `TOPICS` and ``/tf_static``.

    Raises
    ------
    MissingExtraError
        Where mcap or rosbags is not installed.
    """
    names = dict(zip(transform.roles, (transform.parent, transform.child), strict=True))
    clouds = {"target": list(target), "source": list(source)}
    tracks = {TOPICS[role]: Track(names[role], clouds[role]) for role in TOPICS}
    return _write([transform], tracks, transform.verdict)


def write_recording(tracks: Mapping[str, Track]) -> bytes:
    """Write the frames of some topics, and no transform.

    Raises
    ------
    MissingExtraError
        Where mcap or rosbags is not installed.
    """
    return _write([], tracks, "")


def write_transforms(transforms: Sequence[Transform], verdict: str = "") -> bytes:
    """Write transforms alone, as one message on ``/tf_static`` at time zero.

    The verdict of their calibration is written as metadata.

    Played or opened next to a recording of the LiDARs, it places their frames.

    Raises
    ------
    MissingExtraError
        Where mcap or rosbags is not installed.
    """
    return _write(transforms, {}, verdict)


def _write(transforms: Sequence[Transform], tracks: Mapping[str, Track], verdict: str) -> bytes:
    """Write transforms, then the frames of all tracks in the order of their times."""
    times = _times({topic: track.frames for topic, track in tracks.items()})
    file = io.BytesIO()
    clouds = [
        (when, topic, frame.cloud)
        for topic, track in tracks.items()
        for when, frame in zip(times[topic], track.frames, strict=True)
    ]
    first = min((min(own) for own in times.values()), default=0)
    frames = {topic: track.frame for topic, track in tracks.items()}
    metadata = {"verdict": verdict} if verdict else {}
    with cloud_stream(file, frames, metadata, transforms, first) as write:
        for when, topic, cloud in sorted(clouds, key=itemgetter(0)):
            write(topic, when, records_of_sweep(cloud))
    return file.getvalue()


@contextmanager
def cloud_stream(
    file: BinaryIO,
    frames: Mapping[str, str],
    metadata: Mapping[str, str],
    transforms: Sequence[Transform] = (),
    first: int = 0,
) -> Iterator[Callable[[str, int, NDArray[Any]], None]]:
    """Write an MCAP file message by message.

    Parameters
    ----------
    file
        Where to.
    frames
        The frame of the clouds on each topic.
    metadata
        By name, under ``retropole``; none where it is empty.
    transforms, first
        What is written on ``/tf_static``, at which time, ns.

    Yields
    ------
    Callable
        Writes a record of each point, by its topic and its time, ns.

    Raises
    ------
    MissingExtraError
        Where mcap or rosbags is not installed.
    """
    try:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("ros", "writing MCAP files") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer: Any = Writer(file)
    writer.start(profile="ros2", library="retropole")
    if metadata:
        writer.add_metadata("retropole", dict(metadata))
    kinds = [CLOUDS] * bool(frames) + [TRANSFORMS] * bool(transforms)
    schemas = {
        kind: writer.register_schema(
            kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode()
        )
        for kind in kinds
    }

    def channel(topic: str, kind: str, qos: str = "") -> int:
        about = {"offered_qos_profiles": qos}
        return int(writer.register_channel(topic, "cdr", schemas[kind], about))

    def add(number: int, kind: str, when: int, message: Any) -> None:
        data = bytes(store.serialize_cdr(message, kind))
        writer.add_message(number, when, data, when)

    if transforms:
        poses = channel(TRANSFORM_TOPIC, TRANSFORMS, _LATCHED)
        add(poses, TRANSFORMS, first, transform_message(transforms, first, store))
    numbers = {topic: channel(topic, CLOUDS) for topic in frames}

    def write(topic: str, when: int, points: NDArray[Any]) -> None:
        add(numbers[topic], CLOUDS, when, _cloud_message(points, frames[topic], when, store))

    yield write
    writer.finish()


def _times(clouds: Mapping[str, Sequence[Frame]]) -> dict[str, list[int]]:
    """Give the time of each frame, ns; one clock for all, so all or none by the recorder's."""
    stamps = {topic: [frame.stamp for frame in frames] for topic, frames in clouds.items()}
    # ROS 2 has no time from 2^31 s on.
    if not all(s is not None and 0 <= s < 2**31 for own in stamps.values() for s in own):
        # LiDARs turn ten times a second, mostly.
        stamps = {name: [k * 0.1 for k in range(len(own))] for name, own in stamps.items()}
    return {name: [round((s or 0.0) * NANOSECONDS) for s in own] for name, own in stamps.items()}


def _header(frame: str, when: int, store: Any) -> Any:
    seconds, nanoseconds = divmod(when, int(NANOSECONDS))
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def transform_message(transforms: Sequence[Transform], when: int, store: Any) -> Any:
    """Write transforms as a message of ``/tf_static`` at a time, ns."""
    vector, quaternion, pose, stamped = (
        store.types[f"geometry_msgs/msg/{name}"]
        for name in ("Vector3", "Quaternion", "Transform", "TransformStamped")
    )
    messages = []
    for each in transforms:
        T = each.T_parent_child
        translation = vector(*T[:3, 3].tolist())
        rotation = quaternion(*to_quaternion(T).tolist())
        header = _header(each.parent, when, store)
        messages.append(stamped(header, each.child, pose(translation, rotation)))
    return store.types[TRANSFORMS](messages)


def _cloud_message(points: NDArray[Any], frame: str, when: int, store: Any) -> Any:
    """Write x, y, z and what else is known of each point; one row, without padding."""
    numbers = {kind: number for number, kind in DATATYPES.items()}
    fields = [
        store.types["sensor_msgs/msg/PointField"](
            name=name, offset=offset, datatype=numbers[kind.str[1:]], count=1
        )
        for name, (kind, offset, *_) in (points.dtype.fields or {}).items()
    ]
    return store.types[CLOUDS](
        header=_header(frame, when, store),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def records_of_sweep(cloud: PointCloud) -> NDArray[Any]:
    """Make a record of each point, in the names that the readers know."""
    xyz = _smallest_floats(cloud.xyz)
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", xyz.T, strict=True))
    if cloud.intensity is not None:
        columns["intensity"] = _smallest_floats(cloud.intensity)
    if cloud.ring is not None:
        is_short = len(cloud.ring) == 0 or (cloud.ring.min() >= 0 and cloud.ring.max() < 2**16)
        columns["ring"] = cloud.ring.astype(np.uint16 if is_short else np.float64)
    if cloud.time is not None:
        columns["timestamp"] = cloud.time
    return records_of(columns)


def _smallest_floats(values: Array) -> NDArray[Any]:
    short = values.astype(np.float32)
    return short if np.array_equal(short, values) else values


@dataclass(eq=False)
class Published:
    """What is published, for as long as this is kept: late subscribers receive it all the same."""

    writer: Any

    def withdraw(self) -> None:
        """Publish it no longer: who comes from now on does not get it.

        Who listens already keeps it until it starts again: tf2 forgets no static transform.
        """
        self.writer = None


def check_publishing(*, domain: int | None = None, interface: str | None = None) -> None:
    """Join the domain, so that `publish` finds nothing missing when there is an answer.

    Raises
    ------
    MissingExtraError, UsageError
        As `publish`.
    """
    participant(domain_or_default(domain), interface)


def publish(
    transforms: Sequence[Transform], *, domain: int | None = None, interface: str | None = None
) -> Published:
    """Publish transforms on ``/tf_static``, reliably and for those who come late.

    Parameters
    ----------
    transforms
        All that this program publishes there.
    domain, interface
        As `io.live.dds.DdsSource` takes them.

    Raises
    ------
    MissingExtraError
        If cyclonedds is not installed.
    UsageError
        Where DDS cannot be used.
    """
    own = participant(domain_or_default(domain), interface)
    from cyclonedds.core import Policy, Qos
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    message = transform_message(transforms, time.time_ns(), store)
    qos = Qos(
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(1),
    )
    writer = DataWriter(own, Topic(own, f"rt{TRANSFORM_TOPIC}", message_type(TRANSFORMS)), qos=qos)
    writer.write(message_of(TRANSFORMS, bytes(store.serialize_cdr(message, TRANSFORMS))))
    return Published(writer)


def cloud_publisher(
    topic: str, frame: str, *, domain: int | None = None, interface: str | None = None
) -> Callable[[NDArray[Any], float], None]:
    """Publish clouds on a topic, reliably; who is slow gets the newest alone.

    Parameters
    ----------
    topic, frame
        As ROS names them: ``/merged/points``, and the frame of the points.
    domain, interface
        As `io.live.dds.DdsSource` takes them.

    Returns
    -------
    Callable
        Publishes a record of each point, and when they were measured, Unix seconds.

    Raises
    ------
    MissingExtraError, UsageError
        As `publish`.
    """
    own = participant(domain_or_default(domain), interface)
    from cyclonedds.core import Policy, Qos
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    qos = Qos(Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(1))
    topic = f"/{topic.strip('/')}"
    writer = DataWriter(own, Topic(own, f"rt{topic}", message_type(CLOUDS)), qos=qos)

    def write(points: NDArray[Any], when: float) -> None:
        message = _cloud_message(points, frame, round(when * NANOSECONDS), store)
        writer.write(message_of(CLOUDS, bytes(store.serialize_cdr(message, CLOUDS))))

    return write
