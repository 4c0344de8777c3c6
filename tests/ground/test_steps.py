"""Which level is below the LiDARs, and what is a step."""

import numpy as np

from retropole.base.datatypes import Array
from retropole.ground.steps import CELL, _below, _is_step, _split, at_steps, is_around

ROWS = np.stack(np.meshgrid(np.arange(-20, 20), np.arange(-20, 20)), axis=-1).reshape(-1, 2)
AT: Array = np.asarray((ROWS + 0.5) * CELL, dtype=np.float64)


def test_two_levels_are_parted_and_what_is_between_is_of_none() -> None:
    upper = AT[:, 1] > 2
    z = np.where(upper, 0.12, 0.0) + 0.02 * AT[:, 0]
    z[:20] += 0.06
    guess = np.random.default_rng(1).uniform(size=len(z)) < np.where(upper, 0.8, 0.2)
    parted = _split(np.c_[AT, z], np.ones(len(z), dtype=bool), [guess])
    assert parted is not None
    assert not parted[0][:20].any()
    assert (parted[0][20:] == ~upper[20:]).all()
    assert (parted[1] == upper).all()
    assert _split(np.c_[AT, 0.1 * AT[:, 1]], np.ones(len(z), dtype=bool), [upper]) is None


def test_a_slope_between_two_levels_is_no_step() -> None:
    y = AT[:, 1]
    lower, upper = y < -2, y > 2
    steep = np.clip(y, -4, 4) * 0.03
    assert not _is_step(np.c_[AT, steep], lower, upper)
    assert not _is_step(np.c_[AT, 0.12 * lower], lower, upper)
    assert _is_step(np.c_[AT, 0.12 * (y > 1)], y < 0, y > 1)


def test_the_level_along_the_kerb_goes_on_below() -> None:
    seen = np.hypot(*AT.T) > 5
    for turn in (0.0, 0.7):
        across = AT @ [-np.sin(turn), np.cos(turn)]
        for edge in (-2.0, 2.0):
            upper = across > edge
            assert _below(AT, seen & ~upper, seen & upper) == (edge < 0)
    # At the kerb itself nothing tells.
    assert _below(AT, seen & (AT[:, 1] < 0), seen & (AT[:, 1] > 0)) is None


def test_a_kerb_is_found_and_a_slope_is_not() -> None:
    heights = np.where(np.arange(30) < 15, 0.0, 0.1)[:, None] + np.zeros(30)
    edge = at_steps(heights)
    assert edge[14:16, 5:-5].all()
    assert not edge[:10].any()
    assert not at_steps(0.05 * CELL * np.arange(30)[:, None] + np.zeros(30)).any()


def test_places_on_one_side_are_not_around() -> None:
    assert is_around(AT)
    assert not is_around(AT[AT[:, 0] > 0])
