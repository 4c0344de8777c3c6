"""What every rival owes: refusals with reasons, no answer out of nothing, and what each does."""

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from _pytest.mark import ParameterSet

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from retropole.base.errors import MissingExtraError, Refusal
from retropole.checking.methods import RIVALS, missing_extra
from retropole.checking.rivals import (
    ENOUGH_INLIERS,
    FUNCTIONS,
    KISS_VOXELS,
    best_match,
    gicp,
    icp,
    register_clouds,
)
from retropole.simulation import SimulatedPair, simulate_pair

pytestmark = pytest.mark.full


def available(name: str) -> ParameterSet:
    """Skip a rival whose extra is not installed."""
    extra = missing_extra(name)
    return pytest.param(
        name, marks=pytest.mark.skipif(extra is not None, reason=f"no extra {extra}")
    )


ALL = [available(name) for name in RIVALS]


def test_every_rival_has_a_function() -> None:
    assert list(FUNCTIONS) == list(RIVALS)


@pytest.mark.parametrize("name", list(RIVALS))
def test_every_name_is_of_a_function_of_the_same_signature(name: str) -> None:
    parameters = inspect.signature(FUNCTIONS[name]).parameters.values()
    needed = [each.name for each in parameters if each.default is inspect.Parameter.empty]
    assert needed == ["target", "source", "rng"]
    assert RIVALS[name].title


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("count", [0, 1, 30])
def test_tiny_clouds_are_refused_not_answered(name: str, count: int) -> None:
    rng = np.random.default_rng(0)
    tiny, whole = (PointCloud(rng.uniform(-5, 5, (n, 3))) for n in (count, 3000))
    for target, source in ((tiny, whole), (whole, tiny), (tiny, tiny)):
        with pytest.raises(Refusal) as refusal:
            FUNCTIONS[name](target, source, rng)
        assert refusal.value.code == "too_few_points"
        assert refusal.value.values


@pytest.mark.parametrize("name", ALL)
def test_clouds_a_kilometre_apart_are_never_answered_by_the_identity(name: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(2))
    far = se3.from_rt(np.eye(3), np.array([1000.0, 0, 0]))
    source = pair.source.transformed(far)
    try:
        T = FUNCTIONS[name](pair.target, source, np.random.default_rng(0)).T_target_source
    except Refusal:
        return
    assert np.linalg.norm(T[:3, 3]) > 900


@pytest.mark.parametrize("name", [available(name) for name in ("kiss", "fpfh")])
def test_finds_a_corridor_without_a_start(name: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(0))
    found = FUNCTIONS[name](pair.target, pair.source, np.random.default_rng(0))
    error = se3.difference(found.T_target_source, pair.T_target_source)
    assert np.degrees(error.rotation) < 1.0
    assert error.translation < 0.1
    assert found.covariance is None
    assert found.rms > 0


NEEDY = [name for name, rival in RIVALS.items() if rival.extra is not None]


@pytest.mark.parametrize("name", NEEDY)
def test_a_missing_extra_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, extra, module = RIVALS[name]
    monkeypatch.setitem(sys.modules, module, None)
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (3000, 3)))
    with pytest.raises(MissingExtraError, match=rf"retropole\[{extra}\]"):
        FUNCTIONS[name](cloud, cloud, np.random.default_rng(0))


CLOUD = PointCloud(np.zeros((100, 3)))


@dataclass
class FakeMatching:
    """Answers each voxel with a translation by it, and the inliers that it is told."""

    inliers: dict[float, int]
    invalid: tuple[float, ...] = ()
    tried: list[float] = field(default_factory=list)

    def KISSMatcherConfig(self, voxel: float) -> float:
        return voxel

    def KISSMatcher(self, voxel: float) -> SimpleNamespace:
        self.tried.append(voxel)
        solution = SimpleNamespace(
            valid=voxel not in self.invalid,
            rotation=np.eye(3),
            translation=np.array([voxel, 0.0, 0.0]),
        )

        def estimate(source: Array, target: Array) -> SimpleNamespace:
            assert source.dtype == target.dtype == np.float32
            return solution

        return SimpleNamespace(
            estimate=estimate, get_num_final_inliers=lambda: self.inliers.get(voxel, 0)
        )


@pytest.mark.parametrize("best", KISS_VOXELS)
def test_the_voxel_with_the_most_inliers_decides(best: float) -> None:
    few = dict.fromkeys(KISS_VOXELS, 3) | {best: ENOUGH_INLIERS - 1}
    matching = FakeMatching(few)
    found = best_match(matching, CLOUD, CLOUD)
    assert matching.tried == list(KISS_VOXELS), "none has enough: all are tried"
    assert found.support == ENOUGH_INLIERS - 1
    assert found.start[0, 3] == best


def test_no_further_voxel_is_tried_once_there_are_enough() -> None:
    matching = FakeMatching({KISS_VOXELS[0]: ENOUGH_INLIERS, KISS_VOXELS[1]: 10 * ENOUGH_INLIERS})
    assert best_match(matching, CLOUD, CLOUD).support == ENOUGH_INLIERS
    assert matching.tried == [KISS_VOXELS[0]]


def test_what_it_calls_invalid_does_not_count() -> None:
    matching = FakeMatching(dict.fromkeys(KISS_VOXELS, 100), invalid=KISS_VOXELS[:1])
    assert best_match(matching, CLOUD, CLOUD).start[0, 3] == KISS_VOXELS[1]
    assert best_match(FakeMatching({}, invalid=KISS_VOXELS), CLOUD, CLOUD).support == 0


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
