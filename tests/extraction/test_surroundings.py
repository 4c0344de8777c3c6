"""What the rules share: what is beside a line, on it, without tape, and how much clutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array, Detection, PointCloud
from retropole.extraction import surroundings
from retropole.extraction import surroundings as rules
from retropole.extraction import surroundings as shared
from retropole.extraction.acceptance_shape import FEW_POLE_POINTS, THICK_RMS
from retropole.extraction.lines import HALF, LITTLE, MAX_NEIGHBOUR_DISTANCE, MOST, SEARCH_ROOM, Line
from retropole.extraction.poles import extract_poles
from retropole.extraction.surroundings import (
    Surroundings,
    cluttered_share,
    is_wall_behind,
    on_crossing_line,
    runs_along_sweep,
    surroundings_failure,
    surroundings_of,
)
from retropole.simulation import Box, Cylinder, Rectangle, Surface
from tests.extraction.scenes import PAINT, TAPE, Y, Z, pole, seen
from tests.extraction.synthetic import (
    BRIGHT,
    DIM,
    FOOT,
    SEEN_BADLY,
    UP,
    around,
    code_of,
    line_with,
    offset,
    on_pole,
    scene,
    upright_places,
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
        (0.5 * MAX_NEIGHBOUR_DISTANCE, MAX_NEIGHBOUR_DISTANCE),
        (1.2 * MAX_NEIGHBOUR_DISTANCE, 1.2 * MAX_NEIGHBOUR_DISTANCE),
    ],
)
def test_next_to_is_as_far_as_the_rings_are_apart(step: float, limit: float) -> None:
    rings = 3
    seen = about(on_pole(step * (rings - 1), rings, 4))
    assert seen.neighbour_limit == pytest.approx(limit)


def test_neighbours_are_outside_the_tube_and_between_the_ends() -> None:
    pole = on_pole()
    own = about(pole).line
    limit = MAX_NEIGHBOUR_DISTANCE
    away = np.array([0.99 * own.tube, 1.01 * own.tube, 0.99 * limit, 1.01 * limit, 0.2])
    seen = about(pole, (offset(away, 0.0, np.array([0, 0, 0, 0, 0.81])), DIM))
    assert seen.nearby[-5:].tolist() == [False, True, True, False, False]


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


def test_a_pole_that_crosses_is_no_neighbour() -> None:
    seen = about(on_pole(), (leaning(0.25), BRIGHT))
    assert np.count_nonzero(seen.nearby & seen.is_retro) > 40
    assert not seen.retro_neighbours.any()


def test_a_parallel_stripe_is_a_neighbour() -> None:
    seen = about(on_pole(), (leaning(0.0), BRIGHT))
    np.testing.assert_array_equal(seen.retro_neighbours, seen.nearby & seen.is_retro)
    assert seen.retro_neighbours.any()


def test_a_pole_that_crosses_a_suspect_line_is_a_neighbour() -> None:
    seen = about(on_pole(width=2.1 * THICK_RMS), (leaning(0.4), BRIGHT))
    assert seen.is_thick
    assert seen.retro_neighbours.any()


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


CROSSING_TUBE = DEFAULT_RADIUS + SEARCH_ROOM


def crossing(angle: float, count: int = 30) -> Array:
    """Points of a line that crosses the upright one, some away from it."""
    along = np.linspace(0.3, 1.0, count)
    return offset(0.05, along * np.sin(angle), along * np.cos(angle))


@pytest.mark.parametrize(
    ("factor", "is_crossing"), [(0.98, False), (1.02, True), (3.0, True), (8.0, True)]
)
def test_another_line_is_one_at_an_angle(factor: float, is_crossing: bool) -> None:
    nearby = crossing(factor * surroundings.MIN_CROSSING_ANGLE)
    assert on_crossing_line(nearby, line_with()).tolist() == [is_crossing] * len(nearby)


def test_what_lies_off_the_other_line_is_not_on_it() -> None:
    other = crossing(0.5)
    off = other[::5] + np.array([0, 2 * CROSSING_TUBE / np.cos(0.5), 0])
    on_it = on_crossing_line(np.concatenate([other, off]), line_with())
    assert on_it[: len(other)].all()
    assert not on_it[len(other) :].any()


def test_the_other_line_is_fitted_to_all_its_points() -> None:
    """Through the two points that propose it, some of the others would be missed."""
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, CROSSING_TUBE / 4, (60, 3))
        assert on_crossing_line(crossing(0.5, 60) + noise, line_with()).all()


def test_points_near_each_other_are_no_other_line() -> None:
    near = offset(0, 0.2, 0) + np.random.default_rng(0).uniform(0, 0.1, (20, 3))
    assert not on_crossing_line(near, line_with()).any()


def wall(distance: float, width: float = 0.35) -> Array:
    """Points on both sides of the pole, on a plane that passes it at some distance."""
    across, up = np.meshgrid(np.linspace(-width, width, 12), np.linspace(-0.8, 0.8, 20))
    return offset(distance, across.ravel(), up.ravel())


@pytest.mark.parametrize(("factor", "is_behind"), [(0.99, False), (1.01, True)])
def test_a_wall_is_behind_from_some_distance(factor: float, is_behind: bool) -> None:
    assert is_wall_behind(wall(factor * surroundings.MAX_CLOSE), on_pole(width=0)) is is_behind


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_pole_that_leans_on_a_wall_leaves_it_in_part(share: float) -> None:
    """The wall is behind as far as the quantile of its distances says."""
    far = int(share * (1 - MOST) * 100)
    away = np.repeat([-1.1 * surroundings.MAX_CLOSE, 0.0], [far, 100 - far])
    assert is_wall_behind(wall(0.0), offset(away, 0.0, 0.0)) is (share > 1)


@pytest.mark.parametrize(("extra", "is_wall"), [(0.95, True), (1.05, False)])
def test_a_wall_is_most_of_the_neighbours(extra: float, is_wall: bool) -> None:
    plane = wall(0.2)
    count = int(extra / 2 * len(plane) * (1 / MOST - 1))
    # In pairs, as far before the plane as behind it, so that they do not draw it away.
    off = np.array([1.5 * SEARCH_ROOM, 0, 0])
    pairs = [plane[:count] + off, plane[:count] - off]
    assert is_wall_behind(np.concatenate([plane, *pairs]), on_pole(width=0)) is is_wall


@pytest.mark.parametrize("before", [0.15, 0.2, 0.3])
def test_a_quarter_of_clutter_before_a_wall_does_not_hide_it(before: float) -> None:
    plane = wall(0.2)
    clutter = offset(0.2 - before, 0.35, np.linspace(-0.8, 0.8, len(plane) // 4))
    assert is_wall_behind(np.concatenate([plane, clutter]), on_pole(width=0))


def test_a_corner_is_no_wall() -> None:
    _, aside, up = (wall(0.0) - FOOT).T
    assert not is_wall_behind(offset(0.1 + 2 * np.abs(aside), aside, up), on_pole(width=0))


def scan_rows(ring_step: float, point_step: float = 0.01) -> Array:
    """Returns of a wall: rings one above the other, points next to each other on each."""
    across, up = np.meshgrid(np.arange(-0.4, 0.4, point_step), ring_step * np.arange(-3, 4))
    return offset(0.0, across.ravel(), up.ravel())


@pytest.mark.parametrize(("angle", "runs"), [(0.0, True), (np.pi / 2, False)])
def test_a_line_along_the_rings_runs_along_a_sweep(angle: float, runs: bool) -> None:
    """Level along the rings, or across them; nothing asks which way is up."""
    rotation = se3.exp_so3(np.array([np.pi / 2 - angle, 0, 0]))
    own = FOOT + (on_pole(0.6, 10, 1) - FOOT) @ rotation.T
    xyz = np.concatenate([own, scan_rows(0.1)])
    line = replace(line_with(10), direction=rotation @ UP)
    assert runs_along_sweep(xyz, np.arange(len(xyz)), line) is runs


@pytest.mark.parametrize(("level", "runs"), [(True, True), (False, False)])
def test_range_noise_of_most_of_a_step_hides_no_sweep(level: bool, runs: bool) -> None:
    rows = scan_rows(0.1)
    rows[:, 0] += np.random.default_rng(0).normal(0, 0.007, len(rows))
    line = replace(line_with(10), direction=Y if level else UP)
    xyz = np.concatenate([on_pole(0.6, 10, 1), rows])
    assert runs_along_sweep(xyz, np.arange(len(xyz)), line) is runs


def test_rings_as_close_as_their_returns_tell_nothing() -> None:
    rows = scan_rows(0.01)
    xyz = np.concatenate([on_pole(0.6, 10, 1), rows])
    assert not runs_along_sweep(xyz, np.arange(len(xyz)), line_with(10))


def test_few_returns_tell_nothing() -> None:
    least = 2 * surroundings.SWEEP_NEIGHBOURS
    column = offset(0.0, 0.2, np.linspace(0, 0.02 * (least - 1), least))
    xyz = np.concatenate([on_pole(0.6, 10, 1), column])
    assert runs_along_sweep(xyz, np.arange(len(xyz)), line_with(10))
    assert not runs_along_sweep(xyz, np.arange(len(xyz) - 1), line_with(10))


GROUND_HEIGHT = -1.2
BAND = Cylinder(np.array([4.0, 0.0, -0.1]), Z, 0.02, 0.8, TAPE)


def person(
    behind: float, height: float = 1.75, aside: float = 0.0, above_ground: float = 0.0
) -> Box:
    """A body whose front is so far behind the band, metres."""
    half = np.array([0.12, 0.22, (height - above_ground) / 2])
    at = np.array([4.0 + behind + half[0], aside, GROUND_HEIGHT + above_ground + half[2]])
    return Box(at, np.eye(3), half, PAINT)


def found(things: list[Surface], sensor: str = "XT32") -> Detection:
    return extract_poles(seen(things, sensor)[0])


def is_worn(detection: Detection) -> bool:
    """Whether the one line there is is a band; else it is a confirmed pole."""
    assert len(detection.poles) + len(detection.candidates) == 1
    codes = {cluster.code for cluster in detection.rejected}
    assert (len(detection.candidates) == 1) == ("on_a_body" in codes)
    return "on_a_body" in codes


@pytest.mark.parametrize("sensor", ["XT32", "HDL-32E"])
@pytest.mark.parametrize("behind", [0.2, 0.35, 0.5])
def test_a_band_that_a_person_holds_is_doubtful(sensor: str, behind: float) -> None:
    assert is_worn(found([BAND, person(behind)], sensor))


def test_a_band_alone_is_sure() -> None:
    assert not is_worn(found([BAND]))


@pytest.mark.parametrize("aside", [-0.45, 0.45])
def test_a_pole_with_a_person_next_to_it_is_sure(aside: float) -> None:
    assert not is_worn(found([pole((4, 0)), person(-0.1, aside=aside)]))


def test_a_body_must_go_on_beyond_both_ends() -> None:
    top = BAND.centre[2] + BAND.length / 2 - GROUND_HEIGHT
    assert not is_worn(found([BAND, person(0.3, height=top)]))
    assert not is_worn(found([BAND, person(0.3, above_ground=top - BAND.length)]))


def test_a_body_farther_off_says_nothing() -> None:
    assert not is_worn(found([BAND, person(surroundings.BODY_REACH + 0.1)]))


def test_what_has_no_air_about_it_is_no_body() -> None:
    wall = Rectangle(np.array([4.35, 0, 0.3]), Y, Z, (3.0, 1.5), PAINT)
    assert not is_worn(found([BAND, wall]))


def test_a_rigid_motion_changes_nothing() -> None:
    cloud, _ = seen([BAND, person(0.3)])
    T = se3.from_rt(se3.exp_so3(np.array([0.4, -1.1, 2.0])), np.array([3.0, -2.0, 1.0]))
    assert is_worn(extract_poles(cloud.transformed(T)))
    shuffled = np.random.default_rng(0).permutation(len(cloud))
    assert is_worn(extract_poles(replace(cloud, ring=None).select(shuffled)))


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
    failure = surroundings_failure(surroundings_of(cloud, near, cloud.intensity >= BRIGHT, line))
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
def test_retro_reflective_clutter_is_next_to_no_more_than_half(
    pieces: int, each: int, code: str
) -> None:
    found, reason = failed(pole_among((in_pieces(pieces, each, 0.2), BRIGHT)))
    assert found == code
    assert not code or "other retro-reflective returns lie" in reason


@pytest.mark.parametrize(("others", "code"), [(1, ""), (2, "part_of_a_surface")])
def test_next_to_few_points_each_retro_reflective_return_counts(others: int, code: str) -> None:
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
    nearby = upright_places(np.resize(rings[1:-1], count))
    assert failed(pole_among((nearby, DIM))) == ("", "")


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
def test_other_clutter_is_next_to_no_more_than_half(pieces: int, each: int, code: str) -> None:
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
def test_a_suspect_line_may_have_clutter_next_to_a_quarter(pieces: int, code: str) -> None:
    """Of the eight pieces, one has no point of the seven."""
    heights = np.linspace(-LENGTH / 2, LENGTH / 2, 7)[:pieces]
    others = np.concatenate([around(4, height, 0.2) for height in heights])
    assert failed(scene(on_pole(LENGTH, 7, 1), (others, DIM), rings=np.arange(7)))[0] == code


def wall_acceptance_surroundings(distance: float) -> Array:
    across, up = np.meshgrid(np.linspace(-0.34, 0.34, 30), np.linspace(-0.8, 0.8, 40))
    return offset(distance, across.ravel(), up.ravel())


@pytest.mark.parametrize(("distance", "code"), [(0.2, ""), (0.06, "part_of_a_surface")])
def test_a_wall_may_stand_behind_a_pole_and_not_hold_a_stripe(distance: float, code: str) -> None:
    assert failed(pole_among((wall_acceptance_surroundings(distance), DIM)))[0] == code


def test_no_wall_excuses_a_short_line() -> None:
    assert failed(short_among((wall_acceptance_surroundings(0.2), DIM)))[0] == "part_of_a_surface"


@pytest.mark.parametrize(("factor", "code"), [(0.99, "part_of_a_surface"), (1.01, "")])
def test_no_wall_excuses_what_is_close_next_to_the_line(factor: float, code: str) -> None:
    near = in_pieces(shared.PIECES, 8, factor * rules.MAX_CLOSE)
    assert failed(pole_among((wall_acceptance_surroundings(0.2), DIM), (near, DIM)))[0] == code


def level_rows() -> tuple[PointCloud, Line]:
    """A level row of bright returns on a dim plate, scanned in rings 10 cm apart."""
    along = np.arange(-0.6, 0.6, 0.02)
    row = upright_places(along)
    others = [row + k * np.array([0.0, 0.4, 0.0]) for k in (-3, -2, -1, 1, 2, 3)]
    return scene(row, (np.concatenate(others), DIM))


def test_a_line_along_the_rings_is_no_pole() -> None:
    code, reason = failed(level_rows())
    assert code == "along_a_beam"
    assert "sweep of the beams" in reason


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
