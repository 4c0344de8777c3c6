"""Captures, also damaged ones: packets of Velodynes and Ousters give what the libraries read."""

import random
import shutil
import struct
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import MissingExtraError, ReadError
from retropole.io import open_recording, read_cloud, read_frames, topics_of
from retropole.io.packets.capture import CAPTURE_HEADER, PACKET_HEADER, similar_packets, walk
from retropole.io.recordings import time_of_recording
from tests.cli.commands import retropole_here
from tests.damage import cut as cut_at_random
from tests.damage import flip, set_bytes, velodyne
from tests.io.files import required
from tests.io.packets.sending import datagram, pcap, pcapng, turning
from tests.paths import SHARED

FORMATS = SHARED / "formats"

VELODYNE = {"sample_velodyne_hdl32": (3, 146_705), "sample_velodyne_vlp16_gps": (4, 73_486)}
OUSTER = "OS-0-128-U1_v2.3.0_1024x10"


def shared(name: str) -> Path:
    path = FORMATS / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def needs_ouster() -> None:
    pytest.importorskip("ouster.sdk", reason="needs pip install 'retropole[ouster]'")


def capture(path: Path, payloads: list[bytes]) -> None:
    """Write UDP packets as a pcap."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for k, payload in enumerate(payloads):
            size = 42 + len(payload)
            udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0)
            ip = struct.pack(
                ">BBHHHBBH4s4s", 69, 0, size - 14, 0, 0, 64, 17, 0, b"\1" * 4, b"\2" * 4
            )
            packet = b"\xff" * 12 + b"\x08\x00" + ip + udp + payload
            file.write(struct.pack("<IIII", k, 0, size, size) + packet)


@pytest.mark.parametrize("name", VELODYNE)
def test_a_velodyne_is_read_as_velodyne_decoder_reads_it(name: str) -> None:
    decoder = pytest.importorskip("velodyne_decoder")
    path = shared(f"velodyne/{name}.pcap")
    sweeps = list(decoder.read_pcap(path))
    table = np.concatenate([points for _, points in sweeps]).astype(float)
    read = read_cloud(path)
    assert (len(sweeps), len(read)) == VELODYNE[name] == (len(sweeps), len(table))
    fields = decoder.PointField
    np.testing.assert_array_equal(read.xyz, table[:, :3])
    np.testing.assert_array_equal(read.intensity, table[:, fields.intensity])
    np.testing.assert_array_equal(read.ring, table[:, fields.ring])
    np.testing.assert_array_equal(read.origin, np.zeros(3))
    lengths = [len(points) for _, points in sweeps]
    np.testing.assert_array_equal(read.frame, np.repeat(range(len(sweeps)), lengths))
    starts = np.repeat([stamp.host for stamp, _ in sweeps], lengths)
    assert time_of_recording(read) == pytest.approx((starts[0], starts[-1]), abs=0.2)
    np.testing.assert_allclose(read.time - starts, table[:, fields.time], atol=1e-6)


def test_sweeps_are_sliced() -> None:
    pytest.importorskip("velodyne_decoder")
    path = shared("velodyne/sample_velodyne_vlp16_gps.pcap")
    frames = list(read_frames(path))
    assert [frame.number for frame in frames] == [0, 1, 2, 3]
    middle = read_cloud(path, frames=slice(1, 3))
    parts = [frame.cloud.xyz for frame in frames[1:3]]
    np.testing.assert_array_equal(middle.xyz, np.concatenate(parts))
    stamps = [required(frame.stamp) for frame in frames]
    np.testing.assert_allclose(np.diff(stamps)[:2], 0.1, atol=0.01)
    with pytest.raises(ReadError, match=r"no LiDAR sends from /points; .*Velodyne VLP-16"):
        read_cloud(path, topic="/points")


def test_an_ouster_is_read_as_its_sdk_reads_it() -> None:
    needs_ouster()
    from ouster.sdk import open_source
    from ouster.sdk.core import ChanField, XYZLut

    path = shared(f"ouster/{OUSTER}.pcap")
    source = open_source(str(path), meta=[str(path.with_suffix(".json"))])
    info = source.sensor_info[0]
    (scan,) = [scan for scans in source for scan in scans]
    ranges = scan.field(ChanField.RANGE)
    read = read_cloud(path)
    assert open_recording(path).count == 1
    returned = ranges > 0
    assert (len(read), read.dropped) == (int(returned.sum()), int((~returned).sum()))
    assert (len(read), read.dropped) == (97_299, 33_773)
    np.testing.assert_array_equal(read.xyz, XYZLut(info, use_extrinsics=False)(scan)[returned])
    np.testing.assert_array_equal(read.intensity, scan.field(ChanField.REFLECTIVITY)[returned])
    np.testing.assert_array_equal(read.ring, np.nonzero(returned)[0])
    np.testing.assert_array_equal(read.time, scan.timestamp[np.nonzero(returned)[1]] / 1e9)


def test_beams_of_an_ouster_start_at_its_origin() -> None:
    """From there, the beams of a ring make a cone about the axis: one elevation all around."""
    needs_ouster()
    read = read_cloud(shared(f"ouster/{OUSTER}.pcap"))
    ray = read.xyz - read.origin
    far = np.linalg.norm(ray, axis=1) > 5
    elevation = np.arcsin(ray[far, 2] / np.linalg.norm(ray[far], axis=1))
    ring = required(read.ring)[far]
    spread = [np.ptp(elevation[ring == k]) for k in np.unique(ring)]
    assert np.degrees(np.median(spread)) < 0.3
    np.testing.assert_allclose(read.origin, [0, 0, 0.03618])


@pytest.mark.parametrize("names", [(), ("one.json", "two.json")])
def test_an_ouster_without_metadata_says_what_to_supply(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    path = tmp_path / "drive.pcap"
    capture(path, [bytes(8448)] * 3)
    for name in names:
        (tmp_path / name).write_text("{}")
    with pytest.raises(
        ReadError, match=r"metadata next to them as drive\.json, found (no|2 files)"
    ):
        read_cloud(path)


@pytest.mark.parametrize("name", [f"{OUSTER}.json", "only.json"])
def test_metadata_of_an_ouster_are_found_next_to_it(tmp_path: Path, name: str) -> None:
    needs_ouster()
    path = shared(f"ouster/{OUSTER}.pcap")
    shutil.copy(path, tmp_path)
    shutil.copy(path.with_suffix(".json"), tmp_path / name)
    assert len(read_cloud(tmp_path / path.name)) == 97_299


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (b"no capture of packets", "expected a capture"),
        (b"\x0a\x0d\x0d\x0a" + bytes(40), "no complete packet in the 44 bytes"),
        (b"\xd4\xc3\xb2\xa1" + bytes(28) + b"\xff" * 8, "no complete packet in the 16 bytes"),
        (b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(12) + b"\1\0\0\0", "metadata"),
    ],
)
def test_other_files_are_named(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "a.pcap").write_bytes(content)
    with pytest.raises(ReadError, match=rf"a\.pcap: .*{reason}"):
        read_cloud(tmp_path / "a.pcap")


def test_damaged_packets_give_an_error_or_fewer_points(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    whole = shared("velodyne/sample_velodyne_vlp16_gps.pcap")
    content = whole.read_bytes()
    path = tmp_path / "a.pcap"
    sweeps = list(read_frames(whole))
    for part in (0.001, 0.003, 0.3, 0.5, 0.77):
        path.write_bytes(content[: int(part * len(content))])
        if part < 0.1:
            with pytest.raises(ReadError, match=r"a\.pcap"):
                read_cloud(path)
            continue
        read = list(read_frames(path))
        for frame, full in zip(read, sweeps[: len(read) - 1], strict=False):
            np.testing.assert_array_equal(frame.cloud.xyz, full.cloud.xyz)
        assert len(read[-1].cloud) <= len(sweeps[len(read) - 1].cloud)


def test_packets_without_a_return_are_no_sweep(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    block = b"\xff\xee" + bytes(98)
    capture(tmp_path / "a.pcap", [block * 12 + b"\0\0\0\0\x37\x22"] * 5)
    with pytest.raises(ReadError, match=r"a\.pcap"):
        read_cloud(tmp_path / "a.pcap")


VELODYNE_PACKET = (b"\xff\xee" + bytes(98)) * 12 + bytes(6)


@pytest.mark.parametrize("extra", ["velodyne", "ouster"])
def test_missing_extras_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: str
) -> None:
    module = {"velodyne": "velodyne_decoder", "ouster": "ouster.sdk"}[extra]
    capture(tmp_path / "a.pcap", [VELODYNE_PACKET] if extra == "velodyne" else [b"abc"])
    (tmp_path / "a.json").write_text("{}")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"retropole\[{extra}\]"):
        read_cloud(tmp_path / "a.pcap")


SIZE = PACKET_HEADER + 42 + 1206
"""Bytes of a record of the capture that the tests damage."""

POINTS = 12 * 32
"""Points of a packet."""


def at(record: int) -> int:
    """The first byte of a record."""
    return CAPTURE_HEADER + record * SIZE


def with_length(record: int, length: int) -> bytes:
    """The capture, a record of which says that it has another length."""
    data = bytearray(velodyne())
    struct.pack_into("<I", data, at(record) + 8, length)
    return bytes(data)


def test_a_whole_capture_has_no_gap_and_no_note(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(velodyne())
    capture = walk(path)
    assert capture.records.tolist() == [[at(k) + PACKET_HEADER, 1248] for k in range(10)]
    assert len(capture.gaps) == 0
    cloud = read_cloud(path)
    assert (len(cloud) + cloud.dropped, cloud.notes) == (10 * POINTS, ())


@pytest.mark.parametrize("length", [0, 1, 100, 1247, 1249, 1264, 2600, 70_000, 2**31, 2**32 - 1])
@pytest.mark.parametrize("record", [0, 4, 9])
def test_a_wrong_length_costs_one_packet(tmp_path: Path, record: int, length: int) -> None:
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "a.pcap"
    path.write_bytes(with_length(record, length))
    cloud = read_cloud(path)
    assert len(cloud) + cloud.dropped == 9 * POINTS
    (note,) = cloud.notes
    assert "at 1 place" in note
    assert "points are missing" in note


def removed(data: bytes) -> bytes:
    return data[: at(3) + 500] + data[at(3) + 700 :]


def zeroed(data: bytes) -> bytes:
    return data[: at(3)] + bytes(2 * SIZE + 30) + data[at(5) + 30 :]


def inserted(data: bytes) -> bytes:
    return data[: at(3)] + b"no packet" * 50 + data[at(3) :]


def cut(data: bytes) -> bytes:
    return data[: at(7) + 600]


def cut_in_a_header(data: bytes) -> bytes:
    return data[: at(7) + 5]


@pytest.mark.parametrize(
    ("damage", "left", "lost"),
    [
        (removed, 9, SIZE - 200),
        (zeroed, 7, 3 * SIZE),
        (inserted, 10, 450),
        (cut, 7, 600),
        (cut_in_a_header, 7, 5),
    ],
)
def test_the_rest_is_read_and_the_loss_is_reported(
    tmp_path: Path, damage: object, left: int, lost: int
) -> None:
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "a.pcap"
    assert callable(damage)
    path.write_bytes(damage(velodyne()))
    cloud = read_cloud(path)
    assert len(cloud) + cloud.dropped == left * POINTS
    assert f"{lost:,} of {path.stat().st_size:,} bytes at 1 place" in cloud.notes[0]


@pytest.mark.parametrize(("offset", "value"), [(12, 0), (14, 0), (23, 6), (16, 0), (42 + 300, 0)])
def test_a_packet_that_the_decoder_passes_over_is_counted(
    tmp_path: Path, offset: int, value: int
) -> None:
    """Damaged are what says Ethernet carries IP, IP's version, UDP, the length of all, a block."""
    pytest.importorskip("velodyne_decoder")
    data = bytearray(velodyne())
    data[at(6) + PACKET_HEADER + offset] = value
    path = tmp_path / "a.pcap"
    path.write_bytes(data)
    cloud = read_cloud(path)
    assert len(cloud) + cloud.dropped <= 10 * POINTS - 32
    assert "1 of 10 packets cannot be read" in cloud.notes[0]


def test_a_loss_is_reported_on_the_console_and_in_the_result(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "a.pcap"
    path.write_bytes(cut(velodyne()))
    shown = retropole_here("info", path)
    assert "note       the capture is damaged or cut: 600 of" in shown.stdout
    done = retropole_here("calibrate", path, path, "--out", tmp_path / "o", "--threshold", 9)
    assert f"retropole: {path}: the capture is damaged or cut" in done.stderr


def test_what_is_no_capture_at_all_is_refused_soon(tmp_path: Path) -> None:
    """Numbers that look like headers everywhere, and a capture with more gaps than packets."""
    path = tmp_path / "a.pcap"
    head = velodyne()[:CAPTURE_HEADER]
    path.write_bytes(head + struct.pack("<4I", 0, 0, 2**17, 2**17) * 100_000)
    with pytest.raises(ReadError, match=r"a\.pcap: "):
        read_cloud(path)
    packet = struct.pack("<4I", 0, 0, 8, 8) + bytes(8)
    path.write_bytes(head + (packet * 4 + b"\xff" * 7) * 1002)
    with pytest.raises(ReadError, match=r"is damaged at 1001 places"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".cap"])
def test_the_suffix_does_not_change_reading(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    for write in (pcap, pcapng):
        path.write_bytes(write([datagram(payload) for payload in turning("XT16")]))
        assert len(read_cloud(path)) == 40 * 8 * 16


@pytest.mark.parametrize("order", "<>")
def test_a_pcapng_gives_what_a_pcap_gives(tmp_path: Path, order: str) -> None:
    sent = [datagram(payload) for payload in turning("XT16")]
    plain, blocks = tmp_path / "a.pcap", tmp_path / "a.pcapng"
    plain.write_bytes(pcap(sent))
    blocks.write_bytes(pcapng(sent, order))
    for one, two in zip(read_frames(plain), read_frames(blocks), strict=True):
        np.testing.assert_array_equal(one.cloud.xyz, two.cloud.xyz)
    found = walk(blocks)
    np.testing.assert_allclose(found.times, walk(plain).times, atol=1e-6)
    assert len(found.gaps) == 0


def test_damage_of_a_pcapng_costs_the_packet(tmp_path: Path) -> None:
    data = bytearray(pcapng([datagram(payload) for payload in turning("XT16")]))
    path = tmp_path / "a.pcapng"
    size = len(data)
    data[size - 5 * 640 + 4] ^= 1
    del data[size - 3 * 640 + 50 : size - 3 * 640 + 60]
    path.write_bytes(data)
    cloud = read_cloud(path)
    assert len(cloud) == 38 * 8 * 16
    assert "at 2 places" in cloud.notes[0]


def test_lidars_of_one_capture_are_distinguished(tmp_path: Path) -> None:
    first, second = turning("XT16"), turning("XT32M")
    mixed = [
        packet
        for one, two in zip(first, second, strict=True)
        for packet in (datagram(one), datagram(two, "192.168.1.202", 2000), datagram(bytes(512)))
    ]
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap(mixed))
    names = {own.name: (own.kind, own.count) for own in topics_of(path)}
    assert names == {
        "192.168.1.201:10000": ("packets of Hesai XT16", 40),
        "192.168.1.202:2000": ("packets of Hesai XT32M", 40),
    }
    with pytest.raises(ReadError, match=r"packets of 2 LiDARs, name one of them: 192\.168\.1\.201"):
        read_cloud(path)
    cloud = read_cloud(path, topic="192.168.1.202:2000")
    assert (len(cloud), cloud.model) == (40 * 6 * 32, "Hesai XT32M")
    assert read_cloud(path, topic="192.168.1.201:10000").model == "Hesai XT16"
    shown = retropole_here("info", path).stdout
    assert shown.count("sensor     Hesai") == 2


def test_a_capture_of_two_velodynes_gives_each(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    path, both = tmp_path / "one.pcap", tmp_path / "both.pcap"
    path.write_bytes(velodyne())
    alone = read_cloud(path)
    payloads = [each.first.payload for each in similar_packets(path, walk(path), lambda _: None)]
    sent = [datagram(payload, f"10.0.0.{k}") for payload in payloads for k in (1, 2)]
    both.write_bytes(pcap(sent))
    cloud = read_cloud(both, topic="10.0.0.2:10000")
    np.testing.assert_array_equal(cloud.xyz, alone.xyz)
    assert (alone.model, cloud.model) == ("VLP-16", "VLP-16")


@pytest.mark.parametrize("seed", range(12))
def test_damaged_packets_of_hesai_give_points_or_an_error(tmp_path: Path, seed: int) -> None:
    dice = random.Random(seed)
    write = dice.choice((pcap, pcapng))
    name = dice.choice(("XT16", "OT128", "Pandar40P", "AT128"))
    data = bytearray(write([datagram(payload) for payload in turning(name, 12)]))
    dice.choice((cut_at_random, flip, set_bytes))(data, dice)
    path = tmp_path / "a.pcap"
    path.write_bytes(data)
    with suppress(ReadError):
        assert len(read_cloud(path)) <= len(data)


def test_both_byte_orders_are_walked(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    packet = struct.pack(">4I", 7, 0, 20, 20) + bytes(range(20))
    head = b"\xa1\xb2\xc3\xd4" + bytes(20)
    path.write_bytes(head + packet * 3 + b"\xee" * 11 + packet * 3)
    capture = walk(path)
    assert len(capture.records) == 6
    np.testing.assert_array_equal(capture.gaps, [[CAPTURE_HEADER + 3 * 36, 11]])
