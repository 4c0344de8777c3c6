"""Packets of LiDARs that turn, against what their manuals say and what a real one sent."""

from __future__ import annotations

import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io import read_cloud
from retropole.io.packets.interpolated import decode, positions, reported_angles
from retropole.io.packets.models import MODELS, Angles, Interpolated, Model, recognized
from tests.io.packets.written import MANUALS, SECONDS, as_array, difop, together

REAL = Path("../shared/data/packets/robosense_helios32")


def _made(
    name: str, rng: np.random.Generator, *, twice: bool = False, first: float = 359.0
) -> tuple[list[bytes], Angles, list[tuple[Any, ...]]]:
    """Write six packets, and list what they hold: place, time, turn, ring, intensity, packet."""
    manual = MANUALS[name]
    channels = 16 if "16" in name else {48: 96}.get(manual.per_block, manual.per_block)
    is_halved = twice and name in ("RS-LiDAR-16", "Helios 16P")
    up = np.round(rng.permutation(np.linspace(-24, 15, channels)), 2)
    aside = np.round(rng.uniform(-5, 5, channels), 2)
    ranks = np.argsort(np.argsort(up))
    per_row = manual.per_block * manual.blocks // (manual.rows or manual.blocks)
    step, packets, points = 0.2 * (per_row // channels if per_row > channels else 1), [], []
    step, period = (step / 2, manual.period / 2) if is_halved else (step, manual.period)
    count, row = manual.rows or manual.blocks, 0
    for number in range(6):
        rows, micros, begins = [], round(row // (1 + (twice and not is_halved)) * period), row
        for _ in range(count):
            firing = row // 2 if twice and not is_halved else row
            azimuth = first + firing * step
            distances = rng.integers(100, 1000, per_row) * 0.02
            if is_halved:
                distances[channels:] += 30
            elif twice and row % 2:
                distances += 30
            values = rng.integers(0, 256, per_row)
            rows.append((azimuth, distances.tolist(), values.tolist()))
            first_of_packet = begins // 2 if twice and not is_halved else begins
            for slot in range(per_row):
                at = slot % channels if is_halved else slot
                channel = slot % channels
                if is_halved:
                    share = manual.firing(at) / (manual.period / 2)
                    place = manual.point(
                        azimuth + step * share - step * manual.firing(at) / manual.period, step, at,
                        distances[slot], up[channel], aside[channel],
                    )  # fmt: skip
                else:
                    place = manual.point(
                        azimuth, step, at, distances[slot], up[channel], aside[channel]
                    )
                late = (firing - first_of_packet) * period + manual.firing(at)
                points.append(
                    (*place, micros + late, azimuth // 360, ranks[channel], values[slot], number)
                )
            row += 1
        last = (row - begins) / (1 + (twice and not is_halved)) * period
        packets.append(manual.packet(rows, micros, round(micros + last)))
    return packets, Angles(np.radians(up), np.radians(aside)), points


CASES = [(name, twice) for name in MANUALS for twice in (False, True)]


@pytest.mark.parametrize(("name", "twice"), CASES)
def test_written_packets_are_read(name: str, *, twice: bool) -> None:
    packets, angles, points = _made(name, np.random.default_rng(3), twice=twice)
    model = recognized(packets[0])
    assert model is not None
    assert model.name == name.removesuffix(" 16P").removesuffix(" v3")
    sent = as_array(packets)
    where = positions(model, sent)
    assert (np.diff(where[:, 0]) >= 0).all()
    read = together(decode(model, sent, angles, where))
    wanted = np.array(points, float)
    assert len(read.xyz) == len(wanted)
    np.testing.assert_allclose(read.xyz, wanted[:, :3], atol=1e-5)
    start = 0 if "v3" in name else SECONDS
    np.testing.assert_allclose(read.time - start, wanted[:, 3] * 1e-6, atol=2e-6)
    np.testing.assert_array_equal(read.turn - read.turn[0], wanted[:, 4])
    np.testing.assert_array_equal(read.ring, wanted[:, 5])
    np.testing.assert_array_equal(read.intensity, wanted[:, 6])
    np.testing.assert_array_equal(read.packet, wanted[:, 7])


def test_of_two_near_returns_the_second_remains() -> None:
    manual, angles = MANUALS["RS-LiDAR-32"], Angles(np.zeros(32), np.zeros(32))
    rows = [
        (k // 2 * 0.2, [10 + 0.05 * (k % 2)] * 16 + [10 + k % 2] * 16, [k] * 32) for k in range(12)
    ]
    sent = as_array([manual.packet(rows, 0)])
    model = recognized(sent.tobytes())
    assert model is not None
    read = together(decode(model, sent, angles, positions(model, sent)))
    assert len(read.xyz) == 6 * (16 + 32)
    assert np.bincount(read.intensity.astype(int), minlength=12).tolist() == [16, 32] * 6


def test_angles_of_the_unit() -> None:
    # The example of the maker's driver: -10.281, 2.333, 0.5 and -0.45 degrees.
    angles = struct.pack(">BHBH", 1, 0x2829, 0, 0x091D), struct.pack(">BHBH", 0, 0x1F4, 1, 0x1C2)
    rest = b"".join(struct.pack(">BH", 0, 3000 + 100 * k) for k in range(30))
    start = bytes.fromhex("a5ff005a11115555").ljust(468, b"\0")
    packet = (start + angles[0] + rest + angles[1]).ljust(1248, b"\0")
    told = reported_angles(_named("RS-LiDAR-32"), packet)
    assert told is not None
    assert "DIFOP" in told.found
    np.testing.assert_allclose(np.degrees(told.elevation[:3]), [-10.281, 2.333, 3.0])
    np.testing.assert_allclose(np.degrees(told.azimuth[:3]), [0.5, -0.45, 0])


def test_angles_of_a_helios_with_16_channels() -> None:
    up, aside = [15.0 - 2 * k for k in range(16)], [0.1 * k for k in range(16)]
    for repeated in (up, [0.0] * 16):
        told = reported_angles(_named("Helios"), difop(up + repeated, aside + aside))
        assert told is not None
        np.testing.assert_allclose(np.degrees(told.elevation), up)
        np.testing.assert_allclose(np.degrees(told.azimuth), aside)


def test_angles_of_an_rs_16_are_of_24_bits() -> None:
    up = [15 - 2 * k for k in range(8)] + [15 - 2 * k for k in range(8)]
    start = bytes.fromhex("a5ff005a11115555").ljust(1165, b"\0")
    sent = b"".join(struct.pack(">I", each * 10_000 + 500)[1:] for each in up)
    told = reported_angles(_named("RS-LiDAR-16"), (start + sent).ljust(1248, b"\0"))
    assert told is not None
    wanted = [-(each + 0.05) for each in up[:8]] + [each + 0.05 for each in up[8:]]
    np.testing.assert_allclose(np.degrees(told.elevation), wanted)
    # One that was never filled says nothing; the table is right then.
    assert reported_angles(_named("RS-LiDAR-16"), start.ljust(1248, b"\0")) is None


def test_angles_of_a_leishen_of_version_3() -> None:
    """Elevations of 16 bits from byte 245, in the order of their size; azimuths of two groups."""
    wanted = np.ravel(np.column_stack([np.arange(-16, 0), np.arange(16)])) + 0.07
    sorted_by_size = np.sort(wanted)
    words = np.round(sorted_by_size * 100).astype(">i2").tobytes()
    packet = bytearray(bytes.fromhex("a5ff005a").ljust(1206, b"\0"))
    packet[245 : 245 + len(words)] = words
    packet[186:188], packet[190:192] = struct.pack(">H", 130), struct.pack(">H", 0x8000 + 150)
    (model,) = [each for each in MODELS if each.name == "C32" and each.sizes == (1206,)]
    told = reported_angles(model, bytes(packet))
    assert told is not None
    np.testing.assert_allclose(np.degrees(told.elevation), wanted, atol=1e-9)
    np.testing.assert_allclose(np.degrees(told.azimuth), [-1.5, -1.5, 1.3, 1.3] * 8)


def test_without_angles() -> None:
    packets, _, _ = _made("Bpearl", np.random.default_rng(1))
    sent, model = as_array(packets), _named("Bpearl")
    with pytest.raises(
        ReadError, match=r"RoboSense Bpearl sends .* in DIFOP packets, .* --angles FILE"
    ):
        together(decode(model, sent, None, positions(model, sent)))


def test_angles_of_another_model() -> None:
    packets, _, _ = _made("Ruby", np.random.default_rng(1))
    sent, other = as_array(packets), Angles(np.zeros(32), np.zeros(32), "angles.csv")
    with pytest.raises(ReadError, match=r"angles.csv has 32 channels, a RoboSense Ruby 128"):
        together(decode(_named("Ruby"), sent, other, positions(_named("Ruby"), sent)))


def test_any_bytes_are_read() -> None:
    rng = np.random.default_rng(5)
    for model in MODELS:
        if not isinstance(model.layout, Interpolated):
            continue
        packets = rng.integers(0, 256, (7, model.sizes[0]), np.uint8)
        channels = len(model.layout.firing_us) * model.layout.together
        angles = Angles(np.zeros(channels), np.zeros(channels))
        read = together(decode(model, packets, angles, positions(model, packets)))
        assert np.isfinite(read.xyz).all()
        assert len(read.xyz) <= 7 * model.layout.count * model.layout.channels
        reported_angles(model, packets[0].tobytes())


def _named(name: str) -> Model:
    return next(each for each in MODELS if each.name == name)


@pytest.mark.skipif(not REAL.exists(), reason="real packets are not here")
def test_a_real_helios() -> None:
    packets: list[bytes] = []
    told: list[bytes] = []
    with sqlite3.connect(f"file:{REAL / 'packets.db3'}?mode=ro&immutable=1", uri=True) as bag:
        for (data,) in bag.execute("SELECT data FROM messages ORDER BY timestamp"):
            (length,) = struct.unpack_from("<I", data, 12)
            at = 16 + length
            at += -at % 4
            (count,) = struct.unpack_from("<I", data, at)
            at += 4
            for _ in range(count):
                content = data[at + 9 : at + 9 + 1248]
                (told if data[at + 8] else packets).append(content)
                at += 1512 + 4
    model = recognized(packets[0])
    assert model is not None
    angles = reported_angles(model, told[0])
    sent = as_array(packets)
    read = together(decode(model, sent, angles, positions(model, sent)))
    cloud = read_cloud(next(REAL.glob("*.pcd")))
    fields = np.load(next(REAL.glob("*_fields.npz")))
    own = read.turn == read.turn[0] + 1
    assert own.sum() == len(cloud)
    np.testing.assert_allclose(read.xyz[own], cloud.xyz, atol=1e-4)
    assert read.ring is not None
    for name in ("ring", "intensity", "packet"):
        np.testing.assert_array_equal(getattr(read, name)[own], fields[name])
    np.testing.assert_allclose(read.time[own], fields["time_ns"] / 1e9, atol=1e-6)
