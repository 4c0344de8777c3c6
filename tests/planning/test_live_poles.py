"""Poles followed from sweep to sweep."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, Pole
from retropole.base.sensors import find_sensor
from retropole.io import Frame
from retropole.io.live import Source
from retropole.planning.live_poles import (
    LATELY,
    LEAST_SECONDS,
    MOST_SWEEPS,
    REMEMBERED,
    Looked,
    Tracked,
    View,
    Watched,
    angle_between,
    away_from,
    begun,
    follow,
    hidden_by,
    is_new_placement,
    is_same_pair,
    look,
    present,
    seen_now,
)
from retropole.simulation import simulate_pair
from tests.conftest import PoleMaker

UP, LEANING = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.0, 1.0])
NOTHING = PointCloud(np.zeros((0, 3)))


def seen(at: float, *poles: Pole) -> Looked:
    return Looked(at, NOTHING, poles)


def followed(sweeps: list[Looked]) -> tuple[Tracked, ...]:
    tracks: tuple[Tracked, ...] = ()
    for each in sweeps:
        tracks = follow(tracks, each)
    return tracks


def test_a_pole_that_stands_is_still_after_a_second(make_pole: PoleMaker) -> None:
    rng = np.random.default_rng(0)
    sweeps = [
        seen(k / 10, make_pole([5, 0, 0], UP, sigma=0.01, rng=rng), make_pole([5, 2, 0], LEANING))
        for k in range(12)
    ]
    early, late = followed(sweeps[:5]), followed(sweeps)
    assert [each.number for each in late] == [1, 2]
    assert not any(each.is_still(0.4) for each in early)
    assert all(each.is_still(1.1) for each in late)
    assert not any(each.has_moved for each in late)
    # Nobody has seen it since.
    assert not late[0].is_still(1.1 + 2 * LATELY)


@pytest.mark.parametrize("step", [[0.0, 0.2, 0.0], [0.2, 0.0, 0.0]])
def test_a_pole_that_is_carried_keeps_its_number_and_moves(
    make_pole: PoleMaker, step: Array
) -> None:
    sweeps = [
        seen(k / 5, make_pole(np.array([5, 0, 0]) + k * np.array(step), UP)) for k in range(10)
    ]
    (track,) = followed(sweeps)
    assert track.number == 1
    assert track.has_moved
    assert not track.is_still(1.8)


def test_along_its_axis_a_pole_does_not_move(make_pole: PoleMaker) -> None:
    """Rings meet it elsewhere in each sweep."""
    sweeps = [seen(k / 5, make_pole([5, 0, 0.1 * (k % 2)], UP)) for k in range(10)]
    (track,) = followed(sweeps)
    assert not track.has_moved
    assert track.since == 0.0


def test_the_order_of_poles_in_a_sweep_changes_nothing(make_pole: PoleMaker) -> None:
    first, second = make_pole([5, 0, 0], UP), make_pole([5, 2, 0], LEANING)
    tracks = followed([seen(0.0, first, second), seen(0.1, second, first)])
    assert [each.pole for each in tracks] == [first, second]


def test_what_is_gone_is_remembered_and_then_forgotten(make_pole: PoleMaker) -> None:
    tracks = followed([seen(0.0, make_pole([5, 0, 0], UP))])
    missed = follow(tracks, seen(10.0))
    assert len(missed) == 1
    assert present(missed, 10.0) == ()
    assert follow(missed, seen(REMEMBERED + 1.0)) == ()
    # A new one takes the number that is free.
    assert [t.number for t in follow(missed, seen(10.0, make_pole([9, 0, 0], UP)))] == [1, 2]


def test_what_stands_before_a_pole_hides_it(make_pole: PoleMaker) -> None:
    pole = make_pole([6.0, 0, 0], UP)
    rng = np.random.default_rng(1)
    body = np.array([2.0, 0, 0]) + rng.uniform(-0.1, 0.1, (200, 3))
    wall = np.array([9.0, 0, 0]) + rng.uniform(-0.3, 0.3, (200, 3))
    aside = np.array([2.0, 1.0, 0]) + rng.uniform(-0.1, 0.1, (200, 3))
    assert hidden_by(PointCloud(np.concatenate([wall, aside])), pole) is None
    found = hidden_by(PointCloud(np.concatenate([wall, body])), pole)
    assert found == pytest.approx(2.0, abs=0.2)
    # What is too near to be measured leaves nothing at all.
    assert hidden_by(PointCloud(aside), pole) == 0.0
    T = se3.from_rt(Rotation.random(random_state=2).as_matrix(), np.zeros(3))
    turned = replace(
        pole,
        point=se3.apply(T, pole.point[None])[0],
        direction=T[:3, :3] @ pole.direction,
        xyz=se3.apply(T, pole.xyz),
    )
    same = hidden_by(PointCloud(se3.apply(T, np.concatenate([wall, body]))), turned)
    assert same == pytest.approx(found)


def test_the_same_two_poles_are_reported_from_any_place(make_pole: PoleMaker) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        T = se3.from_rt(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3) * 5)
        pair = make_pole([5, 0, 0], UP), make_pole([5, 2, 0], LEANING)
        moved = make_pole([5, 0, 0], UP, T=T), make_pole([5, 2, 0], LEANING, T=T)
        assert is_same_pair(pair, moved)
        assert is_same_pair(moved, pair[::-1])
        other = moved[0], make_pole([5, 3, 0], LEANING, T=T)
        assert not is_same_pair(pair, other)
        assert not is_same_pair(pair, (moved[0], make_pole([5, 2, 0], UP, T=T)))


def test_angle_and_distance(make_pole: PoleMaker) -> None:
    upright, leaning = make_pole([5, 0, 0], UP), make_pole([5, 2, 0], LEANING)
    assert angle_between([upright]) is None
    assert angle_between([upright, leaning]) == pytest.approx(np.arctan(0.5))
    flipped = replace(leaning, direction=-leaning.direction)
    assert angle_between([flipped, upright]) == pytest.approx(np.arctan(0.5))
    assert away_from(upright, make_pole([5.3, 0, 1], UP)) == pytest.approx(0.3)


@pytest.mark.full
def test_a_sweep_is_searched_for_what_may_be_a_pole() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    (sensor, _), cloud = pair.sensors, pair.target
    looked = look(cloud, 1.0, sensor=sensor, threshold=None, radius=0.02)
    assert len(looked.poles) == 2
    assert looked.doubtful == looked.dim == ()
    assert cloud.intensity is not None
    on = pair.labels[0] == len(pair.surroundings)
    dull = replace(cloud, intensity=np.where(on, 0.67 * looked.threshold, cloud.intensity))
    one = look(dull, 1.0, sensor=sensor, threshold=None, radius=0.02)
    assert len(one.poles) == 1
    assert any(away_from(found, looked.poles[k]) < 0.05 for found in one.dim for k in range(2))
    plain = look(replace(cloud, intensity=None), 1.0, sensor=sensor, threshold=None, radius=0.02)
    assert plain.refusal is not None
    assert plain.refusal.code == "no_intensity"


# --- sweeps that are kept of a placement --------------------------------------------------------


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


def test_another_placement_is_reported_by_its_poles(make_pole: PoleMaker) -> None:
    here = tuple(
        Tracked(k, pole, pole, 0.0, 1.0)
        for k, pole in enumerate([make_pole([5, 0, 0], UP), make_pole([5, 2, 0], UP)])
    )
    capture = begun([here, here], 1.0)
    assert not is_new_placement(capture, [here, here], 1.0)
    # Rings meet it elsewhere.
    other = replace(here[0], pole=make_pole([5, 0, 0.2], UP))
    assert not is_new_placement(capture, [here, (other, here[1])], 1.0)
    moved = replace(here[0], pole=make_pole([5, 0.5, 0], UP))
    assert is_new_placement(capture, [here, (moved, here[1])], 1.0)
    assert is_new_placement(capture, [(moved, here[1]), here], 1.0)
    # One that is not seen now says nothing.
    gone = replace(moved, seen=-10.0)
    assert not is_new_placement(capture, [here, (gone, here[1])], 1.0)


def test_sweeps_that_do_not_repeat_are_searched_together() -> None:
    def sizes(sensor: str) -> list[int]:
        watched = Watched(cast(Source, None), View("front", sensor=find_sensor(sensor)), None)
        sweeps = (PointCloud(np.full((5, 3), float(k)), np.arange(5.0)) for k in range(4))
        return [len(watched.accumulated(sweep)) for sweep in sweeps]

    assert sizes("Avia") == [5, 10, 10, 10]
    assert sizes("XT32") == [5, 5, 5, 5]


@pytest.mark.parametrize(("step", "words"), [(1, ""), (3, "skipped 20 of 30 sweeps of front")])
def test_sweeps_that_are_left_out_are_counted(step: int, words: str) -> None:
    source = cast(Source, SimpleNamespace(name="replay:a"))
    watched = Watched(source, View("front"), None)
    for number in range(0, 61, step):
        watched.came.append((number / 10, number))
    now = seen_now(watched, 6.0)
    assert now.sweeps_per_s == pytest.approx(10.0)
    assert now.skipped.startswith(words)
    assert bool(now.skipped) == bool(words)
    if words:
        assert now.skipped.endswith(": this computer decodes and searches 3.3 a second")
        assert not seen_now(watched, 10.0).skipped


def test_sweeps_are_counted_where_it_takes_long_to_search_one() -> None:
    watched = Watched(cast(Source, SimpleNamespace(name="replay:a")), View("rear"), None)
    watched.came.extend([(0.0, 0), (4.0, 40), (8.0, 80), (12.0, 120)])
    now = seen_now(watched, 14.5)
    assert now.sweeps_per_s == pytest.approx(10.0)
    words = "skipped 78 of 80 sweeps of rear: this computer decodes and searches 0.25 a second"
    assert now.skipped == words
    # Of one that is silent nothing is said.
    watched.view = View("rear", silent="no packet received")
    assert not seen_now(watched, 14.5).skipped
