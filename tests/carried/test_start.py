"""Starts from exact tracks: near the truth, whatever the clocks and the signs of directions."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.carried.start import find_starts
from tests.carried.walks import seen_walk


@pytest.mark.parametrize("sign", [pytest.param(1.0, marks=pytest.mark.full), -1.0])
def test_a_start_is_near_the_truth_with_either_sign(sign: float) -> None:
    walk = seen_walk(8.0, offset=-1.37)
    target, source = walk.tracks
    source = replace(source, directions=sign * source.directions)
    best = find_starts(target, source)[0]
    off = se3.difference(walk.T_target_source, best.T_target_source)
    assert best.flipped is (sign < 0)
    assert abs(best.offset - walk.offset) < 0.003
    assert off.rotation < np.radians(0.3)
    assert off.translation < 0.03


def test_tracks_that_do_not_overlap_give_no_start() -> None:
    target, source = seen_walk().tracks
    assert find_starts(target, replace(source, times=source.times + 60.0)) == []
