"""Packets of an AT128 are decoded as its manual says, with the corrections of the unit."""

import struct
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io.packets import mirrors
from retropole.io.packets.angles import read_angles
from retropole.io.packets.models import recognized
from tests.io.packets.sending import hesai, model_named
from tests.io.packets.written import together

MODEL = model_named("AT128")
UNIT = 25_600
"""Of a correction file, units of a degree, as of azimuths of the packets."""


def corrections(path: Path, starts: list[float], azimuth_adjust: int = 0) -> Path:
    """Write a correction file: channel c looks up by c / 10 - 6 degrees, and aside by -c / 100."""
    data = b"\xee\xff\x01\x05\x80\x03\x03" + bytes(8) + b"\x01"
    data += struct.pack("<3I", *(round(each * UNIT) for each in starts))
    data += struct.pack("<3I", *(round(each * UNIT) for each in [*starts[1:], starts[0]]))
    data += struct.pack("<128i", *(c * UNIT // 100 for c in range(128)))
    data += struct.pack("<128i", *((c - 60) * UNIT // 10 for c in range(128)))
    data += struct.pack("<b", azimuth_adjust) * (128 * 180) + bytes(128 * 180)
    path.write_bytes(data + bytes(32))
    return path


@pytest.mark.parametrize("adjusted", [0, 40, -7])
def test_a_beam_turns_twice_as_far_as_its_mirror(tmp_path: Path, adjusted: int) -> None:
    starts = [20.0, 140.0, 260.0]
    angles = read_angles(corrections(tmp_path / "a.dat", starts, adjusted), MODEL)
    assert angles.found == "a.dat"
    mirror = np.array([[40.0, 60.25], [160.5, 200.0], [300.0, 299.0], [40.0, 50.0]])
    raw = np.full((4, 2, 128), 2500)
    payloads = hesai(MODEL, raw, (mirror * UNIT).astype(np.int64))
    assert all(recognized(payload) is MODEL for payload in payloads)
    packets = np.array([list(payload) for payload in payloads], np.uint8)
    where = mirrors.positions(MODEL, packets)
    found = together(mirrors.decode(MODEL, packets, angles, where))
    np.testing.assert_array_equal(found.turn, np.repeat([0, 1, 2, 3], 256))
    field = np.repeat(starts + starts[:1], 2).reshape(4, 2)
    c = np.arange(128)
    turned = np.radians(2 * (mirror - field)[..., None] - c / 100 + adjusted / 100)
    up = np.radians((c - 60) / 10)
    ways = [np.cos(up) * np.sin(turned), np.cos(up) * np.cos(turned), np.sin(up) + 0 * turned]
    np.testing.assert_allclose(found.xyz, np.stack(ways, -1).reshape(-1, 3) * 10, atol=1e-6)
    np.testing.assert_array_equal(found.ring, np.tile(c, 8))


def test_other_files_are_no_corrections(tmp_path: Path) -> None:
    path = corrections(tmp_path / "a.dat", [20.0, 140.0, 260.0])
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ReadError, match=r"a\.dat: has 1000 bytes, expected 47"):
        read_angles(path, MODEL)
    path.write_bytes(b"Channel,Elevation,Azimuth\n1,2,3\n")
    with pytest.raises(ReadError, match="not a correction file"):
        read_angles(path, MODEL)
