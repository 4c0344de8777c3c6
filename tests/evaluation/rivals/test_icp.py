"""ICP and GICP: right from nearby, at rest in place, and no answer where they still move."""

from collections.abc import Callable

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud, PoseEstimate
from retropole.base.errors import Refusal
from retropole.evaluation.rivals.registration import gicp, icp, register_clouds
from retropole.simulation import SimulatedPair, simulate_pair

pytestmark = pytest.mark.full

Method = Callable[[PointCloud, PointCloud, np.random.Generator], PoseEstimate]

RNG = np.random.default_rng(0)
STEP = np.array([0.02, -0.01, 0.03, 0.1, -0.1, 0.05])


@pytest.fixture(scope="module")
def corridor() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(1))


def test_they_end_at_the_truth_from_nearby(corridor: SimulatedPair) -> None:
    near_identity = se3.retract(np.eye(4), STEP)
    T_true = se3.inverse(near_identity)
    source = corridor.source.transformed(near_identity @ corridor.T_target_source)
    before = se3.difference(np.eye(4), T_true)
    by_icp = se3.difference(icp(corridor.target, source, RNG).T_target_source, T_true)
    by_gicp = se3.difference(gicp(corridor.target, source, RNG).T_target_source, T_true)
    assert np.degrees(by_gicp.rotation) < 0.2
    assert by_gicp.translation < 0.02
    assert by_icp.rotation < before.rotation
    assert by_gicp.rotation < by_icp.rotation, "point to point stops short"


@pytest.mark.parametrize("method", [gicp, icp])
def test_clouds_in_place_stay_there(method: Method, corridor: SimulatedPair) -> None:
    found = method(corridor.target, corridor.target, RNG)
    error = se3.difference(found.T_target_source, np.eye(4))
    assert np.degrees(error.rotation) < 1e-3
    assert error.translation < 1e-4


def test_where_iterations_run_out_there_is_no_answer(corridor: SimulatedPair) -> None:
    start = se3.retract(corridor.T_target_source, STEP)
    with pytest.raises(Refusal) as refusal:
        register_clouds(
            corridor.target,
            corridor.source,
            [start],
            method="GICP",
            max_correspondence_distances=(1.0,),
            max_iterations=1,
        )
    assert refusal.value.code == "not_converged"
    assert refusal.value.values == {"iterations": 1}


@pytest.mark.parametrize("right", [0, 1])
def test_of_several_starts_the_one_that_ends_with_most_points_decides(
    corridor: SimulatedPair, right: int
) -> None:
    far = se3.from_rt(np.eye(3), np.array([3.0, 2.0, 1.0])) @ corridor.T_target_source
    starts = [far, far]
    starts[right] = se3.retract(corridor.T_target_source, STEP)
    found = register_clouds(
        corridor.target,
        corridor.source,
        starts,
        method="GICP",
        max_correspondence_distances=(1.0, 0.3),
    )
    error = se3.difference(found.T_target_source, corridor.T_target_source)
    assert np.degrees(error.rotation) < 0.2
    assert error.translation < 0.02
