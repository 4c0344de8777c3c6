"""Packets that a sensor sends to a port of this computer.

They are decoded like those of a capture (`io.packets`). A thread receives them, since the system's
buffer for a program is smaller than a sweep.
"""

from __future__ import annotations

import errno
import socket
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from ipaddress import ip_address
from pathlib import Path
from threading import Condition, Event, Lock, Thread
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...base.errors import MissingExtraError, UsageError, naming, reported, said, shortened
from ...base.quantities import counted
from ..fields import frame_from_columns
from ..packets.angles import read_angles, reported_angles
from ..packets.interpolated import DIFOP_START
from ..packets.models import MODELS, Angles, Model, recognized
from ..packets.ouster import ouster_sweeps
from ..packets.sweeps import Sweep, live
from ..packets.velodyne import VELODYNE_SIZE, VELODYNE_START, velodyne_sweep
from ..recordings import Frame, is_unix
from .replay import QUIET

ALL_INTERFACES = "0.0.0.0"
"""Address to listen on by default: sensors send from the network. Broadcast packets, the default of
a Velodyne, reach this address only."""

PAUSE = 2.0
"""Seconds without a packet after which a sensor has stopped: then another one is used, and the
same one begins a new sweep."""

WINDOW, FEWEST = 0.1, 10
"""Packets of the senders are counted over this many seconds. A sender of fewer is not a sensor,
which sends 30 and more: the busiest of all is used instead."""

LOOK = 0.2
"""Interval, s, at which the thread checks whether it is to end."""

Decoder = Callable[[bytes, float], Sweep | None]
"""Called with a packet and its time of arrival, Unix seconds; returns the sweep that it completes.
"""


class _Kind(NamedTuple):
    """A kind of sensor.

    Attributes
    ----------
    maker, expected
        Its name, and a description of its packets.
    misfit
        Description of a packet that is not of this kind; empty if it is.
    decoder
        Starts with the first packet of a sweep, or in the middle of one.
    """

    maker: str
    expected: str
    misfit: Callable[[bytes], str]
    decoder: Callable[[], Decoder]


class _Came(NamedTuple):
    """A received sweep, and notes on it."""

    sweep: Sweep
    received: float
    sender: str
    notes: tuple[str, ...]


class _Mailbox:
    """Hands the newest sweep from the thread that receives to the one that calibrates.

    A sweep that was not read before the next arrived is dropped.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._held: tuple[int, _Came] | None = None
        self._count = 0
        self._is_closed = False

    def put(self, item: _Came) -> None:
        """Replace the previous sweep."""
        with self._changed:
            self._held = self._count, item
            self._count += 1
            self._changed.notify_all()

    def take(self, wait: float) -> tuple[int, _Came] | None:
        """Take the newest sweep and its number, counted from 0; None if none arrived in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._held is not None or self._is_closed, wait)
            buffered, self._held = self._held, None
            return buffered

    def close(self) -> None:
        """Wake whoever waits, and forget what is buffered."""
        with self._changed:
            self._held, self._is_closed = None, True
            self._changed.notify_all()


class PacketSource:
    """A sensor that sends packets to a port: base of `VelodyneSource` and others.

    The packets of one sender are used, since two sensors that send to one port would be mixed
    up otherwise: the first whose packets fit, until it has stopped for `PAUSE`; and the busiest
    instead of one that sends too few for a sensor.

    Parameters
    ----------
    port, host
        Where to listen.
    kind
        Of sensor.
    senders
        IP addresses whose packets are used; empty for any.

    Raises
    ------
    UsageError
        If a sender is not an IP address, or the port cannot be opened.
    """

    has_ended = False

    def __init__(self, port: int, host: str, kind: _Kind, senders: Collection[str] = ()) -> None:
        address = "" if host == ALL_INTERFACES else f"{host}:"
        self.name = f"{kind.maker.lower()}:{address}{port}"
        self._port, self._kind = port, kind
        self._senders = {_address(each) for each in senders}
        self._socket = _opened(port, host)
        self._mailbox = _Mailbox()
        self._closed = Event()
        self._lock = Lock()
        self._sender: tuple[str, int] | None = None
        # Number of packets from each sender, and since when.
        self._counts: Counter[tuple[str, int]] = Counter()
        self._counted_from = -np.inf
        self._decoder: Decoder | None = None
        self._last_packet = self._last_sweep = -np.inf
        # Of the packets since the last sweep.
        self._taken = 0
        self._wrong: Counter[str] = Counter()
        self._others, self._other = 0, ("", 0)
        self._thread = Thread(target=self._receive, name=self.name, daemon=True)
        self._thread.start()

    @property
    def waits_for(self) -> str:
        """In words why no sweep arrives: what was received instead."""
        now = time.monotonic()
        with self._lock:
            if now - self._last_sweep < QUIET:
                return ""
            wrong = self._wrong_in_words()
            if self._sender is None:
                taken = "" if wrong else "no packet received"
            elif now - self._last_packet >= PAUSE:
                taken = f"{_named(self._sender)} sends no more packets"
            else:
                taken = f"{counted(self._taken, 'packet')} of {_named(self._sender)}, no sweep"
            others = self._left_out(counted(self._others, "packet")) if self._others else ""
        return f"port {self._port}: {'; '.join(filter(None, (taken, wrong, others)))}"

    def _left_out(self, packets: str) -> str:
        if self._senders:
            return f"{packets} of {_named(self._other)} left out, since --from gives another sender"
        other = f"{packets} of {_named(self._other)} left out, since one sensor is read"
        return f"{other}; --from ADDRESS names it"

    def _wrong_in_words(self) -> str:
        if not self._wrong:
            return ""
        came = " and ".join(size for size, _ in self._wrong.most_common(3))
        return (
            f"{counted(self._wrong.total(), 'packet')} received, none of a {self._kind.maker}: "
            f"{self._kind.expected} expected, {came} came"
        )

    def newest(self, wait: float) -> Frame | None:
        """Give the newest whole sweep, as `Source` says."""
        taken = self._mailbox.take(wait)
        if taken is None:
            return None
        number, (sweep, received, sender, notes) = taken
        where = f"port {self._port}: sweep {number}"
        with naming(where), reported("sweep"):
            own = sweep.columns()
        cloud = frame_from_columns(where, own, origin=sweep.origin)
        # The clock of a sensor that was never set starts when it is switched on.
        is_known = sweep.stamp is not None and is_unix(sweep.stamp)
        stamp = sweep.stamp if is_known else received
        cloud = replace(
            cloud,
            notes=(*notes, *sweep.notes),
            model=sweep.model,
            nominal_angles=sweep.nominal_angles,
        )
        return Frame(number, cloud, stamp, sender=sender)

    def close(self) -> None:
        """Close the port, as in `Source`."""
        self._closed.set()
        self._mailbox.close()
        self._thread.join(5 * LOOK)

    def _receive(self) -> None:
        for packet, sender in _coming(self._socket, self._closed):
            self._take(packet, sender, time.time())

    def _take(self, packet: bytes, sender: tuple[str, int], received: float) -> None:
        misfit = self._kind.misfit(packet)
        now = time.monotonic()
        with self._lock:
            if misfit:
                self._wrong[misfit] += 1
                return
            if not self._is_the_one(sender, now):
                self._others, self._other = self._others + 1, sender
                return
            has_paused = now - self._last_packet >= PAUSE
            if self._decoder is None or has_paused:
                self._decoder = self._kind.decoder()
            self._last_packet = now
            self._taken += 1
            decoder = self._decoder
        try:
            sweep = decoder(packet, received)
        except Exception as error:
            with self._lock:
                # Packets that cannot be decoded do not block another sensor.
                self._sender = self._decoder = None
                self._counts.pop(sender, None)
                self._wrong[f"{len(packet)} that cannot be decoded ({shortened(said(error))})"] += 1
            return
        if sweep is not None:
            with self._lock:
                note = f"port {self._port}: {self._left_out('packets')}"
                came = _Came(sweep, received, _named(sender), (note,) if self._others else ())
                self._last_sweep = now
                self._taken = self._others = 0
                self._wrong.clear()
            self._mailbox.put(came)

    def _is_the_one(self, sender: tuple[str, int], now: float) -> bool:
        """Whether a sender is the one that is used; choose another if that is not a sensor."""
        if self._senders and sender[0] not in self._senders:
            return False
        taken, counted_for = self._sender, now - self._counted_from
        if taken is None or now - self._last_packet >= PAUSE:
            taken = sender
        elif WINDOW <= counted_for < 2 * WINDOW and self._counts[taken] < FEWEST:
            ((taken, _),) = self._counts.most_common(1) or [(taken, 0)]
        if counted_for >= WINDOW:
            self._counts.clear()
            self._counted_from = now
        # Of more than a hundred senders no sensor would be found.
        if len(self._counts) < 100 or sender in self._counts:
            self._counts[sender] += 1
        if taken != self._sender:
            self._sender, self._decoder = taken, None
        return sender == taken


class VelodyneSource(PacketSource):
    """A Velodyne that sends its packets to a port.

    Parameters
    ----------
    port
        UDP; 2368 unless the sensor was configured otherwise.
    host
        Address of this computer to listen on.
    senders
        As `PacketSource` takes them.

    Raises
    ------
    MissingExtraError
        If velodyne-decoder is not installed.
    UsageError
        If the port cannot be opened: another program has it.
    """

    def __init__(
        self, port: int, host: str = ALL_INTERFACES, senders: Collection[str] = ()
    ) -> None:
        try:
            import velodyne_decoder
        except ImportError:
            raise MissingExtraError("velodyne", "reading Velodyne packets") from None

        def decoder() -> Decoder:
            stream = velodyne_decoder.StreamDecoder(velodyne_decoder.Config())

            def sweep(packet: bytes, received: float) -> Sweep | None:
                whole = stream.decode(received, packet, True)
                return None if whole is None else velodyne_sweep(whole[0].host, whole[1])

            return sweep

        kind = _Kind("Velodyne", f"{VELODYNE_SIZE} bytes", _no_velodyne, decoder)
        super().__init__(port, host, kind, senders)


class Reported:
    """Status packets of LiDARs on a port: the newest of each, by its address.

    Several sources listen to it if their LiDARs send to the same port; the last one closes it.

    Raises
    ------
    UsageError
        As `VelodyneSource`.
    """

    _open: ClassVar[dict[tuple[str, int], Reported]] = {}
    _lock: ClassVar[Lock] = Lock()

    def __init__(self, port: int, host: str) -> None:
        self._key, self._socket, self._users = (host, port), _opened(port, host), 0
        self._closed = Event()
        self.packets: dict[str, bytes] = {}
        self._thread = Thread(target=self._receive, name=f"told:{port}", daemon=True)
        self._thread.start()

    @classmethod
    def on(cls, port: int, host: str) -> Reported:
        """Listen to a port, together with others that do."""
        with cls._lock:
            own = cls._open.get((host, port))
            if own is None:
                own = cls._open[host, port] = cls(port, host)
            own._users += 1
            return own

    def leave(self) -> None:
        """Stop listening."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                del self._open[self._key]
                self._closed.set()
                self._thread.join(5 * LOOK)

    def _receive(self) -> None:
        for packet, (address, _) in _coming(self._socket, self._closed):
            if packet.startswith(DIFOP_START):
                keep(self.packets, address, packet)


def keep(told: dict[str, bytes], address: str, packet: bytes) -> None:
    """Keep the last packet from an address; among more than a hundred no LiDAR would be found."""
    if address in told or len(told) < 100:
        told[address] = packet


class TableSource(PacketSource):
    """A LiDAR that sends its packets to a port, of a maker whose models are in tables.

    Parameters
    ----------
    maker
        As in the tables, in any case.
    port, host, senders
        As `VelodyneSource` takes them.
    told
        Port to which it sends its angles; None for that of its maker, if it has one and no other
        program listens there. They may also use the first port.
    angles
        File of the angles of the unit.

    Raises
    ------
    UsageError
        As `VelodyneSource`.
    """

    def __init__(
        self,
        maker: str,
        port: int,
        host: str = ALL_INTERFACES,
        senders: Collection[str] = (),
        told: int | None = None,
        angles: Path | None = None,
    ) -> None:
        models = [model for model in MODELS if model.maker.lower() == maker.lower()]
        title = models[0].maker
        usual = next((model.port_told for model in models if model.port_told), 0)
        self._tells = any(getattr(model.layout, "difop", None) for model in models)
        if told is not None and not self._tells:
            raise UsageError(f"port {told}: a {title} sends its angles to no port")
        self._told: Reported | None = None
        self._own_told: dict[str, bytes] = {}
        unheard = ""
        try:
            if (told or usual) not in (0, port):
                self._told = Reported.on(told or usual, host)
        except UsageError as error:
            if told is not None:
                raise
            unheard = f"its angles are not received: {error}"

        def misfit(packet: bytes) -> str:
            return "" if recognized(packet) in models else str(len(packet))

        def decoder() -> Decoder:
            known: Model | None = None
            take: Callable[[bytes], Sweep | None] = lambda packet: None  # noqa: E731
            used: Angles | None = None
            last = b""

            def sweep(packet: bytes, received: float) -> Sweep | None:
                nonlocal known, take, used, last
                model, heard = recognized(packet), b"" if angles else self._heard()
                if model is not None and (model is not known or heard is not last):
                    last = heard
                    own = read_angles(angles, model) if angles else reported_angles(model, heard)
                    if model is not known or (own is not None and not own.looks_as(used)):
                        known, take, used = model, live(model, own), own
                whole = take(packet)
                if whole is None or not unheard or used is not None:
                    return whole
                return whole._replace(notes=(*whole.notes, unheard))

            return sweep

        try:
            kind = _Kind(title, "packets of returns", misfit, decoder)
            super().__init__(port, host, kind, senders)
        except UsageError:
            self._leave()
            raise
        if told is not None:
            self.name += f",{told}"

    def close(self) -> None:
        """Close both ports, as in `Source`."""
        super().close()
        self._leave()

    def _leave(self) -> None:
        if self._told is not None:
            self._told.leave()
            self._told = None

    def _heard(self) -> bytes:
        """The last status packet of the LiDAR that is used; empty before the first."""
        address = self._sender[0] if self._sender else ""
        others = self._told.packets if self._told else {}
        return self._own_told.get(address) or others.get(address, b"")

    def _take(self, packet: bytes, sender: tuple[str, int], received: float) -> None:
        if self._tells and packet.startswith(DIFOP_START):
            keep(self._own_told, sender[0], packet)
        else:
            super()._take(packet, sender, received)


class OusterSource(PacketSource):
    """An Ouster that sends its packets to a port.

    Parameters
    ----------
    port
        UDP, for its LiDAR; 7502 unless the sensor was configured otherwise.
    metadata
        The sensor's metadata, a file .json: which describe the structure of its packets.
    host
        Address of this computer to listen on.
    senders
        As `PacketSource` takes them.

    Raises
    ------
    MissingExtraError
        If ouster-sdk is not installed.
    ReadError
        If the metadata cannot be read.
    UsageError
        If the port cannot be opened: another program has it.
    """

    def __init__(
        self,
        port: int,
        metadata: Path,
        host: str = ALL_INTERFACES,
        senders: Collection[str] = (),
    ) -> None:
        try:
            from ouster.sdk.core import (
                LidarPacket,
                LidarScan,
                PacketFormat,
                PacketValidationFailure,
                ScanBatcher,
                SensorInfo,
            )
        except ImportError:
            raise MissingExtraError("ouster", "reading Ouster packets") from None

        with naming(metadata), reported("file of an Ouster's metadata"):
            info = SensorInfo(metadata.read_text())
            layout = PacketFormat.from_info(info)
            sweep_of = ouster_sweeps(info)
        size: int = layout.lidar_packet_size

        def packet_of(data: bytes, received: float = 0.0) -> Any:
            packet = LidarPacket(len(data))
            packet.host_timestamp = int(received * 1e9)  # a scan of packets at 0 is never whole
            packet.buf[:] = np.frombuffer(data, np.uint8)
            return packet

        def misfit(data: bytes) -> str:
            if len(data) != size:
                return str(len(data))
            failure = packet_of(data).validate(info, layout)
            is_other = failure != PacketValidationFailure.NONE
            return f"{size} of another sensor than the metadata" if is_other else ""

        def decoder() -> Decoder:
            batcher, scan, is_first = ScanBatcher(info), LidarScan(info), True

            def sweep(packet: bytes, received: float) -> Sweep | None:
                nonlocal scan, is_first
                if not batcher(packet_of(packet, received), scan):
                    return None
                whole, scan = scan, LidarScan(info)
                # The first one began before we listened; of others, packets may be lost.
                is_part, is_first = is_first and not whole.complete(), False
                return None if is_part else sweep_of(whole)

            return sweep

        super().__init__(port, host, _Kind("Ouster", f"{size} bytes", misfit, decoder), senders)


def _no_velodyne(packet: bytes) -> str:
    if len(packet) != VELODYNE_SIZE:
        return str(len(packet))
    return "" if packet.startswith(VELODYNE_START) else f"{VELODYNE_SIZE} with another beginning"


def _address(text: str) -> str:
    """Write an address as those of senders are."""
    try:
        return str(ip_address(text))
    except ValueError:
        raise UsageError(f"--from {text!r}: expected an IP address, as 192.168.1.201") from None


def _named(sender: tuple[str, int]) -> str:
    return f"{sender[0]}:{sender[1]}"


def _coming(own: socket.socket, closed: Event) -> Iterator[tuple[bytes, tuple[str, int]]]:
    """Receive packets, with the sender of each, until the stop event; then close the port."""
    with own:
        while not closed.is_set():
            try:
                yield own.recvfrom(2**16)
            except TimeoutError:
                continue
            except OSError:
                # The network went away; it may come back.
                closed.wait(LOOK)


def _opened(port: int, host: str) -> socket.socket:
    """Open a port to receive packets."""
    if not 0 < port < 2**16:
        raise UsageError(f"port {port}: expected 1 to 65535")
    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        # The system gives as much of it as it allows (on Linux, net.core.rmem_max).
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**23)
        own.settimeout(LOOK)
        own.bind((host, port))
    except OSError as error:
        own.close()
        if error.errno == errno.EADDRINUSE:
            raise UsageError(f"port {port}: another program listens on it already") from None
        reason = error.strerror or str(error)
        raise UsageError(f"port {port}: cannot be opened on {host} ({reason})") from None
    return own
