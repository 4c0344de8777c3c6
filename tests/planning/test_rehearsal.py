import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Calibration
from retropole.base.uncertainty import predicted_error
from retropole.planning.planner import worst_at
from tests.planning.places import planned


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
