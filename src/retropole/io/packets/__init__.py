"""Packets as a sensor sends them, in captures and in bags of what drivers publish.

Which LiDAR sent them is recognized from the packets. Frames are sweeps; the first and the last may
be incomplete.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, IntArray
from ...base.errors import ReadError, UsageError, naming, reported
from ...base.quantities import counted
from ..bags import opened
from ..fields import USUAL, Columns, Wanted, frame_from_columns, noted
from ..recordings import PACKETS_OF, Frame, Recording, Topic, is_unix
from . import drivers
from .angles import read_angles, reported_angles
from .capture import (
    PCAPNG_START,
    Capture,
    Datagram,
    SimilarPackets,
    similar_packets,
    sizes_in_words,
    stacks_of,
    walk,
)
from .interpolated import DIFOP_START
from .models import Angles, Model, recognized, unknown
from .ouster import OUSTER, find_metadata, model_named, sweeps_of_capture
from .sweeps import AT_ONCE, Sweep, index_of, positions_of, stacked, sweeps_of
from .velodyne import is_velodyne, model_of, velodyne_sweeps

VELODYNE = "Velodyne"


@dataclass
class Sender:
    """What one LiDAR sent.

    Attributes
    ----------
    title, name
        Maker and model; what ``sensors.toml`` calls it, where it is in there.
    model
        Its table; None of a Velodyne.
    size
        Bytes of its packets; those of another size it has not sent.
    rows, times
        Its packets, by their numbers in the recording; when each came, by the recorder's clock, s.
    angles, identified
        Those of the unit, if a packet reported them, and how many packets report on it.
    """

    title: str
    name: str
    model: Model | None
    size: int
    rows: array[int] = field(default_factory=lambda: array("q"))
    times: array[float] = field(default_factory=lambda: array("d"))
    angles: Angles | None = None
    identified: int = 0


Reading = Callable[[IntArray], Iterator[NDArray[np.uint8]]]
"""From ascending numbers of packets that one LiDAR sent to these packets, some together."""


def open_packets(path: Path, topic: str | None = None, wanted: Wanted = USUAL) -> Recording:
    """Recognize the sensor of a capture, and find its sweeps, which takes a pass through it.

    Parameters
    ----------
    path
        A capture.
    topic
        ``IP:port`` of the sender; needed where several LiDARs sent.
    wanted
        The angles of the unit, and the field of the intensity.

    Raises
    ------
    MissingExtraError
        If the extra for the sensor is not installed.
    ReadError
        If the file is not a capture of such packets, or an Ouster's metadata are missing; where
        not exactly one sender fits.
    UsageError
        If a topic or angles are given, and the packets are of none that has these.
    """
    with naming(path), reported("capture"):
        capture = walk(path)
    senders, starts = _surveyed(path, capture)
    if not senders:
        fault = (
            f"{path}: has no packets of the known LiDARs; topic and angles can be given only for "
            "these"
        )
        wanted.refuse_angles(fault)
        if topic is not None:
            raise UsageError(fault)
        return _of_ouster(path, capture, wanted)
    name = _chosen(path, senders, topic)
    # Of a damaged packet nothing shows who sent it, but that it is as long as others.
    known = sum(len(each.rows) + each.identified for each in senders.values())
    length = capture.records[senders[name].rows[0], 1]
    similar_packets = int(np.count_nonzero(capture.records[:, 1] == length))
    unreadable = max(similar_packets - known, 0) if len(senders) == 1 else 0
    is_plain = len(senders) == 1 and not unreadable and not len(capture.gaps)
    with path.open("rb") as file:
        is_plain &= file.read(4) != PCAPNG_START
    note = capture.note(unreadable)
    size = senders[name].size

    def read(rows: IntArray) -> Iterator[NDArray[np.uint8]]:
        return stacks_of(path, starts[rows], size)

    recording = _recording(path, senders[name], read, wanted, (note,), is_whole_file=is_plain)
    return replace(recording, topic=name) if len(senders) > 1 else recording


def _surveyed(path: Path, capture: Capture) -> tuple[dict[str, Sender], IntArray]:
    """Survey a capture; besides, where the payload of each packet begins in the file."""
    starts = np.zeros(len(capture.records), np.int64)

    def coming() -> Iterator[SimilarPackets]:
        for each in similar_packets(path, capture, _marks):
            starts[list(each.rows)] = each.starts
            yield each

    senders, _ = survey(coming())
    return senders, starts


def _marks(payload: bytes) -> list[slice] | None:
    """Name the parts of a payload by which its model is recognized; None if none is."""
    model = recognized(payload)
    return None if model is None else [where for where, _, _ in model.signature]


def packets_in(path: Path, topic: Topic, wanted: Wanted = USUAL) -> Recording:
    """Open a topic of a bag on which a driver publishes packets.

    Raises
    ------
    MissingExtraError, ReadError
        As `open_packets`.
    """

    def every() -> Iterator[Datagram]:
        with opened(path) as bag:
            yield from drivers.datagrams(bag.messages(topic.name, topic.kind), topic.kind)

    def read(rows: IntArray) -> Iterator[NDArray[np.uint8]]:
        chosen = set(rows.tolist())
        coming = (each.payload for row, each in enumerate(every()) if row in chosen)
        left = len(rows)
        while left and (part := list(islice(coming, min(left, AT_ONCE)))):
            left -= len(part)
            yield stacked(part)

    alone = (SimilarPackets(each, (row,), (each.time,)) for row, each in enumerate(every()))
    senders, sizes = survey(alone)
    if not senders:
        raise ReadError(f"{path}: topic {topic.name} has {unknown(sizes)}")
    # A bag does not say who sent what: the LiDAR is the one with most packets.
    sender = max(senders.values(), key=lambda each: len(each.rows))
    return replace(_recording(path, sender, read, wanted, ()), topic=topic.name)


def topics_of_capture(path: Path) -> tuple[Topic, ...]:
    """List the LiDARs of a capture as topics, ``IP:port``, where there are several."""
    with naming(path), reported("capture"):
        capture = walk(path)
    senders, _ = _surveyed(path, capture)
    topics = tuple(
        Topic(name, f"{PACKETS_OF}{own.title}", len(own.rows)) for name, own in senders.items()
    )
    return topics if len(topics) > 1 else ()


def survey(coming: Iterator[SimilarPackets]) -> tuple[dict[str, Sender], Counter[int]]:
    """Find which LiDARs sent packets, and count the sizes of all other packets."""
    senders: dict[str, Sender] = {}
    sizes: Counter[int] = Counter()
    reported: dict[str, bytes] = {}
    identifying = Counter[str]()
    for (payload, name, _), rows, times, _ in coming:
        own = senders.get(name)
        model = recognized(payload)
        if model is None and not is_velodyne(payload):
            sizes[len(payload)] += 1
            identifying[name.partition(":")[0]] += payload.startswith(DIFOP_START)
            if payload and len(reported) < 100:
                reported.setdefault(f"{name.partition(':')[0]} {payload[:2].hex()}", payload)
            continue
        if own is None:
            own = senders[name] = _sender(model, payload)
        if len(payload) == own.size and (model is None) == (own.model is None):
            own.rows.frombytes(np.asarray(rows, np.int64).tobytes())
            own.times.frombytes(np.asarray(times, np.float64).tobytes())
    for name, own in senders.items():
        found = (
            reported_angles(own.model, payload)
            for key, payload in reported.items()
            if own.model is not None and key.partition(" ")[0] == name.partition(":")[0]
        )
        own.identified = identifying[name.partition(":")[0]]
        own.angles = next((each for each in found if each is not None), None)
    # A damaged address or port looks like another LiDAR, which sends next to nothing.
    most = max((len(own.rows) for own in senders.values()), default=0)
    return {name: own for name, own in senders.items() if len(own.rows) > most / 1000}, sizes


def _sender(model: Model | None, payload: bytes) -> Sender:
    if model is not None:
        return Sender(model.title, model.sensor or model.title, model, len(payload))
    name = model_of(payload)
    title = f"{VELODYNE} {name}".rstrip()
    return Sender(title, name or title, None, len(payload))


def _chosen(path: Path, senders: dict[str, Sender], topic: str | None) -> str:
    listed = ", ".join(
        f"{name} ({own.title}, {counted(len(own.rows), 'packet')})"
        for name, own in islice(senders.items(), 10)
    )
    if topic is not None and topic not in senders:
        raise ReadError(f"{path}: no LiDAR sends from {topic}; the senders are: {listed}")
    if topic is None and len(senders) > 1:
        raise ReadError(f"{path}: has packets of {len(senders)} LiDARs, name one of them: {listed}")
    return topic or next(iter(senders))


def _recording(
    path: Path,
    sender: Sender,
    read: Reading,
    wanted: Wanted,
    notes: tuple[str, ...],
    *,
    is_whole_file: bool = False,
) -> Recording:
    """Open what one LiDAR sent."""
    rows, times = np.array(sender.rows, np.int64), np.array(sender.times, np.float64)
    order = np.argsort(rows, kind="stable")
    rows, times = rows[order], times[order]
    if sender.model is None:
        wanted.refuse_angles(f"{path}: angles of a {sender.title} are known, others do not apply")

        def coming() -> Iterator[Datagram]:
            payloads = (each.tobytes() for stack in read(rows) for each in stack)
            return (Datagram(each, "", at) for each, at in zip(payloads, times, strict=False))

        return _decoded(
            path,
            lambda: velodyne_sweeps(path, None if is_whole_file else coming),
            sender.name,
            wanted,
            sizes=f"{sender.size} bytes",
            notes=notes,
        )
    model = sender.model
    angles = wanted.angles
    own = sender.angles if angles is None else read_angles(Path(angles), model)

    index = index_of(model, positions_of(model, read(rows)), own)

    def frames(numbers: range) -> Iterator[Frame]:
        some = sweeps_of(model, own, index, numbers, lambda chosen: read(rows[chosen]))
        for number, sweep in some:
            came = float(times[int(index.rows[number][0])])
            sweep = sweep._replace(stamp=came if is_unix(came) else None)
            frame = _frame(path, number, sweep, sender.name, notes, wanted)
            yield replace(frame, clock=_clock_of(model, frame))

    return Recording(path, len(index.rows), frames, model=sender.name)


def _decoded(
    path: Path,
    sweeps: Callable[[], Iterator[Sweep]],
    name: str,
    wanted: Wanted,
    *,
    sizes: str,
    notes: tuple[str, ...],
) -> Recording:
    """Open packets that the library of a maker decodes, which is to count their sweeps, too."""
    count = sum(1 for _ in sweeps())
    if not count:
        raise ReadError(f"{path}: has no sweep, its packets have {sizes}")

    def frames(numbers: range) -> Iterator[Frame]:
        for number, sweep in enumerate(sweeps()):
            if number in numbers:
                yield _frame(path, number, sweep, name, notes, wanted)
            if number == numbers[-1]:
                return

    return Recording(path, count, frames, model=name)


def _frame(
    path: Path, number: int, sweep: Sweep, name: str, notes: tuple[str, ...], wanted: Wanted
) -> Frame:
    where = f"{path}: sweep {number}"
    with naming(where), reported("sweep"):
        own = sweep.columns()
    cloud = noted(frame_from_columns(where, own, wanted, sweep.origin), *notes, *sweep.notes)
    stamp = _first(own) if sweep.stamp is None else sweep.stamp
    # A maker alone says less than the rings of the cloud.
    model = "" if name in (VELODYNE, OUSTER) else name
    cloud = replace(cloud, model=model, nominal_angles=sweep.nominal_angles)
    return Frame(number, cloud, stamp)


def _clock_of(model: Model, frame: Frame) -> float | None:
    """When a sweep began by the clock of the LiDAR; None if packets do not say which second."""
    time, layout = frame.cloud.time, model.layout
    if time is None or not len(time) or getattr(layout, "clock", "") == "microseconds":
        return None
    return float(time.min())


def _first(columns: Columns) -> float | None:
    time: Array = columns["time"]
    return float(time.min()) if len(time) else None


def _of_ouster(path: Path, capture: Capture, wanted: Wanted) -> Recording:
    """Open a capture of an Ouster, whose metadata describe the layout of its packets."""
    sizes = sizes_in_words(capture)
    metadata = find_metadata(path, sizes)
    note = capture.note(0)
    read = partial(sweeps_of_capture, path, metadata)
    with naming(metadata), reported("file of an Ouster's metadata"):
        name = model_named(metadata)
    return _decoded(path, read, name, wanted, sizes=sizes, notes=(note,))
