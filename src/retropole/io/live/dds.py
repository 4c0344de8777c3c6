"""Point clouds that ROS 2 publishes now, by DDS, without a ROS installation (the extra ``live``).

A sweep of 100,000 points has 2 MB. As Python numbers they take some 0.2 s to decode; here the bytes
of a message stay as they came (CDR), and NumPy has the points from where they lie.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

from ...base.errors import MissingExtraError, UsageError, said
from ..fields import NANOSECONDS, USUAL, Wanted
from ..recordings import CLOUDS, Frame
from ..ros import frame_of
from .replay import QUIET

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant

MOST_DOMAIN = 232
"""Of the numbers of a domain, the largest: ports follow from it."""


def domain_or_default(domain: int | None) -> int:
    """Use a given domain, or that of the environment as in ROS 2, or 0.

    Raises
    ------
    UsageError
        If there is no such number.
    """
    given = os.environ.get("ROS_DOMAIN_ID", "") if domain is None else str(domain)
    digits = (given or "0").lstrip("0") or "0"
    is_short = digits.isascii() and digits.isdigit() and len(digits) <= len(str(MOST_DOMAIN))
    number = int(digits) if is_short else -1
    if not 0 <= number <= MOST_DOMAIN:
        raise UsageError(
            f"domain {given!r} is not a domain: a whole number from 0 to {MOST_DOMAIN}"
        )
    return number


@cache
def participant(domain: int, interface: str | None = None) -> DomainParticipant:
    """Join a domain, by one network interface or as the environment has it (CYCLONEDDS_URI).

    Raises
    ------
    MissingExtraError
        If cyclonedds is not installed.
    UsageError
        If there is no such interface, or DDS cannot use it.
    """
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
    except ImportError:
        raise MissingExtraError("live", "talking to ROS 2") from None
    there = [name for _, name in socket.if_nameindex()]
    if interface is not None and interface not in there:
        raise UsageError(f"there is no network interface {interface!r}, only {', '.join(there)}")
    try:
        config = _configured(domain, interface)
        if config is not None:
            _domains.append(Domain(domain, config))
        return DomainParticipant(domain)
    except DDSException as error:
        raise UsageError(f"cannot join domain {domain} of DDS: {said(error)}") from None


_domains: list[Any] = []
"""What is configured stays so for as long as the program runs."""


def _configured(domain: int, interface: str | None) -> str | None:
    """Write what differs from the defaults of DDS; None if the environment says it all."""
    if interface is None and os.environ.get("CYCLONEDDS_URI"):
        return None
    networks = discovery = ""
    if interface is not None:
        networks = (
            f'<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces></General>'
        )
        if interface.startswith("lo"):
            # It knows no multicast, so those that are there have to be contacted one by one.
            discovery = (
                "<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>"
                '<Peer address="127.0.0.1"/></Peers></Discovery>'
            )
    # A sweep comes as a thousand packets at once.
    buffer = '<Internal><SocketReceiveBufferSize min="default" max="10MB"/></Internal>'
    return f'<CycloneDDS><Domain Id="{domain}">{networks}{discovery}{buffer}</Domain></CycloneDDS>'


class Raw:
    """A message as the bytes of its CDR."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sample_info: Any = None
        """Set by a reader: when and by whom it was sent."""


@cache
def message_type(name: str) -> Any:
    """Make the type of a message of ROS 2 whose bytes stay as they are: as `Raw`.

    Parameters
    ----------
    name
        ``sensor_msgs/msg/PointCloud2``.
    """
    kind = _idl(name)
    kind.deserialize = classmethod(lambda cls, data, **options: Raw(data))
    kind.serialize = lambda message, **options: message.data
    return kind


def message_of(name: str, data: bytes) -> Any:
    """Make a message for a writer of the bytes of its CDR."""
    message = object.__new__(message_type(name))
    message.data = data
    return message


@cache
def _idl(name: str) -> Any:
    """Make the type of a message as DDS knows it, from its definition in rosbags."""
    from cyclonedds.idl import make_idl_struct, types
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    def of(node: Any) -> Any:
        sort, what = node
        if sort == Nodetype.NAME:
            return _idl(what)
        if sort == Nodetype.SEQUENCE:
            sequence: Any = types.sequence
            return sequence[of(what[0])]
        base = what[0]
        return {"string": str, "bool": bool}.get(base) or getattr(types, base)

    store: Any = get_typestore(Stores.LATEST)
    # Before rosbags 0.11 it has capitals.
    known = store.fielddefs if hasattr(store, "fielddefs") else store.FIELDDEFS
    _, fields = known[name]
    short = f"{name.rpartition('/')[2]}_"
    return make_idl_struct(short, dds_name(name).replace("::", "."), {n: of(t) for n, t in fields})


def dds_name(name: str) -> str:
    """Name a type of ROS 2 as DDS does: ``sensor_msgs::msg::dds_::PointCloud2_``."""
    package, _, short = name.partition("/msg/")
    return f"{package}::msg::dds_::{short}_"


def _clock_of(data: bytes) -> float:
    """Time at which a message was made, by its header, s."""
    order = "<" if data[1] % 2 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return float(seconds) + float(nanoseconds) / NANOSECONDS


class DdsSource:
    """A topic of point clouds of ROS 2; see `Source`.

    Parameters
    ----------
    topic
        As ROS names it: ``/front/points``.
    domain, interface
        As `domain_or_default` and `participant` take them.
    wanted
        Field of the intensity.

    Raises
    ------
    MissingExtraError, UsageError
        As these.
    """

    def __init__(
        self,
        topic: str,
        *,
        domain: int | None = None,
        interface: str | None = None,
        wanted: Wanted = USUAL,
    ) -> None:
        self._wanted = wanted
        self._topic = f"/{topic.strip('/')}"
        self._domain = domain_or_default(domain)
        self._participant = participant(self._domain, interface)
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.topic import Topic

        self._published = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._clouds = Topic(self._participant, f"rt{self._topic}", message_type(CLOUDS))
        self._reader: Any = None
        self._reliable: bool | None = None
        self._waiting: Any = None
        self._count, self._last = 0, -float("inf")
        self.name = f"ros2:{self._topic}"
        self.has_ended = False

    @property
    def waits_for(self) -> str:
        """See `Source`."""
        if time.monotonic() - self._last < QUIET:
            return ""
        there = self._publications()
        own = [kind for name, kind, _ in there if name == self._topic]
        if not own:
            gone = "no longer " if self._count else "not "
            others = sorted({name for name, kind, _ in there if kind == dds_name(CLOUDS)})
            state = f"{self._topic} is {gone}published in domain {self._domain}"
            return f"{state}; clouds are on: {', '.join(others) or 'no topic'}"
        if dds_name(CLOUDS) not in own:
            return f"{self._topic} is of {own[0]}, expected {dds_name(CLOUDS)}"
        return f"{self._topic} has a publisher, but no message arrives"

    def _publications(self) -> list[tuple[str, str, bool]]:
        """Name, type and reliability of all that is published now."""
        from cyclonedds.core import InstanceState, Policy, ReadCondition, SampleState, ViewState

        alive = ReadCondition(
            self._published, ViewState.Any | InstanceState.Alive | SampleState.Any
        )
        found = []
        for each in self._published.read(10_000, alive):
            if each.topic_name.startswith("rt/"):
                reliability = each.qos[Policy.Reliability]
                is_reliable = isinstance(reliability, Policy.Reliability.Reliable)
                found.append((each.topic_name[2:], each.type_name, is_reliable))
        return found

    def _listen(self) -> None:
        """Listen as reliably as what is published lets; anew where that has changed."""
        own = self._topic, dds_name(CLOUDS)
        offered = [reliable for *what, reliable in self._publications() if tuple(what) == own]
        if not offered or all(offered) == self._reliable:
            return
        from cyclonedds.core import (
            InstanceState,
            Policy,
            Qos,
            ReadCondition,
            SampleState,
            ViewState,
            WaitSet,
        )
        from cyclonedds.sub import DataReader

        self._reliable = all(offered)
        reliability = (
            Policy.Reliability.Reliable(int(NANOSECONDS))
            if self._reliable
            else Policy.Reliability.BestEffort
        )
        # Only the newest is wanted; one that is late shall not hold up those after it.
        qos = Qos(reliability, Policy.History.KeepLast(1), Policy.Durability.Volatile)
        self._reader = DataReader(self._participant, self._clouds, qos=qos)
        self._waiting = WaitSet(self._participant)
        unread = ViewState.Any | InstanceState.Any | SampleState.NotRead
        self._waiting.attach(ReadCondition(self._reader, unread))

    def newest(self, wait: float) -> Frame | None:
        """See `Source`."""
        end = time.monotonic() + wait
        if time.monotonic() - self._last > QUIET:
            self._listen()
        if self._waiting is None:
            time.sleep(min(wait, 0.1))
            return None
        while True:
            left = max(end - time.monotonic(), 0.0)
            self._waiting.wait(int(left * NANOSECONDS))
            taken = [each for each in self._reader.take(1) if isinstance(each, Raw)]
            if taken:
                break
            if left <= 0.0:
                return None
        self._last = time.monotonic()
        number, self._count = self._count, self._count + 1
        now, data = time.time_ns(), taken[-1].data
        frame = frame_of("", self.name, number, now, data, "cdr", wanted=self._wanted)
        delay = _clock_of(data) - now / NANOSECONDS
        # A sweep takes 0.1 s, and its way some.
        if abs(delay) < 1.0:
            return frame
        way = "ahead of" if delay > 0 else "behind"
        note = f"its stamps are {abs(delay):.3g} s {way} the clock of this computer"
        return replace(frame, cloud=replace(frame.cloud, notes=(note,)))

    def close(self) -> None:
        """See `Source`."""
        self._reader = self._waiting = None
        self.has_ended = True
