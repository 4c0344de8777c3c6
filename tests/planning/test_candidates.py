import numpy as np
import pytest

from retropole.planning.candidates import MIN_RETURNS, Candidates, beams_met, is_seen, thinned
from retropole.planning.information import divergences_of
from retropole.simulation.raycast import cast
from tests.planning.places import BOXES, planned, stations

pytestmark = pytest.mark.full


def test_what_stands_before_a_pole_hides_it() -> None:
    station, width = stations()[0], divergences_of(stations())[0]
    beams = station.seen_from_place()
    box = BOXES[2].centre + np.array([0.0, 1.0, 0.0])
    away = box[:2] / np.linalg.norm(box[:2])
    behind, before = (np.r_[k * away, 0.0] for k in (np.linalg.norm(box[:2]) + 1.5, 2.5))
    up = np.array([0.0, 0.0, 1.0])
    low = Candidates(np.stack([behind, before]), np.stack([up, up]), 1.0, 0.02)
    assert not is_seen(beams_met(low.pole(0), beams, width), beams)
    assert is_seen(beams_met(low.pole(1), beams, width), beams)


def test_beams_meet_poles_where_the_ray_caster_has_them() -> None:
    station, width = stations()[0], divergences_of(stations())[0]
    beams = station.seen_from_place()
    pole = planned().candidates.pole(3)
    met = beams_met(pole, beams, width)
    hits = cast(beams.origin, beams.directions, [pole], width)
    expected = np.flatnonzero(hits.ranges < beams.ranges)
    np.testing.assert_array_equal(np.sort(met.beam), expected)
    np.testing.assert_allclose(met.ranges[np.argsort(met.beam)], hits.ranges[expected])


def test_every_candidate_is_seen_by_two_and_stands_on_the_ground() -> None:
    found = planned()
    assert (found.seen.sum(axis=1) >= 2).all()
    assert np.allclose(found.candidates.foot[:, 2], 0.0, atol=0.05)
    for i, station in enumerate(found.stations):
        beams, width = station.seen_from_place(), divergences_of(found.stations)[i]
        for k in found.numbers:
            assert len(beams_met(found.candidates.pole(k), beams, width).beam) >= MIN_RETURNS


def test_thinned_feet_are_apart() -> None:
    rng = np.random.default_rng(0)
    feet = rng.uniform(0, 10, (500, 3))
    left = thinned(feet, 2.0)
    assert len(left) == 25
    squares = np.floor(left[:, :2] / 2.0)
    assert len(np.unique(squares, axis=0)) == 25
    assert all((feet == each).all(axis=1).any() for each in left)
