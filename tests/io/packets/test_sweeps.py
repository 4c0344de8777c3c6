"""Sweeps are the same whether read in one go, in ranges, or as packets come."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.datatypes import IntArray
from retropole.io import open_recording, read_cloud
from retropole.io.packets import blocks
from retropole.io.packets.models import Blocks
from retropole.io.packets.sweeps import (
    MOST_KEPT,
    PILED,
    Sweep,
    index_of,
    live,
    positions_of,
    sweeps_of,
)
from retropole.io.recordings import time_of_recording
from tests.io.files import required
from tests.io.packets.sending import bag_of, hesai, model_named
from tests.io.packets.written import as_array, together

MODEL = model_named("Pandar40P")


def turning(packets: int, step: int = 45) -> list[bytes]:
    """Write packets of a LiDAR that turns by so many 0.01 degrees a block, and sees more each."""
    layout = MODEL.layout
    assert isinstance(layout, Blocks)
    shape = packets, layout.count, layout.channels
    raw = 100 + np.arange(np.prod(shape)).reshape(shape) % 40_000
    azimuth = (100 + np.arange(packets * layout.count).reshape(shape[:2]) * step) % 36_000
    return hesai(MODEL, raw, azimuth)


@pytest.mark.parametrize("step", [45, -45])
def test_sweeps_are_turns_of_each_channel(step: int) -> None:
    sent = turning(400, step)
    packets = as_array(sent)
    positions = positions_of(MODEL, [packets])
    whole = together(blocks.decode(MODEL, packets, None, positions))
    index = index_of(MODEL, positions, None)
    asked = list[int]()

    def read(rows: IntArray) -> Iterator[NDArray[np.uint8]]:
        asked.extend(rows.tolist())
        return (packets[rows[k : k + 30]] for k in range(0, len(rows), 30))

    sweeps = dict(sweeps_of(MODEL, None, index, range(len(index.rows)), read))
    assert asked == list(range(400))
    counts = [len(own.columns()["x"]) for own in sweeps.values()]
    assert sum(counts) == len(whole.turn)
    turn = np.clip(whole.turn, index.turns.min(), index.turns.max())
    for number, own in sweeps.items():
        np.testing.assert_array_equal(own.columns()["x"], whole.xyz[turn == index.turns[number], 0])
    assert list(index.turns) == (sorted(index.turns) if step > 0 else sorted(index.turns)[::-1])


def test_positions_do_not_depend_on_how_many_are_read_at_once() -> None:
    sent = as_array(turning(300))
    parts = (sent[k : k + 7] for k in range(0, 300, 7))
    np.testing.assert_allclose(positions_of(MODEL, parts), positions_of(MODEL, [sent]))


def test_frames_that_are_left_out_are_not_read(tmp_path: Path) -> None:
    recording = open_recording(bag_of("hesai_xt32", tmp_path))
    every = list(recording.read(range(recording.count)))
    some = list(recording.read(range(0, recording.count, 2)))
    assert [frame.number for frame in some] == [0, 2, 4]
    for frame in some:
        np.testing.assert_array_equal(frame.cloud.xyz, every[frame.number].cloud.xyz)
        assert frame.stamp == every[frame.number].stamp


@pytest.mark.parametrize("step", [45, -45])
def test_sweeps_that_come_are_those_of_a_recording(step: int) -> None:
    sent = turning(900, step)
    take = live(MODEL, None)
    came = [own for own in map(take, sent) if own is not None]
    packets = as_array(sent)
    index = index_of(MODEL, positions_of(MODEL, [packets]), None)
    recorded: dict[int, Sweep] = dict(
        sweeps_of(MODEL, None, index, range(len(index.rows)), lambda rows: iter([packets[rows]]))
    )
    # The first one began before.
    assert len(came) >= len(recorded) - 3
    for own, other in zip(came, list(recorded.values())[1:], strict=False):
        for name, values in own.columns().items():
            np.testing.assert_array_equal(values, other.columns()[name], err_msg=name)
    assert came[0].notes == ("angles of Hesai Pandar40P: the table of the model",)


def test_a_lidar_that_does_not_move_does_not_fill_the_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("retropole.io.packets.sweeps.MOST_KEPT", 500)
    take = live(MODEL, None)
    (packet,) = turning(1)
    assert all(take(packet) is None for _ in range(5000))
    cells = dict(zip(take.__code__.co_freevars, take.__closure__ or (), strict=True))
    assert len(cells["buffered"].cell_contents) <= 500 + PILED < MOST_KEPT


def test_times_of_a_clock_that_was_not_set_are_not_those_of_the_recording(tmp_path: Path) -> None:
    """The packets say 2020, the bag 2023."""
    cloud = read_cloud(bag_of("hesai_xt32", tmp_path))
    start, end = required(time_of_recording(cloud))
    assert 1_673_400_000 < start < end < start + 1
    assert float(required(cloud.time).max()) < 1.6e9
