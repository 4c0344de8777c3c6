"""What the rules share: what is beside a line, on it, without tape, and how much clutter."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.extraction import surroundings as shared
from retropole.extraction.acceptance_shape import FEW_POLE_POINTS, THICK_RMS
from retropole.extraction.lines import HALF
from retropole.extraction.surroundings import Surroundings, cluttered_share, surroundings_of
from tests.extraction.synthetic import (
    BRIGHT,
    DIM,
    SEEN_BADLY,
    around,
    line_with,
    offset,
    on_pole,
    scene,
)


def about(pole: Array, *others: tuple[Array, float]) -> Surroundings:
    cloud, line = scene(pole, *others)
    assert cloud.intensity is not None
    return surroundings_of(cloud, np.arange(len(cloud)), cloud.intensity >= BRIGHT, line)


def test_a_long_slim_pole_of_many_points_is_not_suspect() -> None:
    assert not about(on_pole()).is_suspect


@pytest.mark.parametrize(("factor", "is_short"), [(0.99, True), (1.01, False)])
def test_short_is_what_a_ring_more_would_not_lengthen_enough(factor: float, is_short: bool) -> None:
    """Half a step may be missing at either end."""
    rings = 16
    length = factor * shared.SHORT_LENGTH * (rings - 1) / rings
    seen = about(on_pole(length, rings))
    assert (seen.is_short, seen.is_suspect) == (is_short, is_short)


@pytest.mark.parametrize(("factor", "is_thick"), [(0.99, False), (1.01, True)])
def test_thick_is_what_scatters_more(factor: float, is_thick: bool) -> None:
    seen = about(on_pole(width=2 * factor * THICK_RMS))
    assert (seen.is_thick, seen.is_suspect) == (is_thick, is_thick)


@pytest.mark.parametrize(("rings", "few"), [(FEW_POLE_POINTS - 1, True), (FEW_POLE_POINTS, False)])
def test_few_is_fewer_than_the_limit(rings: int, few: bool) -> None:
    seen = about(on_pole(rings=rings, each=1))
    assert (seen.has_few_points, seen.is_suspect) == (few, few)


@pytest.mark.parametrize(
    ("step", "limit"),
    [
        (0.5 * shared.MAX_BESIDE, shared.MAX_BESIDE),
        (1.2 * shared.MAX_BESIDE, 1.2 * shared.MAX_BESIDE),
    ],
)
def test_beside_is_as_far_as_the_rings_are_apart(step: float, limit: float) -> None:
    rings = 3
    seen = about(on_pole(step * (rings - 1), rings, 4))
    assert seen.beside_limit == pytest.approx(limit)


def test_beside_is_outside_the_tube_and_between_the_ends() -> None:
    pole = on_pole()
    own = about(pole).line
    limit = shared.MAX_BESIDE
    away = np.array([0.99 * own.tube, 1.01 * own.tube, 0.99 * limit, 1.01 * limit, 0.2])
    seen = about(pole, (offset(away, 0.0, np.array([0, 0, 0, 0, 0.81])), DIM))
    assert seen.beside[-5:].tolist() == [False, True, True, False, False]


@pytest.mark.parametrize(("factor", "is_untaped"), [(0.99, True), (1.01, False)])
def test_untaped_is_dimmer_than_part_of_the_dimmest_of_the_line(
    factor: float, is_untaped: bool
) -> None:
    place = around(1, 0.0, 0.005)
    seen = about(on_pole(), (place, factor * HALF * BRIGHT))
    assert seen.on_line[-1]
    assert bool(seen.untaped[-1]) is is_untaped


def test_tape_seen_badly_is_neither_bright_nor_untaped() -> None:
    seen = about(on_pole(), (around(4, 0.0, 0.005), SEEN_BADLY))
    assert not seen.is_retro[-4:].any()
    assert not seen.untaped[-4:].any()


def leaning(angle: float, count: int = 60) -> Array:
    along = np.linspace(-0.8, 0.8, count)
    return offset(0.1, 0.15 + along * np.sin(angle), along * np.cos(angle))


def test_a_pole_that_crosses_is_not_beside() -> None:
    seen = about(on_pole(), (leaning(0.25), BRIGHT))
    assert np.count_nonzero(seen.beside & seen.is_retro) > 40
    assert not seen.retro_beside.any()


def test_a_parallel_stripe_is_beside() -> None:
    seen = about(on_pole(), (leaning(0.0), BRIGHT))
    np.testing.assert_array_equal(seen.retro_beside, seen.beside & seen.is_retro)
    assert seen.retro_beside.any()


def test_a_pole_that_crosses_a_suspect_line_is_beside() -> None:
    seen = about(on_pole(width=2.1 * THICK_RMS), (leaning(0.4), BRIGHT))
    assert seen.is_thick
    assert seen.retro_beside.any()


def test_cluttered_share_counts_pieces_by_what_lies_on_the_line() -> None:
    line = line_with(80, along=np.linspace(-0.6, 0.6, 80))
    middles = (np.arange(shared.PIECES) + 0.5) / shared.PIECES * 1.2 - 0.6
    for count in range(shared.PIECES + 1):
        places = np.repeat(middles[:count], 5)
        assert cluttered_share(line, places, 0.5) == count / shared.PIECES
        assert cluttered_share(line, places, 0.51) == 0.0


def test_pieces_without_points_of_the_line_do_not_count() -> None:
    along = np.concatenate([np.linspace(-0.6, -0.4, 10), np.linspace(0.4, 0.6, 10)])
    line = line_with(20, along=along)
    assert cluttered_share(line, np.zeros(50), 0.3) == 0.0
    assert cluttered_share(line, along, 1.0) == 1.0
