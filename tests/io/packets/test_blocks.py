"""Packets of Hesai give the points that Tier IV's driver and the manuals' tables give."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from retropole.io import read_frames
from retropole.io.packets import blocks
from retropole.io.packets.models import Blocks, recognized, rings_of
from retropole.io.pcd import read_pcd
from tests.io.files import required
from tests.io.packets.sending import REAL, bag_of, hesai, model_named
from tests.io.packets.written import together

SWEEPS = {
    "hesai_64": ("Pandar64", 1.0),
    # The driver has a slip in the time of channel 56.
    "hesai_qt64": ("PandarQT64", 0.98),
    # The driver has the two blocks of a firing 56 µs apart, the maker's own none.
    "hesai_qt128": ("QT128", 0.94),
    "hesai_xt16": ("XT16", 1.0),
    "hesai_xt32": ("XT32", 1.0),
}
"""Model, and share of the points whose times are those of the driver."""


@pytest.mark.parametrize("name", SWEEPS)
def test_real_packets_give_the_reference(name: str, tmp_path: Path) -> None:
    title, in_time = SWEEPS[name]
    path = bag_of(name, tmp_path)
    (reference,) = (REAL / name).glob("*.pcd")
    table = np.load(str(reference).replace(".pcd", "_fields.npz"))
    expected = read_pcd(reference).xyz
    frames = {len(frame.cloud): frame for frame in read_frames(path)}
    cloud = frames[len(expected)].cloud
    ring = rings_of(model_named(title).angles.elevation)[table["ring"]]
    # Of points of one ring, at one place, with one intensity, each is one.
    there = cKDTree(np.column_stack([expected, ring * 10, table["intensity"] * 1e-5]))
    ours = [cloud.xyz, required(cloud.ring) * 10, required(cloud.intensity) * 1e-5]
    difference, same = there.query(np.column_stack(ours))
    assert np.mean(difference < 1e-5) >= 0.999
    assert len(np.unique(same)) >= 0.999 * len(same)
    late = required(cloud.time) - table["time_ns"][same] / 1e9
    assert np.mean(np.abs(late) < 1e-6) >= in_time
    assert np.median(np.abs(late)) < 1e-6


@pytest.mark.parametrize("name", ["Pandar40P", "XT32M", "OT128", "JT16", "JT128", "XT32"])
def test_what_is_written_by_the_table_is_read(name: str) -> None:
    model = model_named(name)
    layout = model.layout
    assert isinstance(layout, Blocks)
    dice = np.random.default_rng(1)
    shape = 40, layout.count, layout.channels
    # Within the range of every model, and some without a return.
    raw = dice.integers(130, 14_000, shape) * (dice.random(shape) > 0.1)
    azimuth = (np.arange(40 * layout.count).reshape(shape[:2]) * 450 + 17) % 36_000
    payloads = hesai(model, raw, azimuth)
    assert all(recognized(payload) is model for payload in payloads)
    packets = np.array([list(payload) for payload in payloads], np.uint8)
    where = blocks.positions(model, packets)
    whole = np.arange(40 * layout.count).reshape(shape[:2])[:, [0, -1]] * 450 + 17
    np.testing.assert_allclose(where, whole / 36_000, atol=1e-9)
    found = together(blocks.decode(model, packets, None, where))
    order = np.argsort(found.packet, kind="stable")
    packet, block, channel = np.nonzero(raw)
    np.testing.assert_array_equal(found.packet[order], packet)
    np.testing.assert_array_equal(found.intensity[order], channel)
    turned = np.radians(azimuth[packet, block] / 100 + np.array(model.azimuth_deg)[channel])
    up = np.radians(model.elevation_deg)[channel]
    distance = raw[packet, block, channel] * 0.004
    ways = [np.cos(up) * np.sin(turned), np.cos(up) * np.cos(turned), np.sin(up)]
    np.testing.assert_allclose(found.xyz[order], distance[:, None] * np.transpose(ways), atol=1e-9)
    began = datetime(2024, 2, 3, 4, 5, 6, tzinfo=UTC).timestamp()
    firing = np.array(layout.firing_us)[0][channel]
    behind = layout.count - 1 if layout.is_counted_back else 0
    late = 100 * packet + layout.block_us + layout.step_us * (block - behind) + firing
    if name != "OT128":
        np.testing.assert_allclose(found.time[order], began + late / 1e6, atol=1e-6)
    whole_deg = np.degrees(turned) + 360 * np.floor(
        (packet * layout.count + block) * 4.5 / 360 + 0.17 / 360
    )
    np.testing.assert_array_equal(found.turn[order], np.ceil(whole_deg / 360) - 1)


def test_of_two_returns_that_are_one_the_second_is_kept() -> None:
    model = model_named("XT16")
    layout = model.layout
    assert isinstance(layout, Blocks)
    raw = np.zeros((1, 8, 16), np.int64)
    raw[0, 0, :4] = raw[0, 1, :4] = 1000
    raw[0, 0, 1:4] += [24, 26, -1000]
    packet = bytearray(hesai(model, raw, np.zeros((1, 8), np.int64))[0])
    packet[layout.returns] = 0x39
    packets = np.array([list(packet)], np.uint8)
    found = together(blocks.decode(model, packets, None, blocks.positions(model, packets)))
    assert sorted(found.intensity.tolist()) == [0, 1, 2, 2, 3]


def test_azimuths_that_go_backwards_are_counted_back() -> None:
    azimuth = np.arange(0, -80_000, -100) % 36_000
    np.testing.assert_array_equal(blocks.unwrapped(azimuth, 36_000), np.arange(0, -80_000, -100))
