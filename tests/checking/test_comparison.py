"""Methods side by side: the answers are those of the methods, scored alike."""

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.checking import comparison
from retropole.checking.comparison import compare
from retropole.checking.methods import RIVALS
from retropole.checking.metrics import e_rt, evaluate
from retropole.checking.rivals import FUNCTIONS
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, simulate_pair


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    """Two LiDARs side by side: a registration that starts from the identity answers."""
    rng = np.random.default_rng(4)
    anywhere = simulate_pair("corridor", rng)
    beside = se3.retract(np.eye(4), np.array([0.0, 0.0, 0.05, 0.3, -0.2, 0.1]))
    return record_again(anywhere, rng, moved=se3.local(anywhere.T_target_source, beside))


@pytest.mark.full
def test_answers_and_scores_are_those_of_the_methods(pair: SimulatedPair) -> None:
    names = ["gicp", "poles+scene", "poles"]
    seen: list[str] = []
    found = compare(
        pair.target, pair.source, names, T_true=pair.T_target_source, progress=seen.append
    )
    assert [each.method for each in found] == names
    assert seen == ["gicp, 1 of 3", "poles+scene, 2 of 3", "poles, 3 of 3"]
    rival, with_scene, poles_alone = found
    theirs = FUNCTIONS["gicp"](pair.target, pair.source, np.random.default_rng(0))
    ours = calibrate(pair.target, pair.source)
    assert ours.refined is not None
    assert ours.poles is not None
    for each, pose in ((rival, theirs), (with_scene, ours.refined), (poles_alone, ours.poles)):
        assert each.T_target_source is not None
        # The rival's threads add up in any order: equal to rounding.
        np.testing.assert_allclose(each.T_target_source, pose.T_target_source, atol=1e-9)
        assert each.errors is not None
        assert each.errors.e_rt == e_rt(each.T_target_source, pair.T_target_source)
        assert each.alignment == evaluate(
            pair.target, pair.source, each.T_target_source, rng=np.random.default_rng(0)
        )
    assert with_scene.alignment is not None
    # Without the poles' own returns, which only a calibration knows.
    assert ours.confirmation is not None
    found_there = with_scene.alignment.confirmation
    assert found_there.agreeing == pytest.approx(ours.confirmation.agreeing, rel=0.1)
    assert abs(found_there.conflicting - ours.confirmation.conflicting) < 5
    assert with_scene.status == ours.status
    assert rival.status == "ok", "a rival states no doubt"
    assert rival.seconds is not None
    assert rival.seconds > 0
    assert poles_alone.seconds is not None
    assert with_scene.seconds is not None
    assert 0 < poles_alone.seconds < with_scene.seconds


def test_a_refusal_keeps_its_reason_and_gives_no_numbers() -> None:
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (10, 3)))
    for each in compare(cloud, cloud, ["poles", "gicp", "icp"], T_true=np.eye(4)):
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
    with pytest.raises(UsageError, match="nonsense") as error:
        compare(pair.target, pair.source, ["icp", "nonsense"], progress=seen.append)
    assert seen == []
    assert all(name in str(error.value) for name in RIVALS)
