"""Captures with damaged or cut records: all other packets are read, and what is lost is said."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io import read_cloud
from retropole.io.captures import CAPTURE_HEADER, MAX_GAPS, PACKET_HEADER, walk
from tests.cli.commands import retropole_here
from tests.damage import velodyne

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
def test_the_rest_is_read_and_the_loss_is_said(
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


def test_a_loss_is_said_on_the_console_and_in_the_result(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "a.pcap"
    path.write_bytes(cut(velodyne()))
    shown = retropole_here("info", path)
    assert "note       the capture is damaged or cut: 600 of" in shown.stdout
    done = retropole_here("calibrate", path, path, "--out", tmp_path / "o", "--threshold-target", 9)
    assert f"retropole: {path}: the capture is damaged or cut" in done.stderr


def test_what_is_no_capture_at_all_is_refused_soon(tmp_path: Path) -> None:
    """Numbers that look like headers everywhere, and a capture with more gaps than packets."""
    path = tmp_path / "a.pcap"
    head = velodyne()[:CAPTURE_HEADER]
    path.write_bytes(head + struct.pack("<4I", 0, 0, 2**17, 2**17) * 100_000)
    with pytest.raises(ReadError, match=r"a\.pcap: "):
        read_cloud(path)
    packet = struct.pack("<4I", 0, 0, 8, 8) + bytes(8)
    path.write_bytes(head + (packet * 4 + b"\xff" * 7) * (MAX_GAPS + 2))
    with pytest.raises(ReadError, match=rf"is damaged at {MAX_GAPS + 1} places"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".cap"])
def test_the_suffix_changes_neither_advice_nor_reading(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"\x0a\x0d\x0d\x0a" + bytes(100))
    with pytest.raises(ReadError, match=r"is a pcapng, .*'editcap -F pcap' converts it"):
        read_cloud(path)
    path.write_bytes(velodyne())
    assert len(read_cloud(path)) > 0


def test_both_byte_orders_are_walked(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    packet = struct.pack(">4I", 7, 0, 20, 20) + bytes(range(20))
    head = b"\xa1\xb2\xc3\xd4" + bytes(20)
    path.write_bytes(head + packet * 3 + b"\xee" * 11 + packet * 3)
    capture = walk(path)
    assert len(capture.records) == 6
    np.testing.assert_array_equal(capture.gaps, [[CAPTURE_HEADER + 3 * 36, 11]])
