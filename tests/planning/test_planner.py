from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.datatypes import Calibration
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.base.uncertainty import predicted_error
from retropole.planning import planner
from retropole.planning.place import FAR, Area
from retropole.planning.planner import plan, rehearse, worst_at
from retropole.planning.stations import place_drawn_lidars
from retropole.result.pole_plan import LONGEST, MOST_PLACEMENTS, MOST_POLES, SHORTEST
from tests.planning.places import AREAS, BOXES, POSES, planned, pose, stations

pytestmark = pytest.mark.full


def test_swapped_lidars_are_planned_alike() -> None:
    """The place turns with its frame: the error is the same but for the grid that feet stand on."""
    swapped = plan(stations()[::-1], allowed=AREAS)
    error = worst_at(planned().predicted, 30.0)
    assert worst_at(swapped.predicted, 30.0) == pytest.approx(error, rel=0.2)


def test_one_more_is_never_worse() -> None:
    found = planned()
    now = worst_at(found.predicted, 30.0)
    assert {each.what for each in found.more} == {"pole", "placement"}
    for each in found.more:
        assert -0.02 <= each.gain < 1.0
        assert each.error < 1.2 * now


def test_too_little_ground_is_refused() -> None:
    corner = Area(np.array([4.0, -1.0]), np.array([4.3, -0.7]))
    with pytest.raises(Refusal) as refusal:
        plan(stations(), allowed=[corner])
    assert refusal.value.code in ("nowhere_seen", "no_ground")


def test_masts_are_too_high_for_thin_poles() -> None:
    """It says how thick poles must be."""
    masts = [pose(0.0, 0.0, 12.0, 0.0, 20.0), pose(9.0, 0.0, 12.0, 180.0, 20.0)]
    high = place_drawn_lidars(("a", "b"), [find_sensor("XT32")] * 2, masts)
    with pytest.raises(Refusal, match=r"they are seen up to 12\.0 m away") as refusal:
        plan(high)
    assert refusal.value.code == "nowhere_seen"
    nearest = refusal.value.values["nearest_m"]
    assert isinstance(nearest, float)
    assert f"use poles of {np.ceil(2e3 * nearest / FAR):.0f} mm or thicker" in str(refusal.value)


drawn_inputs = st.fixed_dictionaries(
    {
        "height": st.sampled_from([0.1, 0.5, 1.5, 4.0, 9.0, 12.0, 40.0]),
        "apart": st.sampled_from([0.0, 0.3, 2.0, 9.0, 60.0]),
        "turn": st.floats(-180.0, 180.0),
        "pitch": st.sampled_from([-90.0, -20.0, 0.0, 30.0, 90.0]),
        "poles": st.integers(2, MOST_POLES),
        "placements": st.integers(1, MOST_PLACEMENTS),
        "length": st.sampled_from([SHORTEST, 1.0, 2.0, LONGEST]),
        "radius": st.sampled_from([0.002, 0.02, 0.1, 0.25]),
        "corners": st.lists(
            st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)), min_size=1, max_size=2
        ),
        "side": st.sampled_from([0.3, 0.6]),
    }
)


@given(drawn_inputs)
@settings(max_examples=8)
def test_any_wish_is_planned_or_refused_with_numbers(given: dict[str, Any]) -> None:
    """Masts of any height, one LiDAR that sees nothing, tiny places: no other error comes."""
    height = given["height"]
    poses = [
        pose(0.0, 0.0, height, 0.0, 10.0),
        pose(given["apart"], 0.5, height + 0.1, given["turn"], given["pitch"]),
    ]
    corners, side = given["corners"], given["side"]
    areas = [Area(np.array(each), np.array(each) + side) for each in corners]
    said: Refusal | None = None
    # What a calibration with these poles says has tests of its own, and takes most of the time.
    with patch.object(planner, "rehearse", return_value=planned().rehearsal):
        try:
            drawn = place_drawn_lidars(("a", "b"), [find_sensor("VLP-16")] * 2, poses)
            found = plan(
                drawn,
                poles=given["poles"],
                placements=given["placements"],
                length=given["length"],
                radius=given["radius"],
                allowed=areas,
            )
        except Refusal as refusal:
            said = refusal
    if said is not None:
        assert any(character.isdigit() for character in str(said))
        assert said.values
        return
    assert [len(own) for own in found.chosen] == [given["poles"]] * given["placements"]
    for each in found.more:
        assert (each.what == "pole") <= (given["poles"] < MOST_POLES)
        assert (each.what == "placement") <= (given["placements"] < MOST_PLACEMENTS)


def test_the_rehearsal_finds_the_poses_that_it_was_made_with() -> None:
    found = planned()
    answer = found.rehearsal
    assert isinstance(answer, Calibration)
    assert answer.status == "ok"
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    first, second = found.stations
    truth = se3.inverse(first.T) @ second.T
    step = se3.local(answer.T_target_source, truth)
    assert step @ np.linalg.solve(answer.covariance, step) < 25
    # What a calibration states there is what was predicted.
    stated = predicted_error(answer.covariance, (30.0,))[0].sigma_m
    assert worst_at(found.predicted, 30.0) == pytest.approx(stated, rel=0.4)


def test_three_lidars_are_rehearsed_as_a_site() -> None:
    sensors = [find_sensor("VLP-16")] * 3
    poses = (*POSES, pose(1.0, 0.5, 1.9, 60.0))
    three = place_drawn_lidars(("front", "rear", "side"), sensors, poses, BOXES)
    standing = [planned().candidates.pole(k) for k in planned().numbers]
    answer = rehearse(three, [standing], planned().candidates.radius)
    assert isinstance(answer, SiteCalibration)
    assert answer.status != "refused"
    truth = [se3.inverse(three[0].T) @ each.T for each in three]
    for found, expected in zip(answer.lidars, truth, strict=True):
        apart = se3.difference(found.T_site_lidar, expected)
        assert apart.translation < 0.05
        assert apart.rotation < np.radians(0.5)


def test_placements_are_rehearsed_as_recordings_of_their_own() -> None:
    """The place was recorded once: that is no reason to refuse a second placement of the poles."""
    found = planned()
    poles = [found.candidates.pole(k) for k in found.numbers]
    answer = rehearse(found.stations, [poles, poles], found.candidates.radius)
    assert isinstance(answer, Calibration)
    assert answer.status == "ok", answer.reasons
