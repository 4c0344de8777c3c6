"""Methods side by side: the answers are those of the methods, scored alike."""

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import PointCloud
from retropole.errors import UsageError
from retropole.evaluation import comparison
from retropole.evaluation.comparison import ALL_METHODS, OURS, compare, errors_of
from retropole.evaluation.metrics import e_rt, evaluate
from retropole.evaluation.rivals import ALL_METHODS as RIVALS
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, simulate_pair


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(4))


def test_answers_and_scores_are_those_of_the_methods(pair: SimulatedPair) -> None:
    names = ["gicp", "poles+scene", "poles"]
    seen: list[str] = []
    found = compare(
        pair.target, pair.source, names, T_true=pair.T_target_source, progress=seen.append
    )
    assert [each.method for each in found] == names == seen
    ours = calibrate(pair.target, pair.source)
    assert ours.refined is not None
    assert ours.poles is not None
    np.testing.assert_array_equal(found[1].T_target_source, ours.refined.T_target_source)
    np.testing.assert_array_equal(found[2].T_target_source, ours.poles.T_target_source)
    assert found[1].status == ours.status
    assert found[1].errors is not None
    assert found[1].errors.e_rt == e_rt(ours.refined.T_target_source, pair.T_target_source)
    again = evaluate(
        pair.target, pair.source, ours.refined.T_target_source, rng=np.random.default_rng(0)
    )
    assert found[1].alignment == again
    assert found[0].status == "ok", "a rival knows of no doubt"
    assert all(each.seconds is not None and each.seconds > 0 for each in found)
    assert found[2].seconds < found[1].seconds


def test_a_refusal_keeps_its_reason_and_gives_no_numbers() -> None:
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (10, 3)))
    for each in compare(cloud, cloud, ["poles", "planes", "icp"], T_true=np.eye(4)):
        assert each.status == "refused"
        assert each.codes
        assert each.message
        assert each.T_target_source is None
        assert each.alignment is None
        assert each.errors is None


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "missing_extra", lambda name: "part")
    cloud = PointCloud(np.zeros((0, 3)))
    (found,) = compare(cloud, cloud, ["kiss"])
    assert found.status == "missing"
    assert found.codes == ("part",)
    assert "retropole[part]" in found.message
    assert found.seconds is None


def test_an_unknown_method_is_refused_before_any_runs(pair: SimulatedPair) -> None:
    seen: list[str] = []
    with pytest.raises(UsageError, match="nonsense"):
        compare(pair.target, pair.source, ["icp", "nonsense"], progress=seen.append)
    assert seen == []
    assert (*OURS, *RIVALS) == ALL_METHODS


def test_errors_of_a_known_step() -> None:
    T = se3.random(np.random.default_rng(1))
    assert errors_of(T, T).e_rt == pytest.approx(0, abs=1e-12)
    off = errors_of(se3.retract(T, np.array([0.0, 0, 0.01, 0.03, 0, 0.04])), T)
    assert off.rotation == pytest.approx(0.01)
    assert off.translation == pytest.approx(0.05)
