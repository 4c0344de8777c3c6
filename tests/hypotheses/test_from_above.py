"""No pole at all: the place gives the pose, or there is no answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Calibration, PointCloud
from retropole.base.errors import UsageError
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair
from tests.hypotheses.conftest import simulated_with_one_pole
from tests.hypotheses.test_one_pole import MOVED, assert_near

STEEP = se3.from_rt(se3.exp_so3(np.radians([70.0, 0.0, 0.0])), np.zeros(3))
"""Tilts a LiDAR by more than LiDARs are tilted as a rule."""


def bare(cloud: PointCloud) -> PointCloud:
    """Leave out the intensity: no pole could be found."""
    return replace(cloud, intensity=None)


def by_the_place(pair: SimulatedPair) -> Calibration:
    return calibrate(bare(pair.target), bare(pair.source), poles=0)


@pytest.fixture(
    scope="module",
    params=[("street", 1), pytest.param(("harbor", 2), marks=pytest.mark.full)],
    ids=lambda each: each[0],
)
def pair(request: pytest.FixtureRequest) -> SimulatedPair:
    return simulated_with_one_pole(*request.param)


@pytest.fixture(scope="module")
def answer(pair: SimulatedPair) -> Calibration:
    return by_the_place(pair)


@pytest.mark.full
def test_the_place_gives_the_truth(pair: SimulatedPair, answer: Calibration) -> None:
    assert answer.status != "refused", answer.reasons
    assert_near(answer.T_target_source, pair.T_target_source)
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    off = se3.local(answer.T_target_source, pair.T_target_source)
    assert off @ np.linalg.solve(answer.covariance, off) < 22.5
    # Nothing is said of poles that nobody looked for.
    assert answer.poles is None
    assert answer.radius is None
    assert answer.hypotheses[0].match.pairs == ()
    assert "without_poles" in {reason.code for reason in answer.reasons}


@pytest.mark.full
def test_frames_and_order_of_the_lidars_do_not_matter(
    pair: SimulatedPair, answer: Calibration
) -> None:
    back = calibrate(bare(pair.source), bare(pair.target.transformed(MOVED)), poles=0)
    assert answer.T_target_source is not None
    there = se3.inverse(MOVED @ answer.T_target_source)
    assert_near(back.T_target_source, there, 0.05, 0.02)


@pytest.mark.full
def test_the_ground_of_a_steep_lidar_is_not_taken_for_a_wall(pair: SimulatedPair) -> None:
    steep = replace(pair.source.transformed(STEEP), axis=pair.source.axis)
    answer = calibrate(bare(pair.target), bare(steep), poles=0)
    assert_near(answer.T_target_source, pair.T_target_source @ se3.inverse(STEEP))


@pytest.mark.full
def test_what_the_place_does_not_tell_is_refused(pair: SimulatedPair) -> None:
    ground = simulated_with_one_pole("bare", 0)
    refused = by_the_place(replace(pair, source=ground.source))
    assert refused.status == "refused"
    assert refused.T_target_source is None
    assert "set up two poles" in refused.reasons[0].message


def test_one_of_poles_and_scene_must_give_the_pose(pair: SimulatedPair) -> None:
    with pytest.raises(UsageError, match="scene must give the pose"):
        calibrate(pair.target, pair.source, poles=0, scene=False)
