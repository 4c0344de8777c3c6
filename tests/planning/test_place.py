from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array, BoolArray
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.planning.place import (
    CELL,
    CLEARANCE,
    MIN_RETURNS,
    Area,
    Candidates,
    beams_hit,
    field_of,
    is_in_view,
    is_seen,
    survey,
    thinned,
)
from retropole.planning.prediction import divergences_of
from retropole.planning.stations import place_drawn_lidars
from retropole.simulation.raycast import cast
from tests.planning.places import AREAS, BOXES, planned, pose, stations

pytestmark = pytest.mark.full


def in_areas(feet: Array) -> BoolArray:
    return np.asarray(np.any([area.contains(feet[:, :2]) for area in AREAS], axis=0))


def test_feet_stand_on_the_ground_and_on_nothing_else() -> None:
    feet = survey(stations()).feet
    assert len(feet) > 100
    np.testing.assert_allclose(feet[:, 2], 0.0, atol=0.05)
    # The place's frame is that of the drawing, moved to below the first LiDAR.
    at = feet[:, :2] + [0.0, -1.0]
    for each in BOXES:
        inside = np.abs((at - each.centre[:2]) @ each.axes[:2, :2]) < each.half_sides[:2] - CELL
        assert not inside.all(axis=1).any()


def test_poles_keep_away_from_what_stands_there() -> None:
    place = survey(stations())
    wall = 8.0 - 0.2 + 1.0
    foot = np.array([[2.0, wall - 0.5 * CLEARANCE, 0.0], [2.0, wall - 2 * CLEARANCE, 0.0]])
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    assert place.are_free(foot, up, 2.0).tolist() == [False, True]
    # One that leans into the wall is not free either.
    lean = np.array([[0.0, np.sin(0.5), np.cos(0.5)]])
    assert not place.are_free(foot[1:], lean, 2.0)[0]


def test_areas_allow_and_forbid() -> None:
    feet = survey(stations(), allowed=AREAS).feet
    assert in_areas(feet).all()
    half = Area(np.array([4.0, -3.0]), np.array([6.0, -1.0]))
    left = survey(stations(), allowed=AREAS, forbidden=[half]).feet
    assert 0 < len(left) < len(feet)
    assert not half.contains(left[:, :2]).any()


def test_no_ground_is_refused() -> None:
    with pytest.raises(Refusal) as refusal:
        survey(stations(), allowed=[Area(np.array([50.0, 50.0]), np.array([60.0, 60.0]))])
    assert refusal.value.code == "no_ground"


def test_a_plan_does_not_move_with_the_drawing() -> None:
    """Where the world's origin is does not matter: the place counts from below the first LiDAR."""
    away = pose(40.0, -7.0, 0.0, 70.0)
    from dataclasses import replace

    boxes = [
        replace(b, centre=away[:3, :3] @ b.centre + away[:3, 3], axes=away[:3, :3] @ b.axes)
        for b in BOXES
    ]
    from tests.planning.places import POSES

    sensors = [find_sensor("VLP-16")] * 2
    moved = place_drawn_lidars(("front", "rear"), sensors, [away @ T for T in POSES], boxes)
    for one, other in zip(stations(), moved, strict=True):
        np.testing.assert_allclose(one.T, other.T, atol=5e-3)


def test_planned_poles_stand_in_the_area() -> None:
    found = planned()
    assert in_areas(found.candidates.foot[found.numbers]).all()


def test_what_stands_before_a_pole_hides_it() -> None:
    station, width = stations()[0], divergences_of(stations())[0]
    beams = station.seen_from_place()
    box = BOXES[2].centre + np.array([0.0, 1.0, 0.0])
    away = box[:2] / np.linalg.norm(box[:2])
    behind, before = (np.r_[k * away, 0.0] for k in (np.linalg.norm(box[:2]) + 1.5, 2.5))
    up = np.array([0.0, 0.0, 1.0])
    low = Candidates(np.stack([behind, before]), np.stack([up, up]), 1.0, 0.02)
    assert not is_seen(beams_hit(low.pole(0), beams, width), beams)
    assert is_seen(beams_hit(low.pole(1), beams, width), beams)


def test_beams_meet_poles_where_the_ray_caster_has_them() -> None:
    station, width = stations()[0], divergences_of(stations())[0]
    beams = station.seen_from_place()
    pole = planned().candidates.pole(3)
    met = beams_hit(pole, beams, width)
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
            assert len(beams_hit(found.candidates.pole(k), beams, width).beam) >= MIN_RETURNS


def test_poles_stand_a_lean_inside_a_limited_view() -> None:
    sensor = replace(find_sensor("XT32"), azimuth_span=(-1.0, 1.0))
    station = place_drawn_lidars(["a"], [sensor], [pose(0.0, 0.0, 1.8)], BOXES)[0]
    assert np.abs(np.arctan2(*station.beams.directions[:, [1, 0]].T)).max() < 1.01
    assert field_of(station) is sensor
    at = np.array([[4.0, 0.0], [2.2, 3.2], [0.0, 4.0]])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    poles = Candidates(np.c_[at, np.zeros(3)], up, 2.0, 0.02)
    # The second is within the field, and would not be if it leaned.
    assert sensor.has_in_view(poles.centre).tolist() == [True, True, False]
    inside = [is_in_view(poles.pole(k), station, sensor) for k in range(3)]
    assert inside == [True, False, False]
    # Of a recording that was turned it is not known where the field ends.
    turned = replace(station, cloud=station.cloud.transformed(pose(0.0, 0.0, 0.0, 90.0)))
    assert field_of(turned) is None


def test_thinned_feet_are_apart() -> None:
    rng = np.random.default_rng(0)
    feet = rng.uniform(0, 10, (500, 3))
    left = thinned(feet, 2.0)
    assert len(left) == 25
    squares = np.floor(left[:, :2] / 2.0)
    assert len(np.unique(squares, axis=0)) == 25
    assert all((feet == each).all(axis=1).any() for each in left)
