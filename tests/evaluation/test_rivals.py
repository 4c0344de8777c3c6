"""The other rivals: what every method owes, and what each is known to find."""

import sys

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, PointCloud
from retropole.errors import MissingExtraError, Refusal
from retropole.evaluation.rivals import EXTRAS, METHODS, gicp, icp, missing_extra
from retropole.simulation import SimulatedPair, simulate_pair


def available(method: str) -> object:
    extra = missing_extra(method)
    return pytest.param(
        method, marks=pytest.mark.skipif(extra is not None, reason=f"no extra {extra}")
    )


ALL = [available(method) for method in METHODS]


@pytest.fixture(scope="module")
def corridor() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(1))


def near(pair: SimulatedPair, step: Array) -> PointCloud:
    """Move the source to within a step of the target's frame."""
    return pair.source.transformed(se3.retract(np.eye(4), step) @ pair.T_target_source)


def errors(T: Array, T_true: Array) -> tuple[float, float]:
    step = se3.local(T_true, T)
    return float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:]))


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("count", [0, 1, 30])
def test_tiny_clouds_are_refused_not_answered(method: str, count: int) -> None:
    rng = np.random.default_rng(0)
    tiny, whole = (PointCloud(rng.uniform(-5, 5, (n, 3))) for n in (count, 3000))
    for target, source in ((tiny, whole), (whole, tiny), (tiny, tiny)):
        with pytest.raises(Refusal) as refusal:
            METHODS[method](target, source, rng)
        assert refusal.value.code in ("too_few_points", "too_few_planes")
        assert refusal.value.values


@pytest.mark.parametrize("method", ALL)
def test_clouds_a_kilometre_apart_are_never_answered_by_the_identity(method: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(2))
    far = se3.from_rt(np.eye(3), np.array([1000.0, 0, 0]))
    source = pair.source.transformed(far)
    try:
        T = METHODS[method](pair.target, source, np.random.default_rng(0)).T_target_source
    except Refusal:
        return
    assert np.linalg.norm(T[:3, 3]) > 900


@pytest.mark.parametrize("method", [available(m) for m in ("planes", "kiss", "fpfh")])
def test_finds_a_corridor_without_a_start(method: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(0))
    stage = METHODS[method](pair.target, pair.source, np.random.default_rng(0))
    turned, moved = errors(stage.T_target_source, pair.T_target_source)
    assert turned < 1.0
    assert moved < 0.1
    assert stage.covariance is None
    assert stage.rms > 0


def test_icp_and_gicp_end_at_the_truth_from_nearby(corridor: SimulatedPair) -> None:
    step = np.array([0.02, -0.01, 0.03, 0.1, -0.1, 0.05])
    T_true = se3.inverse(se3.retract(np.eye(4), step))
    source = near(corridor, step)
    before = errors(np.eye(4), T_true)
    by_icp = errors(icp(corridor.target, source).T_target_source, T_true)
    by_gicp = errors(gicp(corridor.target, source).T_target_source, T_true)
    assert by_gicp[0] < 0.2
    assert by_gicp[1] < 0.02
    assert by_icp < before
    assert by_gicp < by_icp, "point to point stops short"


@pytest.mark.parametrize("method", [gicp, icp])
def test_clouds_in_place_stay_there(method, corridor: SimulatedPair) -> None:  # type: ignore[no-untyped-def]
    turned, moved = errors(method(corridor.target, corridor.target).T_target_source, np.eye(4))
    assert turned < 1e-3
    assert moved < 1e-4


@pytest.mark.parametrize("method", list(EXTRAS))
def test_a_missing_part_is_named(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    extra, module = EXTRAS[method]
    monkeypatch.setitem(sys.modules, module, None)
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (3000, 3)))
    with pytest.raises(MissingExtraError, match=rf"retropole\[{extra}\]"):
        METHODS[method](cloud, cloud, np.random.default_rng(0))
