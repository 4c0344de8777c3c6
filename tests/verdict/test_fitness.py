"""Whether an answer is good enough, and what is said where it is not."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from retropole.adjustment.solved import FLAT, SCATTER
from retropole.alignment.certainty import DEPTH, FLOOR, POLES, SWAY
from retropole.base.datatypes import Calibration, Placement, PointCloud, PoseEstimate, Scan
from retropole.base.errors import Reason
from retropole.base.reasons import remedy, tables
from retropole.base.sensors import SENSORS
from retropole.base.systematic import RADIUS_KIND
from retropole.base.uncertainty import BudgetEntry, Uncertainty, floor, predicted_error
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.base.uncertainty.purpose import USABLE, Need, displacement_bound
from retropole.verdict.fitness import DOUBTS, judge

pytestmark = pytest.mark.full

GOOD = np.diag(np.square([1e-4] * 3 + [2e-3] * 3))


def an_answer(size: float = 1.0, *reasons: Reason, z_margin: float = 6.0) -> Calibration:
    """An answer of a VLP-16 and a sensor that is not known; its 1 σ are `size` times those."""
    covariance = size**2 * GOOD
    cloud = PointCloud(np.ones((1, 3)))
    pose = PoseEstimate(np.eye(4), covariance, 0.01)
    budget = (
        BudgetEntry(FLOOR, None, 0.002, "m", None, 0.4),
        BudgetEntry("scatter of the surfaces", None, 0.002, "m", None, 0.3),
        BudgetEntry("range offset", "source", 0.01, "m", 0.001, 0.18),
        BudgetEntry("range offset", "target", 0.01, "m", 0.001, 0.12),
    )
    return Calibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        T_target_source=np.eye(4),
        covariance=covariance,
        poles=pose,
        refined=pose,
        hypotheses=(),
        margin=None,
        predicted_error=predicted_error(covariance),
        weakest=None,
        placements=(Placement(Scan(cloud, SENSORS["VLP-16"]), Scan(cloud)),),
        seconds={},
        uncertainty=Uncertainty(covariance, np.zeros((6, 6)), budget),
        confirmation=Confirmation(agreeing=500, contradicting=2, z_margin=z_margin),
    )


def test_a_good_answer_stays_as_it_is() -> None:
    answer = judge(an_answer(), None)
    assert (answer.status, answer.reasons, answer.fitness) == ("ok", (), None)
    asked = judge(an_answer(), Need(0.05, 30.0))
    assert asked.status == "ok"
    assert asked.fitness is not None
    assert asked.fitness.answer == "yes"


@pytest.mark.parametrize("size", np.geomspace(1.0, 1000.0, 13))
def test_no_ok_stands_next_to_a_large_error(size: float) -> None:
    answer = judge(an_answer(size), None)
    bound = displacement_bound(size**2 * GOOD, USABLE.at)
    assert answer.status == ("ok" if bound <= USABLE.within else "warn")
    if answer.status == "ok":
        assert all(each.sigma_m < 0.5 for each in answer.predicted_error)
    else:
        (reason,) = answer.reasons
        assert reason.code == "not_fit_for_purpose"
        assert "--need-cm" in reason.message
        assert reason.values["within_m"] == USABLE.within


def test_a_need_decides_in_place_of_the_usual_limit() -> None:
    poor = 60.0
    assert judge(an_answer(poor), None).status == "warn"
    assert judge(an_answer(poor), Need(2.0, 30.0)).status == "ok"
    assert judge(an_answer(1.0), Need(0.01, 30.0)).status == "warn"


def test_what_would_help_comes_from_the_largest_sources() -> None:
    (reason,) = judge(an_answer(), Need(0.01, 30.0)).reasons
    assert reason.message.startswith("within 1 cm at 30 m: not shown, ")
    assert "95 % sure: within 1" in reason.message
    assert "scatter of the surfaces (30 % of the variance at 30 m): record more" in reason.message
    assert "range offset of the source LiDAR (18 %): name the sensor" in reason.message
    assert "target LiDAR" not in reason.message
    assert FLOOR not in reason.message
    values = dict(reason.values)
    assert set(values) == {"within_m", "at_m", "probability", "bound_m"}
    assert 0.01 < float(values["bound_m"]) < 0.02
    poles_alone = replace(an_answer(), refined=None)
    (reason,) = judge(poles_alone, Need(0.01, 30.0)).reasons
    assert "without --no-refine" in reason.message


def test_what_no_recording_shows_is_said() -> None:
    least = displacement_bound(floor(), 30.0)
    (reason,) = judge(an_answer(), Need(0.9 * least, 30.0)).reasons
    assert "no recording can show less than" in reason.message
    assert "would help" not in reason.message


@pytest.mark.parametrize("code", DOUBTS)
def test_a_doubt_is_not_mended_by_a_smaller_error(code: str) -> None:
    doubt = Reason(code, "because of 7", {})  # type: ignore[arg-type]
    first, second = judge(an_answer(1.0, doubt), Need(0.05, 30.0)).reasons
    assert first is doubt
    assert second.message.startswith("within 5 cm at 30 m: not shown, 99 % sure if it were not for")
    assert code in second.message
    assert "would help" not in second.message
    # Nobody asked for what: the doubt has said what there is to say.
    assert judge(an_answer(1.0, doubt), None).reasons == (doubt,)


def test_what_the_scene_says_counts_unless_the_poles_are_trusted() -> None:
    unsure = an_answer(z_margin=0.5)
    assert unsure.confirmation is not None
    fit = judge(unsure, Need(0.05, 30.0)).fitness
    assert fit is not None
    wrong = unsure.confirmation.probability_wrong
    assert wrong is not None
    assert wrong > 0.05
    assert fit.probability <= 1 - wrong
    assert fit.answer == "not shown"
    trusted = replace(unsure, confirmation=structs.replace(unsure.confirmation, trusted=True))
    assert judge(trusted, Need(0.05, 30.0)).status == "ok"


def test_every_source_that_is_no_lidars_has_a_remedy_of_its_own() -> None:
    assert RADIUS_KIND.name in tables().remedies
    assert (
        remedy("scatter of the surfaces", "source") == tables().remedies["scatter of the surfaces"]
    )
    assert remedy("encoder") == tables().of_a_lidar
    # What is no LiDAR's own error has a remedy of its own.
    assert {POLES, DEPTH, SWAY, SCATTER, FLAT} <= set(tables().remedies)
    assert "sensor of the target (--sensor)" in remedy("encoder", "target")
