"""Walks that are no answer are refused for what they lack; the same walk without it is taken."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.base.systematic import Sizes
from retropole.carried.adjustment import Adjusted, adjust
from retropole.carried.linear import Seen
from retropole.carried.rows import rows_of
from retropole.carried.start import Start
from retropole.carried.verdict import STEP_SIGMAS, check_tracks, chosen
from tests.carried.walks import RADIUS, SeenWalk, axis_at, seen_walk


def adjusted(walk: SeenWalk) -> Adjusted:
    seen = [Seen(rows_of(track, None, RADIUS), Sizes()) for track in walk.tracks]
    start = Start(walk.T_target_source, walk.offset, 0.01, False)
    return adjust(start.poses, walk.tracks, seen, RADIUS)


@pytest.fixture(scope="module")
def sound() -> Adjusted:
    return adjusted(seen_walk())


def code_of(*solutions: Adjusted) -> str:
    with pytest.raises(Refusal) as refused:
        chosen(solutions)
    return refused.value.reason.code


def test_a_sound_walk_is_taken(sound: Adjusted) -> None:
    assert chosen([sound]) is sound


def test_another_solution_that_fits_as_well_is_no_answer(sound: Adjusted) -> None:
    other = replace(sound, clocks=sound.clocks + np.array([[0, 0], [0.4, 0]]), cost=sound.cost + 5)
    assert code_of(sound, other) == "several_walks_fit"
    assert chosen([sound, replace(other, cost=sound.cost + 500)]) is sound


def test_what_does_not_fit_is_refused(sound: Adjusted) -> None:
    assert code_of(replace(sound, motion=40 * np.ones(4))) == "walk_does_not_fit"
    assert code_of(replace(sound, weights=0 * sound.weights)) == "walk_does_not_fit"
    assert code_of(replace(sound, converged=False)) == "walk_does_not_fit"


def test_clocks_that_jump_are_refused(sound: Adjusted) -> None:
    steady = np.array([[2.5, 1e-4, 2e-4], [7.5, -1e-4, 2e-4]])
    jump = np.array([[0.0, 0.02, 0.0], [0.0, 0.0, 0.0]])
    none = sound.clock_windows[0]
    assert chosen([replace(sound, clock_windows=(none, steady))]) is not None
    assert code_of(replace(sound, clock_windows=(none, steady + jump))) == "clock_jumps"
    # Of a lasting step no window alone may say so.
    steps = np.array([[0.0, 0.0, 0.0], [5.0, 0.010, 0.0021]])
    assert code_of(replace(sound, clock_steps=steps)) == "clock_jumps"
    assert chosen([replace(sound, clock_steps=steps * [1, 0.8, 1])]) is not None


def test_a_step_that_may_have_happened_is_stated_with_the_clock(sound: Adjusted) -> None:
    known = float(np.sqrt(sound.covariance[6, 6]))
    for times, more in ((2.9, 0.0), (3.1, 3.1 * 0.005 / 2)):
        steps = np.array([[0.0, 0.0, 0.0], [5.0, -times * 0.005, 0.005]])
        found = replace(sound, clock_steps=steps).clock_sigmas
        assert found == pytest.approx([0.0, np.hypot(known, more)])


@pytest.mark.full
def test_a_step_of_the_clock_is_found_when_it_was() -> None:
    walk = seen_walk()
    target, source = walk.tracks
    late = 0.015 * (source.stamps > 7.0)
    stepped = walk._replace(tracks=(target, replace(source, stamps=source.stamps + late)))
    when, step, sigma = adjusted(stepped).clock_steps[1]
    assert abs(when - (7.0 - walk.offset)) <= 1.0
    assert abs(step - 0.015) < 3 * sigma
    assert step > 5 * sigma
    assert abs(adjusted(walk).clock_steps[1, 1]) < 4 * sigma


@pytest.mark.full
def test_a_stumble_that_one_lidar_alone_sees_is_no_step_of_the_clock() -> None:
    def jerked(times: Array) -> tuple[Array, Array]:
        middle, along = axis_at(times)
        return middle + 0.3 * np.clip((times - 7.0) / 0.1, 0.0, 1.0)[:, None] * [1, 1, 0], along

    walk = seen_walk(axis=jerked)
    target, source = walk.tracks
    seen = (target.times < 4.0) | (target.times > 9.5)
    kept = seen[target.sweep]
    own = {name: getattr(target, name)[seen] for name in ("times", "points", "directions")}
    of_points = {n: getattr(target, n)[kept] for n in ("xyz", "stamps", "rings", "is_whole")}
    sweep = np.unique(target.sweep[kept], return_inverse=True)[1]
    hidden = replace(target, **own, **of_points, sweep=sweep)
    _, step, sigma = adjusted(walk._replace(tracks=(hidden, source))).clock_steps[1]
    assert abs(step) < STEP_SIGMAS * sigma


def test_what_the_walk_lacked_is_named(sound: Adjusted) -> None:
    upright = replace(sound, covariance=1e4 * sound.covariance, axes=sound.axes * [1, 1, 0, 0])
    with pytest.raises(Refusal, match="hardly leaned"):
        chosen([upright])


def test_two_carried_poles_are_refused() -> None:
    target, source = seen_walk(3.0).tracks
    with pytest.raises(Refusal) as refused:
        check_tracks([target, replace(source, crowded=0.5)])
    assert refused.value.reason.code == "two_walks"
    check_tracks([target, replace(source, crowded=0.1)])
