"""Packets sent to a port give the sweeps that a capture of them gives."""

import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import MissingExtraError, ReadError, UsageError
from retropole.io import Frame, read_frames
from retropole.io.bags import opened
from retropole.io.fields import Wanted
from retropole.io.live import Source, source_of
from retropole.io.live.udp import OusterSource, PacketSource, Reported, TableSource, VelodyneSource
from retropole.io.packets import drivers
from retropole.io.packets.capture import packets, walk
from tests.io.files import required
from tests.io.packets.sending import angles_of, bag_of, turning
from tests.io.packets.written import MANUALS, difop
from tests.paths import SHARED
from tests.tiers import first_of

FORMATS = SHARED / "formats"
VLP16 = "velodyne/sample_velodyne_vlp16_gps.pcap"
HDL32 = "velodyne/sample_velodyne_hdl32.pcap"
OUSTER = "ouster/OS-0-128-U1_v2.3.0_1024x10.pcap"

HEADERS = 42
"""Bytes of Ethernet, IP and UDP before what the sensor sent."""

HOME = "127.0.0.1"
LONG = 10.0
"""Seconds that are more than enough."""


def shared(name: str) -> Path:
    path = FORMATS / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def payloads(path: Path) -> list[bytes]:
    return [packet[HEADERS:] for packet in packets(path, walk(path))]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind((HOME, 0))
        port: int = own.getsockname()[1]
        return port


@contextmanager
def sender(port: int) -> Iterator[Callable[[list[bytes]], None]]:
    """A sensor; it sends slowly enough for the smallest buffer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind((HOME, 0))

        def send(packets: list[bytes]) -> None:
            for k, packet in enumerate(packets):
                own.sendto(packet, (HOME, port))
                if k % 4 == 3:
                    time.sleep(0.001)

        yield send


def until(holds: Callable[[], object]) -> None:
    """Wait until something holds."""
    end = time.monotonic() + LONG
    while not holds():
        assert time.monotonic() < end, "it never holds"
        time.sleep(0.01)


@pytest.fixture
def velodyne() -> Iterator[tuple[VelodyneSource, int]]:
    pytest.importorskip("velodyne_decoder")
    port = free_port()
    with closing(VelodyneSource(port, HOME)) as source:
        yield source, port


def number_taken(source: PacketSource) -> int:
    """How many packets were looked at since the last sweep."""
    return source._taken + source._others + source._wrong.total()


def assert_same(live: Frame, read: Frame) -> None:
    for name in ("xyz", "intensity", "ring", "origin"):
        np.testing.assert_array_equal(getattr(live.cloud, name), getattr(read.cloud, name))
    assert live.cloud.fields == read.cloud.fields
    assert live.cloud.dropped == read.cloud.dropped


@pytest.mark.parametrize("name", [VLP16, HDL32])
def test_a_velodyne_gives_the_sweeps_of_its_capture(name: str) -> None:
    pytest.importorskip("velodyne_decoder")
    path = shared(name)
    read = list(read_frames(path))
    port = free_port()
    with closing(VelodyneSource(port, HOME)) as source, sender(port) as send:
        packets, live = payloads(path), list[Frame]()
        before = time.time()
        # In between, no wait: a sweep that takes too long is cut.
        for start in range(0, len(packets), 20):
            send(packets[start : start + 20])
            frame = source.newest(0)
            live += [frame] if frame else []
        last = source.newest(1) if len(live) < len(read) - 1 else None
        live += [last] if last else []
        # The last one is whole when the next begins, and nothing follows it.
        assert [frame.number for frame in live] == [frame.number for frame in read[:-1]]
        assert source.waits_for == ""
        for ours, theirs in zip(live, read, strict=False):
            assert_same(ours, theirs)
            stamp = required(ours.stamp)
            assert before <= stamp <= time.time()
            offsets = required(ours.cloud.time) - stamp
            np.testing.assert_allclose(
                offsets, required(theirs.cloud.time) - required(theirs.stamp), atol=1e-6
            )


def test_an_ouster_gives_the_sweep_of_its_capture() -> None:
    pytest.importorskip("ouster.sdk", reason="needs pip install 'retropole[ouster]'")
    path = shared(OUSTER)
    (read,) = read_frames(path)
    all_packets = payloads(path)
    own = [packet for packet in all_packets if len(packet) == 8448]
    port = free_port()
    with closing(OusterSource(port, path.with_suffix(".json"), HOME)) as source:
        with sender(port) as send:
            send(all_packets)
            live = required(source.newest(LONG))
            assert_same(live, read)
            np.testing.assert_array_equal(live.cloud.time, read.cloud.time)
            # Its clock counts from when it was switched on, so that it is ours that counts.
            assert required(live.stamp) == pytest.approx(time.time(), abs=LONG)
        with sender(port) as send:
            strange = bytes(4) + b"\1\2\3" + own[0][7:]
            send([strange] * 3)
            until(lambda: number_taken(source) >= 3)
            assert source.newest(0) is None


def test_the_first_part_of_a_sweep_of_an_ouster_is_left_out() -> None:
    pytest.importorskip("ouster.sdk", reason="needs pip install 'retropole[ouster]'")
    path = shared(OUSTER)
    (read,) = read_frames(path)
    own = [packet for packet in payloads(path) if len(packet) == 8448]
    # The second half of a sweep, with the number of the one before.
    early = [
        p[:2] + (int.from_bytes(p[2:4], "little") - 1).to_bytes(2, "little") + p[4:] for p in own
    ]
    port = free_port()
    metadata = path.with_suffix(".json")
    with closing(OusterSource(port, metadata, HOME)) as source, sender(port) as send:
        send(early[32:] + own)
        live = required(source.newest(LONG))
    assert live.number == 0
    assert_same(live, read)


def test_metadata_that_are_none_are_named(tmp_path: Path) -> None:
    pytest.importorskip("ouster.sdk", reason="needs pip install 'retropole[ouster]'")
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(ReadError, match=r"a\.json"):
        OusterSource(free_port(), tmp_path / "a.json", HOME)
    with pytest.raises(ReadError, match=r"b\.json: cannot be read"):
        OusterSource(free_port(), tmp_path / "b.json", HOME)


def test_sweeps_that_nobody_took_are_left_out_and_counted(
    velodyne: tuple[VelodyneSource, int],
) -> None:
    source, port = velodyne
    path = shared(VLP16)
    with sender(port) as send:
        send(payloads(path))
        until(lambda: source._mailbox._count == 3)
        newest = required(source.newest(0))
        assert newest.number == 2
        assert_same(newest, list(read_frames(path))[2])
        assert source.newest(0) is None


def test_other_packets_are_counted_and_reported(velodyne: tuple[VelodyneSource, int]) -> None:
    source, port = velodyne
    assert source.waits_for == f"port {port}: no packet received"
    with sender(port) as send:
        send([bytes(1248)] * 120)
        until(lambda: number_taken(source) == 120)
        expected = "120 packets received, none of a Velodyne: 1206 bytes expected, 1248 came"
        assert source.waits_for == f"port {port}: {expected}"
        send([bytes(1206)] * 200 + [b""] * 3)
        until(lambda: number_taken(source) == 323)
        assert "1206 with another beginning and 1248 and 0 came" in source.waits_for
        assert source.newest(0) is None


def test_packets_of_no_known_velodyne_are_reported(velodyne: tuple[VelodyneSource, int]) -> None:
    source, port = velodyne
    with sender(port) as send:
        # It tries when a sweep is whole, or takes too long.
        for _ in range(50):
            send([b"\xff\xee" + bytes(1204)] * 10)
            time.sleep(0.01)
        until(lambda: "cannot be decoded" in source.waits_for)
        assert "none of a Velodyne" in source.waits_for
        # They keep no other away.
        send(payloads(shared(VLP16)))
        assert source.newest(LONG) is not None


def test_of_two_senders_the_first_is_taken(
    velodyne: tuple[VelodyneSource, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, port = velodyne
    # On a busy machine the first one sends less often than a sensor would, and with pauses; and the
    # decoder cuts a sweep that takes too long.
    monkeypatch.setattr("retropole.io.live.udp.FEWEST", 0)
    monkeypatch.setattr("retropole.io.live.udp.PAUSE", 60.0)
    clock = SimpleNamespace(time=lambda: 1.7e9, monotonic=time.monotonic)
    monkeypatch.setattr("retropole.io.live.udp.time", clock)
    looked_at, take = list[bytes](), source._take

    def count(packet: bytes, *others: Any) -> None:
        take(packet, *others)
        looked_at.append(packet)

    monkeypatch.setattr(source, "_take", count)
    path = shared(VLP16)
    first, other = payloads(path), payloads(shared(HDL32))
    read = list(read_frames(path))
    sent, frames = list[bytes](), list[Frame]()

    def have_all_come() -> bool:
        return len(looked_at) == len(sent)

    with sender(port) as send, sender(port) as disturb:
        for k in range(0, len(first), 10):
            for own, part in ((send, first[k : k + 10]), (disturb, other[k : k + 10])):
                own(part)
                sent += part
                until(have_all_come)
            frame = source.newest(0)
            frames += [frame] if frame else []
    assert [frame.number for frame in frames] == [0, 1, 2]
    for frame in frames:
        assert_same(frame, read[frame.number])
        (note,) = frame.cloud.notes
        assert f"port {port}: packets of {HOME}:" in note
        assert "left out" in note


def test_another_sender_is_taken_when_the_first_stops(
    velodyne: tuple[VelodyneSource, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, port = velodyne
    path = shared(VLP16)
    packets, read = payloads(path), list(read_frames(path))
    with sender(port) as send:
        send(packets[:100])
        assert_same(required(source.newest(LONG)), read[0])
        until(lambda: source._taken > 0)
    with sender(port) as send:
        send([p for p in packets if len(p) == 1206][:50])
        until(lambda: source._others == 50)
        monkeypatch.setattr("retropole.io.live.udp.QUIET", 0.0)
        assert "50 packets of 127.0.0.1:" in source.waits_for
        assert "no sweep; " in source.waits_for
        monkeypatch.setattr("retropole.io.live.udp.PAUSE", 0.1)
        time.sleep(0.15)
        assert "sends no more packets" in source.waits_for
        # It begins anew, not with what the first one left behind.
        send(packets[:100])
        frame = required(source.newest(LONG))
        assert frame.number == 1
        assert_same(frame, read[0])


STRANGER, SENSOR = ("10.0.0.9", 1), ("10.0.0.1", 2368)


def taken_of(source: PacketSource, packets: list[tuple[float, tuple[str, int]]]) -> list[bool]:
    """Whether each packet is taken that comes then, of whom."""
    return [is_taken(source, sender, at) for at, sender in sorted(packets)]


def is_taken(source: PacketSource, sender: tuple[str, int], at: float) -> bool:
    is_the_one = source._is_the_one(sender, at)
    if is_the_one:
        source._last_packet = at
    return is_the_one


def rate_of(
    sender: tuple[str, int], hertz: float, start: float, end: float
) -> list[tuple[float, tuple[str, int]]]:
    return [(start + k / hertz, sender) for k in range(int((end - start) * hertz))]


def test_who_sends_little_keeps_no_sensor_away(velodyne: tuple[VelodyneSource, int]) -> None:
    source, _ = velodyne
    given = sorted(rate_of(STRANGER, 2, 0, 5) + rate_of(SENSOR, 320, 1.2, 5))
    taken = taken_of(source, given)
    late = [(one, sender) for (at, sender), one in zip(given, taken, strict=True) if at > 1.5]
    assert all(one == (sender == SENSOR) for one, sender in late)
    assert len(late) > 1000


@pytest.mark.parametrize("hertz", [2.0, 754.0, 50_000.0])
def test_a_sensor_is_kept_whatever_others_send(
    velodyne: tuple[VelodyneSource, int], hertz: float
) -> None:
    source, _ = velodyne
    given = sorted(rate_of(SENSOR, 754, 0, 3) + rate_of(STRANGER, hertz, 1, 2))
    taken = taken_of(source, given)
    assert all(one == (sender == SENSOR) for (_, sender), one in zip(given, taken, strict=True))
    # Once it has stopped, another one is.
    assert not is_taken(source, STRANGER, 4.0)
    assert is_taken(source, STRANGER, 5.1)
    assert all(taken_of(source, rate_of(STRANGER, 754, 5.2, 6)))


def test_only_senders_that_are_named_are_taken() -> None:
    pytest.importorskip("velodyne_decoder")
    path = shared(VLP16)
    port = free_port()
    with closing(VelodyneSource(port, HOME, ["127.0.0.2"])) as source, sender(port) as send:
        send(payloads(path)[:50])
        until(lambda: source._others >= 40)
        assert "left out, since --from gives another" in source.waits_for
    with closing(VelodyneSource(port, HOME, ["127.0.0.2", HOME])) as source, sender(port) as send:
        send(payloads(path))
        frame = required(source.newest(LONG))
        assert frame.sender.startswith(f"{HOME}:")
    with pytest.raises(UsageError, match="--from 'lidar': expected an IP address"):
        VelodyneSource(port, HOME, ["lidar"])


def test_a_port_in_use_is_named() -> None:
    pytest.importorskip("velodyne_decoder")
    port = free_port()
    with closing(VelodyneSource(port, HOME)):
        for host in (HOME, "0.0.0.0"):
            with pytest.raises(UsageError, match=f"port {port}: another program listens"):
                VelodyneSource(port, host)
    VelodyneSource(port, HOME).close()


@pytest.mark.parametrize("port", [0, -1, 65_536])
def test_a_port_that_cannot_be(port: int) -> None:
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(UsageError, match=f"port {port}: expected 1 to 65535"):
        VelodyneSource(port)


def test_an_address_that_is_not_ours() -> None:
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(UsageError, match=r"cannot be opened on 192\.0\.2\.1"):
        VelodyneSource(free_port(), "192.0.2.1")


def test_closing_ends_the_thread_and_every_wait() -> None:
    pytest.importorskip("velodyne_decoder")
    source: Source = VelodyneSource(port := free_port(), HOME)
    assert isinstance(source, VelodyneSource)
    assert source.name == f"velodyne:{HOME}:{port}"
    assert not source.has_ended
    source.close()
    source.close()
    assert not source._thread.is_alive()
    assert source.newest(LONG) is None


@pytest.mark.parametrize("extra", ["velodyne", "ouster"])
def test_missing_extras_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: str
) -> None:
    module = {"velodyne": "velodyne_decoder", "ouster": "ouster.sdk.core"}[extra]
    monkeypatch.setitem(sys.modules, module, None)
    begin = VelodyneSource if extra == "velodyne" else partial(OusterSource, metadata=tmp_path)
    with pytest.raises(MissingExtraError, match=rf"retropole\[{extra}\]"):
        begin(free_port())


@pytest.mark.parametrize("name", first_of(["hesai_xt32", "hesai_64"]))
def test_sweeps_of_a_model_of_the_tables_are_those_of_its_recording(
    tmp_path: Path, name: str
) -> None:
    path = bag_of(name, tmp_path)
    recorded = list(read_frames(path))
    with opened(path) as bag:
        (topic,) = bag.topics
        coming = drivers.datagrams(bag.messages(topic.name, topic.kind), topic.kind)
        sent = [each.payload for each in coming]
    port = free_port()
    frames: list[Frame] = []
    with closing(source_of(f"hesai:{HOME}:{port}")) as source, sender(port) as send:
        for k in range(0, len(sent), 20):
            send(sent[k : k + 20])
            frame = source.newest(0.01)
            frames += [frame] if frame else []
    assert frames[0].cloud.notes[0].startswith("angles of Hesai")
    # The first began before we listened, and the last is not whole.
    assert [frame.number for frame in frames] == list(range(len(frames)))
    assert len(frames) >= len(recorded) - 2 - 1
    for frame in frames:
        same = [own for own in recorded if len(own.cloud) == len(frame.cloud)]
        assert any(np.array_equal(own.cloud.xyz, frame.cloud.xyz) for own in same)


def test_what_is_of_another_maker_is_reported() -> None:
    port = free_port()
    with closing(source_of(f"hesai:{HOME}:{port}")) as source, sender(port) as send:
        send([bytes(1206)] * 3)
        assert source.newest(0.3) is None
        assert "none of a Hesai: packets of returns expected, 1206 came" in source.waits_for


def test_packets_are_placed_by_the_angles_of_the_unit(tmp_path: Path) -> None:
    unit, sent, port = angles_of(tmp_path / "unit.csv", 16), turning("XT16", 120), free_port()
    frame = None
    wanted = Wanted(angles=str(unit))
    with closing(source_of(f"hesai:{HOME}:{port}", wanted=wanted)) as source, sender(port) as send:
        for k in range(0, len(sent), 20):
            send(sent[k : k + 20])
            frame = source.newest(0.01) or frame
        frame = frame or source.newest(LONG)
    assert required(frame).cloud.notes[0] == "angles of Hesai XT16: unit.csv"


def ruby(rng: np.random.Generator, turns: float) -> tuple[list[bytes], list[float]]:
    """Packets of a Ruby, and at which elevations its channels look."""
    manual, up = MANUALS["Ruby"], np.round(np.linspace(-25, 15, 128), 2).tolist()
    packets = []
    for row in range(0, round(360 * turns), 3):
        distances = [rng.integers(100, 1000, 128) * 0.02 for _ in range(3)]
        rows = [(float(row + k), own.tolist(), [k] * 128) for k, own in enumerate(distances)]
        packets.append(manual.packet(rows, row * 50))
    return packets, up


@pytest.mark.parametrize("where", ["named", "usual", "same"])
def test_angles_that_come_to_another_port_are_used(
    monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    port, told = free_port(), free_port()
    # The usual one may be in use here.
    on = Reported.on
    monkeypatch.setattr(Reported, "on", lambda at, host: on(told if at == 7788 else at, host))
    packets, up = ruby(np.random.default_rng(2), 2.5)
    text = f"robosense:{HOME}:{port},{told}" if where == "named" else f"robosense:{HOME}:{port}"
    with closing(source_of(text)) as source, sender(port) as send:
        assert source.name == text
        send(packets)
        with pytest.raises(
            ReadError, match=r"Ruby sends .* in DIFOP packets, and none was received"
        ):
            source.newest(LONG)
        with sender(port if where == "same" else told) as tell:
            tell([b"of another", difop(up, [0.0] * 128)])
        assert isinstance(source, TableSource)
        until(source._heard)
        send(packets)
        frame = required(source.newest(LONG))
    assert "angles of RoboSense Ruby: the DIFOP packets" in frame.cloud.notes
    level = np.hypot(*frame.cloud.xyz[:, :2].T)
    seen = np.degrees(np.arctan2(frame.cloud.xyz[:, 2], level))
    wanted = np.array(up)[required(frame.cloud.ring)]
    np.testing.assert_allclose(seen, wanted, atol=1.0)


def test_two_lidars_tell_their_angles_to_one_port() -> None:
    ports, told = (free_port(), free_port()), free_port()
    texts = [f"robosense:{HOME}:{port},{told}" for port in ports]
    with closing(source_of(texts[0])) as first, closing(source_of(texts[1])) as second:
        assert isinstance(first, TableSource)
        assert isinstance(second, TableSource)
        with sender(told) as tell:
            tell([difop([0.1 * k for k in range(128)], [0.0] * 128)])
        for each in (first, second):
            each._sender = HOME, 1
            until(each._heard)
        first.close()
        assert second._heard()
    # Then the port is free.
    Reported(told, HOME).leave()


def test_a_port_of_angles_that_cannot_be_heard() -> None:
    with pytest.raises(UsageError, match="port 7: a Hesai sends its angles to no port"):
        source_of(f"hesai:{HOME}:{free_port()},7")
    with pytest.raises(UsageError, match="a Velodyne sends to one port"):
        source_of(f"velodyne:{HOME}:{free_port()},7")
    port, told = free_port(), free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOME, told))
        with pytest.raises(UsageError, match=f"port {told}: another program listens"):
            source_of(f"robosense:{HOME}:{port},{told}")
    # It let go of its own port.
    source_of(f"robosense:{HOME}:{port},{told}").close()
