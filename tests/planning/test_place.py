import numpy as np
import pytest

from retropole.base.datatypes import Array, BoolArray
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.planning.place import CELL, CLEARANCE, Area, survey
from retropole.planning.stations import stand_drawn
from tests.planning.places import AREAS, BOXES, planned, pose, stations

pytestmark = pytest.mark.full


def in_areas(feet: Array) -> BoolArray:
    return np.asarray(np.any([area.holds(feet[:, :2]) for area in AREAS], axis=0))


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
    assert not half.holds(left[:, :2]).any()


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
    moved = stand_drawn(("front", "rear"), sensors, [away @ T for T in POSES], boxes)
    for one, other in zip(stations(), moved, strict=True):
        np.testing.assert_allclose(one.T, other.T, atol=5e-3)


def test_planned_poles_stand_in_the_area() -> None:
    found = planned()
    assert in_areas(found.candidates.foot[found.numbers]).all()
