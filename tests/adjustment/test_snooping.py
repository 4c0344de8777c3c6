"""Data snooping: tests are the gain of another fit, and what they promise is so."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from retropole.adjustment.blunders import significant, without_blunders
from retropole.adjustment.datum import without_poles
from retropole.adjustment.shared import SharedPole
from retropole.adjustment.snooping import (
    NONCENTRALITY,
    Bias,
    Outcome,
    all_tests,
    lidar_displaced,
    outcomes,
    placement_moved,
    pole_displaced_for,
    pole_moved,
    splits,
    value_wrong,
)
from retropole.adjustment.solved import Solved
from retropole.alignment.network import Observation
from retropole.base import se3
from retropole.base.datatypes import Array, IntArray
from retropole.base.uncertainty.purpose import DEFAULT_AT
from tests.adjustment import geodetic
from tests.adjustment.adjusting import Steps
from tests.tiers import first_of

pytestmark = pytest.mark.full

Frees = Mapping[int, Sequence[int] | IntArray]
"""Of observations, by number: which of their unknowns become unknowns of their own."""


def outcome(at: Solved, error: Bias, unit: float) -> Outcome:
    (found,) = outcomes(at, [(error, unit)])
    return found


def plain(at: Solved) -> Solved:
    """The same without what widens a test: errors that are considered, and the scene's scatter."""
    nothing = np.zeros((len(at.values), 0))
    return replace(at, wide=nothing, scene=nothing)


def precision_of(at: Solved) -> Array:
    """(Z,) precision of the prior, from what is solved."""
    unknowns = at.network.unknowns
    total, _ = at.network.total()
    prior = np.linalg.inv(at.inverse) - total
    kept = np.zeros(unknowns.size)
    index = np.arange(unknowns.poses, unknowns.kept)
    kept[index] = np.diag(prior)[index]
    return kept


def cost_of(observations: Sequence[Observation], at: Solved, more: int, prior: Array) -> float:
    """Twice the least cost of all observations, with so many unknowns more."""
    size = at.network.unknowns.size
    H = np.zeros((size + more, size + more))
    g = np.zeros(size + more)
    start = np.r_[at.network.start, np.zeros(more)]
    H[:size, :size] += np.diag(prior)
    constant = 0.0
    for one in observations:
        away = start[one.place]
        H[np.ix_(one.place, one.place)] += one.information
        np.add.at(g, one.place, one.gradient + one.information @ away)
        constant += float(2 * one.gradient @ away + away @ one.information @ away)
        if one.by_value is not None:
            constant += float(one.by_value[1] @ one.by_value[1])
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    best = scale * np.linalg.lstsq(H * np.outer(scale, scale), scale * g, rcond=1e-13)[0]
    return constant + float(best @ H @ best - 2 * g @ best)


def gain_of(at: Solved, frees: Frees) -> float:
    """By how much twice the cost falls when some observations have unknowns of their own."""
    observations = list(at.network.observations)
    size = at.network.unknowns.size
    prior = precision_of(at)
    before = cost_of(observations, at, 0, prior)
    more = 0
    for k, columns in frees.items():
        one = observations[k]
        place = one.place.copy()
        place[np.asarray(columns)] = size + more + np.arange(len(columns))
        more += len(columns)
        observations[k] = replace(one, place=place)
    return before - cost_of(observations, at, more, prior)


def poles_of(one: Observation) -> list[int]:
    return [] if one.poles is None else [int(pole) for pole in one.poles]


def of_pole(one: Observation, pole: int) -> IntArray:
    poles = poles_of(one)
    first = len(one.place) - 4 * len(poles) + 4 * poles.index(pole)
    return np.arange(first, first + 4)


@pytest.fixture(scope="module")
def at(surveyed: Steps) -> Solved:
    """A site adjusted by poles and survey alone, so that its cost can be told."""
    bare = replace(surveyed, scenes=[]).again(surveyed.datum)
    assert not bare.end.scene
    return plain(bare.solved)


def cases(at: Solved) -> list[tuple[Bias, Frees]]:
    """Errors of its own, and what they free."""
    network = at.network
    returns = {k: one for k, one in enumerate(network.observations) if one.poles is not None}
    found: list[tuple[Bias, Frees]] = []
    for pole in (0, 3):
        own = {k: of_pole(one, pole) for k, one in returns.items() if pole in poles_of(one)}
        moved = pole_moved(at, pole)
        assert moved is not None
        found.append((moved, own))
        k = next(iter(own))
        found.append((pole_displaced_for(at, [returns[k]], pole), {k: own[k]}))
    for k in list(returns)[1:3]:
        found.append((placement_moved(at, returns[k]), {k: range(6)}))
    apart = lidar_displaced(at, 1)
    assert apart is not None
    own = {
        k: np.concatenate([of_pole(one, pole) for pole in poles_of(one)])
        for k, one in returns.items()
        if one.lidar == 1
    }
    found.append((apart, own))
    return found


def test_a_test_is_the_gain_of_another_fit(at: Solved) -> None:
    """With a pole, a placement, a LiDAR of its own, everything is solved anew."""
    for error, frees in cases(at):
        found = outcome(at, error, 1.0)
        assert found.chi2 == pytest.approx(gain_of(at, frees), rel=2e-3, abs=2e-3)
        assert 0.0 <= found.redundancy <= 1.0


def test_all_at_once_are_what_each_is_alone(at: Solved) -> None:
    errors = [(error, 1.0 + k) for k, (error, _) in enumerate(cases(at))]
    for (error, unit), found in zip(errors, outcomes(at, errors), strict=True):
        alone = outcome(at, error, unit)
        assert found.chi2 == pytest.approx(alone.chi2, rel=1e-9)
        assert found.redundancy == pytest.approx(alone.redundancy, abs=1e-12)
        assert found.external == pytest.approx(alone.external, rel=1e-9)


def test_a_value_is_tested_by_leaving_it_out(at: Solved) -> None:
    prior = precision_of(at)
    whole = cost_of(at.network.observations, at, 0, prior)
    for k, one in enumerate(at.network.observations):
        if one.poles is None:
            rest = [each for n, each in enumerate(at.network.observations) if n != k]
            gain = whole - cost_of(rest, at, 0, prior)
            found = outcome(at, value_wrong(at, one), 1.0)
            assert found.chi2 == pytest.approx(gain, rel=1e-3, abs=1e-3), one.name


def test_redundancies_add_up_to_observations_more_than_unknowns() -> None:
    network = geodetic.network(first_held=True)
    _, at = geodetic.adjusted(network)
    at = plain(at)
    total, count = 0.0, 0
    for one in network.observations:
        error = value_wrong(at, one)
        total += outcome(at, error, 1.0).redundancy * error.freedom
        count += error.freedom
    assert total == pytest.approx(count - 6 * (geodetic.LIDARS - 1) - 3 * geodetic.POINTS)


def test_sound_observations_are_tested_as_chance_has_it() -> None:
    network = geodetic.network()
    rng = np.random.default_rng(0)
    found: dict[int, list[float]] = {}
    for _ in range(100):
        errors = geodetic.drawn_errors(network, rng)
        _, at = geodetic.adjusted(geodetic.with_errors(network, errors))
        for k in (0, 7, 12):
            error = value_wrong(at, at.network.observations[k])
            found.setdefault(k, []).append(outcome(at, error, 1.0).chi2)
    for values in found.values():
        assert kstest(values, chi2(3).cdf).pvalue > 0.01


def test_the_least_error_that_is_found_is_found_and_moves_what_it_says() -> None:
    """With a power of 80 %, in the direction that is checked least."""
    network = geodetic.network()
    _, at = geodetic.adjusted(network)
    for k in (0, 4, 9, len(network.observations) - 1):
        one = network.observations[k]
        assert one.by_value is not None
        sigma, size = one.by_value[2], geodetic.size_of(one)
        found = outcome(plain(at), value_wrong(plain(at), one), sigma)
        assert found.minimal_detectable is not None

        def wrong_by(error: Array, k: int = k) -> Solved:
            errors = [np.zeros(geodetic.size_of(each)) for each in network.observations]
            errors[k] = error
            return plain(geodetic.adjusted(geodetic.with_errors(network, errors))[1])

        # What is left of an error among the residuals, for errors along each of its axes.
        left = np.zeros((size, size))
        for column, axis in enumerate(np.eye(size)):
            now = wrong_by(axis)
            by = now.network.observations[k].by_value
            assert by is not None
            left[:, column] = by[1] + by[0] @ now.values[one.place]
        least, way = np.linalg.eigh((left + left.T) / 2)
        error = way[:, 0] * found.minimal_detectable / sigma
        assert error @ left @ error == pytest.approx(NONCENTRALITY, rel=1e-3)
        now = wrong_by(error)
        test = outcome(now, value_wrong(now, now.network.observations[k]), sigma)
        assert test.chi2 == pytest.approx(NONCENTRALITY, rel=1e-3)
        if np.diff(least)[0] > 1e-3:
            before, after = network.state.T, now.network.state.T
            steps = np.array([se3.local(a, b) for a, b in zip(before, after, strict=True)])
            by_turn = DEFAULT_AT * np.linalg.norm(steps[:, :3], axis=1)
            moved = float((by_turn + np.linalg.norm(steps[:, 3:], axis=1)).max())
            assert found.external == pytest.approx(moved, rel=1e-2)


def test_what_nothing_checks_has_no_redundancy() -> None:
    """A point that one LiDAR alone sees and nobody surveyed."""
    network = geodetic.network()
    known = {one.name: k for k, one in enumerate(network.observations)}
    alone = {known["point 4"]} | {known[f"point 4 by {i}"] for i in (0, 1)}
    at = plain(geodetic.adjusted(network.without(alone))[1])
    (one,) = (each for each in at.network.observations if each.name == "point 4 by 2")
    found = outcome(at, value_wrong(at, one), 0.006)
    assert found.redundancy == pytest.approx(0.0, abs=1e-6)
    assert found.minimal_detectable is None or found.minimal_detectable > 10.0


def test_what_nothing_checks_is_no_test(steps: Steps) -> None:
    """In one placement without scenes nobody knows where a LiDAR would have stood in another."""
    gone = {k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1}
    bare = replace(steps, scenes=[]).again(without_poles(steps.datum, gone))
    for test in bare.tests:
        assert np.isfinite([test.chi2, test.w]).all()
        if test.kind == "placement":
            assert test.chi2 == pytest.approx(0.0, abs=1e-6)
            assert test.w == pytest.approx(0.0, abs=1e-6)
            assert test.redundancy == pytest.approx(0.0, abs=1e-6)


def test_every_observation_of_a_sound_site_is_tested_and_fits(surveyed: Steps) -> None:
    site, poles = surveyed.site, surveyed.datum.poles
    tests = list(all_tests(surveyed.adjusted.solved, site, poles, {}))
    kinds = [test.kind for test in tests]
    known = surveyed.datum.surveyed
    assert kinds.count("survey") == len(known.ends)
    assert kinds.count("control point") == len(known.known) + len(known.seen)
    assert kinds.count("lidar") == 3
    assert kinds.count("placement") == 6
    assert max(test.w for test in tests) < 4.0
    for test in tests:
        assert 0.0 <= test.redundancy <= 1.0
        assert test.minimal_detectable is None or test.minimal_detectable > 0
    of_poles = {test.pole for test in tests if test.kind == "pole" and test.lidar is None}
    assert of_poles == {k for k, pole in enumerate(poles) if len(pole.seen) > 1}


def test_what_lies_next_to_its_pole_is_reported_of_the_lidar_and_the_pole(surveyed: Steps) -> None:
    site, poles = surveyed.site, surveyed.datum.poles
    k = next(k for k, pole in enumerate(poles) if len(pole.seen) > 1)
    lidar = min(poles[k].seen)
    worst = max(
        all_tests(surveyed.adjusted.solved, site, poles, {(lidar, k): 500.0}),
        key=lambda test: test.w,
    )
    assert (worst.kind, worst.lidar, worst.pole, worst.chi2) == ("pole", lidar, k, 500.0)
    assert worst.w > 20


@pytest.mark.parametrize("count", range(2, 8))
def test_every_way_to_part_them_comes_once(count: int) -> None:
    """Each subset and what is left are one way; a single one against the rest is none of these."""
    found = [frozenset(part) for part in splits(count)]
    both = {frozenset({part, frozenset(range(count)) - part}) for part in found}
    assert len(both) == len(found) == 2 ** (count - 1) - 1 - (count if count > 2 else 1)
    assert all(min(map(len, each)) >= 2 for each in both)


def test_errors_that_are_considered_make_no_blunder_of_themselves(steps: Steps) -> None:
    at = steps.adjusted.solved
    errors: list[Callable[[Solved], Bias | None]] = [
        lambda at: pole_moved(at, 0),
        lambda at: lidar_displaced(at, 1),
    ]
    for make in errors:
        wide, narrow = make(at), make(plain(at))
        assert wide is not None
        assert narrow is not None
        assert outcome(at, wide, 1.0).chi2 <= outcome(plain(at), narrow, 1.0).chi2 + 1e-9


def pushed(pole: SharedPole, lidar: int, by: float) -> SharedPole:
    """The pole as it is, and for one LiDAR aside by so many metres."""
    own = pole.seen[lidar]
    across = np.cross(own.direction, own.point / np.linalg.norm(own.point))
    step = by * across / np.linalg.norm(across)
    moved = replace(own, xyz=own.xyz + step, point=own.point + step)
    return replace(pole, seen={**pole.seen, lidar: moved})


def of_pole_outliers(steps: Steps, k: int, lidar: int, by: float) -> Steps:
    """The same without the scene, which cannot be pushed with its poles."""
    poles = list(steps.datum.poles)
    poles[k] = pushed(poles[k], lidar, by)
    return replace(steps, datum=replace(steps.datum, poles=poles), scenes=[])


@pytest.mark.parametrize("by", first_of([0.1, 0.14, 0.4]))
def test_however_far_a_pole_is_pushed_it_is_named(steps: Steps, by: float) -> None:
    k = next(k for k, pole in enumerate(steps.datum.poles) if len(pole.seen) == 3)
    bumped = of_pole_outliers(steps, k, 1, by)
    first = bumped.again(bumped.datum)
    poor = significant(first.tests)
    assert poor
    assert max(poor, key=lambda test: test.w).pole == k
    left, reasons = without_blunders(bumped.recorded, first)
    assert [reason.code for reason in reasons] == ["pole_moved"]
    assert reasons[0].values["pole"] == steps.datum.poles[k].name(steps.site)
    assert not significant(left.tests)


def test_no_distance_makes_it_pass_for_noise(steps: Steps) -> None:
    k = next(k for k, pole in enumerate(steps.datum.poles) if len(pole.seen) == 3)
    found = []
    for by in (0.15, 0.25, 0.4):
        bumped = of_pole_outliers(steps, k, 1, by)
        found.append(max(test.w for test in bumped.again(bumped.datum).tests))
    assert min(found) > 8
