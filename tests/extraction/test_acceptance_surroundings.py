"""Each rule of the surroundings passes a line at its limit, and fails one just beyond it."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.extraction import surroundings as rules
from retropole.extraction import surroundings as shared
from retropole.extraction.acceptance_shape import MAX_RING_EXTENT, THICK_RMS
from retropole.extraction.lines import HALF, LITTLE, MOST, Line
from retropole.extraction.surroundings import surroundings_failure
from tests.extraction.synthetic import (
    BRIGHT,
    DIM,
    SEEN_BADLY,
    UP,
    around,
    code_of,
    offset,
    on_pole,
    scene,
    upright_places,
)

EACH = 4
"""Points of the plain pole in each of its pieces: two on each of two rings."""

LENGTH = 1.6
SHORT_POINTS = 18
"""Points of the short pole."""

Other = tuple[Array, float]


def failed(scened: tuple[PointCloud, Line]) -> tuple[str, str]:
    cloud, line = scened
    assert cloud.intensity is not None
    near = np.arange(len(cloud))
    failure = surroundings_failure(cloud, near, cloud.intensity >= BRIGHT, line)
    return ("", "") if failure is None else (failure.code, failure.reason)


def pole_among(*others: Other) -> tuple[PointCloud, Line]:
    return scene(on_pole(LENGTH), *others, rings=np.repeat(np.arange(16), 2))


def short_among(*others: Other) -> tuple[PointCloud, Line]:
    return scene(on_pole(0.5, 6, 3), *others, rings=np.repeat(np.arange(6), 3))


def in_pieces(pieces: int, each: int, distance: float) -> Array:
    """So many points about the plain pole in each of its first pieces."""
    middles = LENGTH * ((np.arange(pieces) + 0.5) / shared.PIECES - 0.5)
    return np.concatenate([around(each, m, distance, k) for k, m in enumerate(middles)])


def test_a_pole_by_itself_stands_free() -> None:
    assert failed(pole_among()) == ("", "")
    assert failed(short_among()) == ("", "")


@pytest.mark.parametrize(
    ("pieces", "each", "code"),
    [
        (int(HALF * shared.PIECES), 8, ""),
        (int(HALF * shared.PIECES) + 1, 8, "part_of_a_surface"),
        (shared.PIECES, int(np.ceil(LITTLE * EACH)) - 1, ""),
        (shared.PIECES, int(np.ceil(LITTLE * EACH)), "part_of_a_surface"),
    ],
)
def test_retro_reflective_clutter_is_beside_no_more_than_half(
    pieces: int, each: int, code: str
) -> None:
    found, reason = failed(pole_among((in_pieces(pieces, each, 0.2), BRIGHT)))
    assert found == code
    assert not code or "other retro-reflective returns lie" in reason


@pytest.mark.parametrize(("others", "code"), [(1, ""), (2, "part_of_a_surface")])
def test_beside_few_points_each_retro_reflective_return_counts(others: int, code: str) -> None:
    """Of seven points a quarter is less than two."""
    pole = on_pole(LENGTH, 7, 1)
    scened = scene(pole, (around(others, 0.0, 0.2), BRIGHT), rings=np.arange(7))
    assert failed(scened)[0] == code


@pytest.mark.parametrize(("others", "code"), [(1, ""), (2, "part_of_a_surface")])
def test_the_share_of_few_points_is_of_all_of_them(others: int, code: str) -> None:
    """Asked by itself: what is about a suspect line has less of it than what is beside."""
    pole = on_pole(LENGTH, 7, 1)
    assert others - 1 <= LITTLE * 7 < 2
    cloud, line = scene(pole, (around(others, 0.0, 0.2), BRIGHT))
    is_retro = np.ones(len(cloud), dtype=bool)
    seen = shared.surroundings_of(cloud, np.arange(len(cloud)), is_retro, line)
    assert code_of(rules.retro_clutter(seen)) == code


@pytest.mark.parametrize(("angle", "code"), [(0.3, ""), (0.0, "part_of_a_surface")])
def test_a_second_pole_may_cross_and_a_parallel_stripe_may_not(angle: float, code: str) -> None:
    along = np.linspace(-0.8, 0.8, 60)
    other = offset(0.1, 0.15 + along * np.sin(angle), along * np.cos(angle))
    assert failed(pole_among((other, BRIGHT)))[0] == code


def test_no_second_pole_excuses_a_stripe() -> None:
    along = np.linspace(-0.8, 0.8, 60)
    other = offset(0.1, 0.15 + along * np.sin(0.3), along * np.cos(0.3))
    stripe = around(8, -0.7, 0.25), around(8, 0.7, 0.25)
    assert failed(pole_among((other, BRIGHT))) == ("", "")
    assert failed(pole_among(*((part, BRIGHT) for part in stripe))) == ("", "")
    both = pole_among((other, BRIGHT), *((part, BRIGHT) for part in stripe))
    assert failed(both)[0] == "part_of_a_surface"


@pytest.mark.parametrize(("extra", "code"), [(0, ""), (1, "part_of_a_surface")])
def test_few_returns_without_tape_lie_between(extra: int, code: str) -> None:
    """Between its rings they count; on its rings they are from the edges of the pole."""
    count = int(HALF * 32) + extra
    rings = np.unique(np.round(pole_among()[1].along, 3))
    between = upright_places(np.resize((rings[1:] + rings[:-1]) / 2, count))
    found, reason = failed(pole_among((between, DIM)))
    assert found == code
    assert not code or f"{count} returns without tape" in reason
    beside = upright_places(np.resize(rings[1:-1], count))
    assert failed(pole_among((beside, DIM))) == ("", "")


def test_tape_seen_badly_may_lie_between() -> None:
    between = upright_places(np.linspace(-0.7, 0.7, 60))
    assert failed(pole_among((between, SEEN_BADLY))) == ("", "")


@pytest.mark.parametrize(
    ("pieces", "each", "code"),
    [
        (int(HALF * shared.PIECES), 8, ""),
        (int(HALF * shared.PIECES) + 1, 8, "part_of_a_surface"),
        (shared.PIECES, int(np.ceil(MOST * EACH)) - 1, ""),
        (shared.PIECES, int(np.ceil(MOST * EACH)), "part_of_a_surface"),
    ],
)
def test_other_clutter_is_beside_no_more_than_half(pieces: int, each: int, code: str) -> None:
    found, reason = failed(pole_among((in_pieces(pieces, each, 0.2), DIM)))
    assert found == code
    assert not code or "along" in reason


@pytest.mark.parametrize(
    ("pieces", "code"),
    [
        (int(LITTLE * 7), ""),
        (int(LITTLE * 7) + 1, "part_of_a_surface"),
    ],
)
def test_a_suspect_line_may_have_clutter_beside_a_quarter(pieces: int, code: str) -> None:
    """Of the eight pieces, one has no point of the seven."""
    heights = np.linspace(-LENGTH / 2, LENGTH / 2, 7)[:pieces]
    others = np.concatenate([around(4, height, 0.2) for height in heights])
    assert failed(scene(on_pole(LENGTH, 7, 1), (others, DIM), rings=np.arange(7)))[0] == code


def wall(distance: float) -> Array:
    across, up = np.meshgrid(np.linspace(-0.34, 0.34, 30), np.linspace(-0.8, 0.8, 40))
    return offset(distance, across.ravel(), up.ravel())


@pytest.mark.parametrize(("distance", "code"), [(0.2, ""), (0.06, "part_of_a_surface")])
def test_a_wall_may_stand_behind_a_pole_and_not_hold_a_stripe(distance: float, code: str) -> None:
    assert failed(pole_among((wall(distance), DIM)))[0] == code


def test_no_wall_excuses_a_short_line() -> None:
    assert failed(short_among((wall(0.2), DIM)))[0] == "part_of_a_surface"


@pytest.mark.parametrize(("factor", "code"), [(0.99, "part_of_a_surface"), (1.01, "")])
def test_no_wall_excuses_what_is_close_beside_the_line(factor: float, code: str) -> None:
    near = in_pieces(shared.PIECES, 8, factor * rules.MAX_CLOSE)
    assert failed(pole_among((wall(0.2), DIM), (near, DIM)))[0] == code


def level_rows() -> tuple[PointCloud, Line]:
    """A level row of bright returns on a dim plate, scanned in rings 10 cm apart."""
    along = np.arange(-0.6, 0.6, 0.02)
    row = upright_places(along)
    others = [row + k * np.array([0.0, 0.4, 0.0]) for k in (-3, -2, -1, 1, 2, 3)]
    return scene(row, (np.concatenate(others), DIM))


def test_a_line_along_the_rings_is_no_pole() -> None:
    code, reason = failed(level_rows())
    assert code == "along_a_beam"
    assert "beams sweep" in reason


@pytest.mark.parametrize(
    ("step", "rings", "each", "code"),
    [
        (0.1, 6, 1, "along_a_beam"),
        (0.1, 6, 2, ""),
        (0.99 * MAX_RING_EXTENT, 5, 1, "along_a_beam"),
        (1.01 * MAX_RING_EXTENT, 5, 1, ""),
    ],
)
def test_a_short_line_in_single_file_is_no_pole(
    step: float, rings: int, each: int, code: str
) -> None:
    """Rings as near as this have more points each on a pole; farther apart they may have one."""
    pole = on_pole(step * (rings - 1), rings, each)
    found, reason = failed(scene(pole))
    assert found == code
    assert not code or "single file" in reason


def test_rings_excuse_single_file() -> None:
    pole = on_pole(0.5, 10, 1)
    assert failed(scene(pole))[0] == "along_a_beam"
    assert failed(scene(pole, rings=np.arange(10))) == ("", "")


@pytest.mark.parametrize("end", [-1, 1])
@pytest.mark.parametrize(
    ("pieces", "code"),
    [
        (int(np.ceil(MOST * shared.PIECES)), "goes_on_without_tape"),
        (int(np.ceil(MOST * shared.PIECES)) - 1, ""),
    ],
)
def test_a_short_pole_does_not_go_on_without_tape(end: int, pieces: int, code: str) -> None:
    middles = shared.SHORT_LENGTH * (np.arange(pieces) + 0.5) / shared.PIECES
    post = upright_places(end * (0.25 + middles))
    assert failed(short_among((post, DIM)))[0] == code
    assert failed(pole_among((post + end * 0.55 * UP, DIM))) == ("", ""), "a long one may"


def test_a_thick_short_post_may_go_on_without_tape() -> None:
    thick = on_pole(0.5, 6, 3, width=0.12)
    post = upright_places(np.linspace(0.35, 0.95, 7))
    cloud, line = scene(thick, (post, DIM), rings=np.repeat(np.arange(6), 3))
    assert line.rms > THICK_RMS
    assert failed((cloud, line)) == ("", "")
