"""Sweeps that are kept of a placement."""

from dataclasses import replace

import numpy as np

from retropole.base.datatypes import PointCloud
from retropole.io import Frame
from retropole.watching.capture import LEAST_SECONDS, MOST_SWEEPS, begun, is_elsewhere
from retropole.watching.seeing import Tracked
from tests.conftest import PoleMaker

UP = np.array([0.0, 0.0, 1.0])


def frame(number: int) -> Frame:
    return Frame(number, PointCloud(np.ones((1, 3))))


def test_it_is_full_with_enough_sweeps_of_both_over_time_enough() -> None:
    capture = begun([(), ()], 10.0)
    for k in range(5):
        capture = capture.with_frame(0, frame(k))
    assert capture.count == 0
    for k in range(5):
        capture = capture.with_frame(1, frame(k))
    assert capture.count == 5
    assert not capture.is_full(5, 10.5)
    assert capture.is_full(5, 10.0 + LEAST_SECONDS)
    assert not capture.is_full(6, 100.0)


def test_memory_is_bounded() -> None:
    capture = begun([(), ()], 0.0)
    for k in range(MOST_SWEEPS + 10):
        capture = capture.with_frame(0, frame(k)).with_frame(1, frame(k))
    assert capture.count == MOST_SWEEPS
    assert capture.is_full(10**6, 0.0)


def test_another_placement_is_told_by_its_poles(make_pole: PoleMaker) -> None:
    here = tuple(
        Tracked(k, pole, pole, 0.0, 1.0)
        for k, pole in enumerate([make_pole([5, 0, 0], UP), make_pole([5, 2, 0], UP)])
    )
    capture = begun([here, here], 1.0)
    assert not is_elsewhere(capture, [here, here], 1.0)
    # Rings meet it elsewhere.
    other = replace(here[0], pole=make_pole([5, 0, 0.2], UP))
    assert not is_elsewhere(capture, [here, (other, here[1])], 1.0)
    moved = replace(here[0], pole=make_pole([5, 0.5, 0], UP))
    assert is_elsewhere(capture, [here, (moved, here[1])], 1.0)
    assert is_elsewhere(capture, [(moved, here[1]), here], 1.0)
    # One that is not seen now says nothing.
    gone = replace(moved, seen=-10.0)
    assert not is_elsewhere(capture, [here, (gone, here[1])], 1.0)
