"""What every rival owes: a loadable function, refusals with reasons, no answer out of nothing."""

import inspect
import sys

import numpy as np
import pytest
from _pytest.mark import ParameterSet

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import MissingExtraError, Refusal
from retropole.evaluation.rivals import RIVALS, load_rival, missing_extra
from retropole.simulation import simulate_pair

pytestmark = pytest.mark.full


def available(name: str) -> ParameterSet:
    """Skip a rival whose extra is not installed."""
    extra = missing_extra(name)
    return pytest.param(
        name, marks=pytest.mark.skipif(extra is not None, reason=f"no extra {extra}")
    )


ALL = [available(name) for name in RIVALS]


@pytest.mark.parametrize("name", list(RIVALS))
def test_every_line_of_the_registry_names_a_function_of_the_same_signature(name: str) -> None:
    parameters = inspect.signature(load_rival(name)).parameters.values()
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
            load_rival(name)(target, source, rng)
        assert refusal.value.code in ("too_few_points", "too_few_planes")
        assert refusal.value.values


@pytest.mark.parametrize("name", ALL)
def test_clouds_a_kilometre_apart_are_never_answered_by_the_identity(name: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(2))
    far = se3.from_rt(np.eye(3), np.array([1000.0, 0, 0]))
    source = pair.source.transformed(far)
    try:
        T = load_rival(name)(pair.target, source, np.random.default_rng(0)).T_target_source
    except Refusal:
        return
    assert np.linalg.norm(T[:3, 3]) > 900


@pytest.mark.parametrize("name", [available(name) for name in ("planes", "kiss", "fpfh")])
def test_finds_a_corridor_without_a_start(name: str) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(0))
    found = load_rival(name)(pair.target, pair.source, np.random.default_rng(0))
    error = se3.difference(found.T_target_source, pair.T_target_source)
    assert np.degrees(error.rotation) < 1.0
    assert error.translation < 0.1
    assert found.covariance is None
    assert found.rms > 0


NEEDY = {name: rival.extra for name, rival in RIVALS.items() if rival.extra is not None}


@pytest.mark.parametrize("name", list(NEEDY))
def test_a_missing_extra_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    extra = NEEDY[name]
    monkeypatch.setitem(sys.modules, extra.module, None)
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (3000, 3)))
    with pytest.raises(MissingExtraError, match=rf"retropole\[{extra.name}\]"):
        load_rival(name)(cloud, cloud, np.random.default_rng(0))


def test_the_extra_is_missing_where_its_module_is_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("retropole.evaluation.rivals.find_spec", lambda module: None)
    assert {name: missing_extra(name) for name in RIVALS} == {
        name: None if rival.extra is None else rival.extra.name for name, rival in RIVALS.items()
    }
