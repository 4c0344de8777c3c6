"""Packets that say of each point where it is, against what their manuals say."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from retropole.io.packets.models import MODELS, Model, Points, recognized
from retropole.io.packets.points import decode, positions
from tests.io.packets.written import SECONDS, as_array, together

RNG = np.random.default_rng(8)


def _robosense(count: int, micros: int, mode: int = 4) -> bytes:
    head = bytes.fromhex("55aa5aa5") + struct.pack(">HHBB", count, 0x100, mode, 0)
    return (head + struct.pack(">HII", 0, SECONDS, micros)).ljust(32, b"\0")


def _read(packets: list[bytes]) -> tuple[Model, np.ndarray, np.ndarray]:
    """Recognize and decode: the model, (M, 5) of x, y, z, intensity and time, and turns (M,)."""
    model, sent = recognized(packets[0]), as_array(packets)
    assert model is not None
    found = together(decode(model, sent, None, positions(model, sent)))
    assert found.ring is None
    every = np.column_stack([found.xyz, found.intensity, found.time - SECONDS])
    return model, every, found.turn - found.turn[0]


def test_m1() -> None:
    packets, wanted, turns = [], [], []
    for number, count in enumerate((628, 629, 630, 1, 2)):
        body = b""
        for block in range(25):
            body += bytes([2 * block, 0])
            for _ in range(5):
                distance, value = int(RNG.integers(40, 9000)), int(RNG.integers(0, 256))
                pitch, yaw = (int(RNG.integers(-e, e)) for e in (1250, 6000))
                body += struct.pack(">HHHBBB", distance, 32768 + pitch, 32768 + yaw, value, 1, 9)
                up, aside, far = (
                    math.radians(pitch / 100),
                    math.radians(yaw / 100),
                    distance * 0.005,
                )
                out = far * math.cos(up)
                place = out * math.cos(aside), out * math.sin(aside), far * math.sin(up)
                wanted.append((*place, value, number * 158e-6 + 2 * block * 1e-6))
                turns.append(number // 3)
        packets.append(_robosense(count, number * 158) + body + bytes(3))
    model, read, turn = _read(packets)
    assert model.name == "M1"
    np.testing.assert_allclose(read, wanted, atol=2e-6)
    np.testing.assert_array_equal(turn, turns)


def test_two_returns_of_an_m1() -> None:
    body = b""
    for block in range(25):
        body += bytes([0, 1 + block % 2])
        for point in range(5):
            distance = 2000 + 10 * (block % 2) if point < 2 else 2000 + 100 * (block % 2)
            body += struct.pack(">HHHBBB", distance, 32768, 32768, block % 2, 0, 0)
    _, read, _ = _read([_robosense(1, 0, 0) + body + bytes(3)])
    # Of 12 pairs, two points of the first returns are near the second; the last has no second.
    assert np.bincount(read[:, 3].astype(int)).tolist() == [12 * 3 + 5, 12 * 5]


def test_e1() -> None:
    packets, wanted = [], []
    for number in range(3):
        body = b""
        for block in range(96):
            distance, value = int(RNG.integers(1, 9000)), int(RNG.integers(0, 256))
            way = RNG.integers(-32768, 32768, 3).tolist()
            body += struct.pack(">HHhhhBB", 300 + block, distance, *way, value, 0)
            place = [each / 32768 * distance * 0.005 for each in way]
            wanted.append((*place, value, number * 347e-6 + (300 + block) * 1e-6))
        packets.append(_robosense(1 + number, number * 347) + body + bytes(16))
    model, read, _ = _read(packets)
    assert model.name == "E1"
    np.testing.assert_allclose(read, wanted, atol=2e-6)


def _livox(kind: int, body: bytes, nanoseconds: int) -> bytes:
    """Write a packet of the second protocol, of 96 points within 475 microseconds."""
    head = struct.pack("<BHHHHBBB", 0, 36 + len(body), 4750, 96, 7, 0, kind, 1)
    return head + bytes(16) + struct.pack("<Q", nanoseconds) + body


@pytest.mark.parametrize("kind", [1, 2, 3])
def test_mid_360(kind: int) -> None:
    packets, wanted, turns = [], [], []
    for number in range(4):
        body, begins = b"", SECONDS * 10**9 + number * 49_999_000
        for k in range(96):
            value, late = int(RNG.integers(0, 256)), k * 475 / 96 * 1e-6
            if kind == 3:
                theta, phi = int(RNG.integers(100, 17900)), int(RNG.integers(0, 36000))
                body += struct.pack("<IHHBB", 5000 + k, theta, phi, value, 0)
                down, aside = math.radians(theta / 100), math.radians(phi / 100)
                out = (5 + k / 1000) * math.sin(down)
                place = [out * math.cos(aside), out * math.sin(aside)]
                place.append((5 + k / 1000) * math.cos(down))
            else:
                sent = RNG.integers(500, 3000, 3).tolist()
                body += struct.pack("<iiiBB" if kind == 1 else "<hhhBB", *sent, value, 0x10)
                place = [each * (0.001 if kind == 1 else 0.01) for each in sent]
            since = begins / 1e9 - SECONDS + late
            wanted.append((*place, value, since))
            turns.append(since // 0.1)
        packets.append(_livox(kind, body, begins))
    model, read, turn = _read(packets)
    assert model.name == "Mid-360, HAP"
    np.testing.assert_allclose(read, wanted, atol=2e-6)
    np.testing.assert_array_equal(turn, turns)


@pytest.mark.parametrize("kind", [2, 3, 4])
def test_avia(kind: int) -> None:
    """Of the first protocol; by its fourth type two returns of each firing follow each other."""
    body, wanted = b"", []
    for k in range(96):
        far = 4000 + (300 * (k % 2) if k < 48 else 20 * (k % 2))
        if kind == 3:
            body += struct.pack("<IHHBB", far, 9000, 0, k, 0)
        else:
            body += struct.pack("<iiiBB", far, 0, 0, k, 0)
        late = (k // 2 if kind == 4 else k) * 4.1667e-6
        if kind != 4 or k < 48 or k % 2:
            wanted.append((far / 1000, 0, 0, k, late))
    # A time of type 3 is a date to the hour, and microseconds.
    hour = struct.pack("<4BI", 23, 11, 14, 22, (SECONDS % 3600) * 10**6)
    for clock, sent in ((1, struct.pack("<Q", SECONDS * 10**9)), (3, hour)):
        head = struct.pack("<BBBBIBB", 5, 1, 1, 0, 0, clock, kind)
        model, read, _ = _read([head + sent + body])
        assert model.name == "Avia"
        np.testing.assert_allclose(read, wanted, atol=2e-6)


def test_nothing_seen_is_no_point() -> None:
    body = struct.pack("<iiiBB", 0, 0, 0, 0, 0) * 95 + struct.pack("<iiiBB", 1000, 0, 0, 5, 0)
    _, read, _ = _read([_livox(1, body, SECONDS * 10**9)])
    assert read[:, :4].tolist() == [[1, 0, 0, 5]]


def test_any_bytes_are_read() -> None:
    for model in MODELS:
        if isinstance(model.layout, Points):
            packets = RNG.integers(0, 256, (7, model.sizes[0]), np.uint8)
            read = together(decode(model, packets, None, positions(model, packets)))
            assert np.isfinite(read.xyz).all()
            assert len(read.xyz) <= 7 * model.layout.count * model.layout.points
