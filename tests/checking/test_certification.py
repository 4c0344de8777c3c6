"""The field test of two LiDARs, on simulated recordings and on made-up distances."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import Array, Placement, Pole
from retropole.base.description import Site, SiteLidar
from retropole.base.errors import Refusal
from retropole.checking.certification import (
    ALPHA,
    FieldTest,
    PolesSeen,
    certify,
    certify_site,
    compare,
    correspond,
    quantile,
)
from retropole.checking.distances import Measured
from retropole.simulation import SimulatedPair, place_again
from tests.checking.certifying import RADIUS, found_in, four_poles
from tests.conftest import PoleMaker


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return four_poles()


@pytest.fixture(scope="module")
def placement(pair: SimulatedPair) -> Placement:
    return found_in(pair)


@pytest.fixture(scope="module")
def healthy(placement: Placement) -> FieldTest:
    return certify([placement], radius=RADIUS)


@pytest.mark.full
def test_lidars_that_measure_as_stated_pass(healthy: FieldTest) -> None:
    assert healthy.status == "pass"
    assert healthy.poles == (PolesSeen(4, 4, 4),)
    assert len(healthy.distances) == 6
    assert healthy.z == pytest.approx(quantile(ALPHA, 6))
    assert healthy.spread is not None
    assert healthy.spread.target.sweeps == healthy.spread.source.sweeps == 3
    assert healthy.z is not None
    for each in healthy.distances:
        assert each.passed
        assert each.difference_m == pytest.approx(each.target_m - each.source_m)
        together = np.hypot(each.u_target_m, each.u_source_m)
        assert 2 * each.u_end_m == pytest.approx(together, rel=0.05)
        assert each.limit_m == pytest.approx(2 * each.u_end_m * healthy.z)
        assert 0 < each.random_target_m < each.u_target_m


@pytest.mark.full
def test_distances_are_near_those_of_the_poles(pair: SimulatedPair, healthy: FieldTest) -> None:
    between = [
        float(np.linalg.norm(a.centre - b.centre))
        for k, a in enumerate(pair.poles)
        for b in pair.poles[k + 1 :]
    ]
    # From another height of leaning poles.
    found = sorted(each.target_m for each in healthy.distances)
    assert found == pytest.approx(sorted(between), abs=0.4)


@pytest.mark.full
def test_where_the_lidars_stand_makes_no_difference(
    placement: Placement, healthy: FieldTest
) -> None:
    # The frame of the source's file is another one, and the roles change.
    other = certify([Placement(placement.source, placement.target)], radius=RADIUS)
    assert sorted(abs(e.difference_m) for e in other.distances) == pytest.approx(
        sorted(abs(e.difference_m) for e in healthy.distances), abs=1e-4
    )


@pytest.mark.full
def test_a_gross_error_of_the_scale_fails(pair: SimulatedPair) -> None:
    bad = replace(pair.devices[1], scale=0.02)
    again = record_again(
        replace(pair, devices=(pair.devices[0], bad)), np.random.default_rng(5), frames=3
    )
    answer = certify([found_in(again)], radius=RADIUS)
    assert answer.status == "fail"
    assert any(not each.passed and each.difference_m < 0 for each in answer.distances)


@pytest.mark.full
def test_a_pole_that_moved_between_the_recordings_fails(pair: SimulatedPair) -> None:
    first, *others = pair.poles
    moved = replace(first, centre=first.centre + np.array([0.06, 0.06, 0.0]))
    after = record_again(replace(pair, poles=(moved, *others)), np.random.default_rng(6), frames=3)
    answer = certify([found_in(replace(pair, source=after.source))], radius=RADIUS)
    assert answer.status == "fail"
    # All that failed have one pole in common.
    failed = [set(each.poles) for each in answer.distances if not each.passed]
    assert failed
    assert set.intersection(*failed)


@pytest.mark.full
def test_one_distance_is_too_few_and_placements_add_up(pair: SimulatedPair) -> None:
    three = four_poles(seed=4, frames=1, poles=3)
    one = certify([found_in(three)], radius=RADIUS)
    assert one.status == "refused"
    assert [reason.code for reason in one.reasons] == ["too_few_distances"]
    assert one.reasons[0].values == {"distances": 3, "needed": 4}
    assert one.distances == ()
    again = place_again(three, np.random.default_rng(8))
    both = certify([found_in(three), found_in(again)], radius=RADIUS)
    assert len(both.distances) == 6
    assert {each.placement for each in both.distances} == {0, 1}
    assert both.spread is None


@pytest.mark.full
def test_a_placement_that_does_not_fit_is_left_out_and_named(placement: Placement) -> None:
    one, other = (found_in(four_poles(seed=seed, frames=1, poles=3)) for seed in (4, 5))
    answer = certify([placement, Placement(one.target, other.source)], radius=RADIUS)
    assert answer.status == "pass"
    assert answer.poles[0] == PolesSeen(4, 4, 4)
    assert answer.poles[1].compared == 0
    assert answer.reasons[0].message.startswith("placement 2 is not compared: ")


@pytest.mark.full
def test_a_recording_given_twice_is_refused(placement: Placement) -> None:
    answer = certify([Placement(placement.target, placement.target)], radius=RADIUS)
    assert answer.status == "refused"
    assert answer.reasons[0].code == "same_recording"


@pytest.mark.full
def test_every_pair_of_a_site_is_tested(pair: SimulatedPair, healthy: FieldTest) -> None:
    lidars = tuple(
        SiteLidar(name, (cloud,), sensor)
        for name, cloud, sensor in zip("ab", (pair.target, pair.source), pair.sensors, strict=True)
    )
    site = Site("quay", (*lidars, SiteLidar("c", (None,))), ("one",), radius=RADIUS)
    (((a, b), answer),) = certify_site(site)
    assert (a, b) == (0, 1)
    assert [e.difference_m for e in answer.distances] == [e.difference_m for e in healthy.distances]


@pytest.mark.full
def test_no_more_than_alpha_of_families_of_correlated_differences_fail() -> None:
    rng = np.random.default_rng(0)
    mix = rng.normal(size=(6, 4))
    random = mix @ mix.T
    sigma = np.sqrt(2 * np.diag(random))
    draws = np.sqrt(2) * rng.normal(size=(20000, 4)) @ mix.T
    failed = np.mean((np.abs(draws / sigma) > quantile(ALPHA, 6)).any(axis=1))
    assert 0.02 < failed <= 0.055
    nothing = np.zeros(6)
    a = Measured(draws[0], random, np.zeros((6, 1)), nothing)
    b = Measured(nothing, random, np.zeros((6, 1)), nothing)
    tests = compare((a, b), [(0, (0, 1))] * 6, 2.0)
    assert [2 * each.u_end_m for each in tests] == pytest.approx(sigma)


@pytest.mark.full
def test_what_both_have_from_the_radius_cancels() -> None:
    none = np.zeros((1, 1))
    radius = np.array([0.004])
    one = Measured(np.array([2.0]), none + 1e-6, none, radius)
    (test,) = compare((one, one), [(0, (0, 1))], 2.0)
    assert 2 * test.u_end_m == pytest.approx(np.sqrt(2e-6))


FEET = np.array([[0.0, 0, 0], [2, 0.3, 0], [0.4, 2.6, 0.2], [2.9, 2.1, 0.1]])
LEANS = np.array([[0.1, 0.1, 1], [-0.4, 0.1, 1], [0.2, -0.5, 1], [0.5, 0.3, 1]])
T = se3.from_rt(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([4.0, 1, 0.5]))


def seen(make: PoleMaker, feet: Array, order: list[int], T: Array | None = None) -> list[Pole]:
    return [make(feet[k], LEANS[k], T=T) for k in order]


def test_poles_are_paired_and_directed_alike(make_pole: PoleMaker) -> None:
    target = seen(make_pole, FEET, [0, 1, 2, 3])
    source = seen(make_pole, FEET, [2, 0, 3, 1], T)
    source[1] = make_pole(FEET[0], -LEANS[0], T=T)
    both = correspond(target, source)
    assert sorted(both.pairs) == [(0, 1), (1, 3), (2, 0), (3, 2)]
    turned = both.directions(0) @ T[:3, :3].T
    assert both.directions(1) == pytest.approx(turned, abs=1e-9)


def test_a_pole_that_moved_a_little_is_still_that_pole(make_pole: PoleMaker) -> None:
    moved = FEET + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, 0, 0]])
    both = correspond(seen(make_pole, FEET, [0, 1, 2, 3]), seen(make_pole, moved, [0, 1, 2, 3], T))
    assert sorted(both.pairs) == [(k, k) for k in range(4)]


def test_other_poles_are_refused(make_pole: PoleMaker) -> None:
    with pytest.raises(Refusal) as caught:
        correspond(seen(make_pole, FEET, [0, 1]), seen(make_pole, 3 * FEET + [0.0, 0, 0.5], [2, 3]))
    assert caught.value.code == "no_match"
