import numpy as np
import pytest

from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.datatypes import Calibration
from retropole.base.sensors import find_sensor
from retropole.base.uncertainty import predicted_error
from retropole.planning.planner import worst_at
from retropole.planning.rehearsal import rehearse
from retropole.planning.stations import stand_drawn
from tests.planning.places import BOXES, POSES, planned, pose

pytestmark = pytest.mark.full


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
    three = stand_drawn(("front", "rear", "side"), sensors, poses, BOXES)
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
