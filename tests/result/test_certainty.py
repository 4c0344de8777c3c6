"""Certainty in its two kinds, written and read back."""

import json
from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Calibration, PointCloud
from retropole.base.uncertainty import BudgetEntry, RadiusEstimate, Uncertainty
from retropole.base.uncertainty.confirmation import DECEIVING, Confirmation
from retropole.result import (
    InputDoc,
    ResultDoc,
    RunConfig,
    encode,
    result_document,
)
from retropole.result.decoding import decode
from tests.report.made_up import BUDGET, RANDOM, SYSTEMATIC, placement_of

INPUTS = [InputDoc(f"{name}.pcd", "0" * 64, 1, 0, "auto", None) for name in ("a", "b")]


def calibration(
    uncertainty: Uncertainty | None = None,
    radius: RadiusEstimate | None = None,
    confirmation: Confirmation | None = None,
) -> Calibration:
    """Hold nothing but how certain it is."""
    seen = (placement_of(PointCloud(np.ones((1, 3)))),)
    answer = Calibration("ok", (), np.eye(4), None, None, None, (), None, (), None, seen, {})
    covariance = None if uncertainty is None else uncertainty.covariance
    answer = replace(answer, covariance=covariance, uncertainty=uncertainty, radius=radius)
    return replace(answer, confirmation=confirmation)


def written(answer: Calibration) -> ResultDoc:
    return result_document(answer, inputs=INPUTS, config=RunConfig(), seconds={})


STATED_CONFIRMATION = Confirmation(
    agreeing=412, contradicting=3, missing=10, better_at=1.75, z_margin=2.5, redundant=True
)
STATED = calibration(
    Uncertainty(RANDOM, SYSTEMATIC, BUDGET),
    RadiusEstimate(0.02, 0.0005, 0.02031, 0.00042),
    STATED_CONFIRMATION,
)


def test_names_that_others_rely_on() -> None:
    plain = json.loads(encode(written(STATED)))
    assert set(plain["uncertainty"]) == {"random", "systematic"}
    names = {"name", "sensor", "sigma", "unit", "estimated", "share_at_30m"}
    assert all(set(entry) == names for entry in plain["budget"])
    assert plain["radius"] == {
        "given_m": 0.02,
        "given_sigma_m": 0.0005,
        "estimated_m": 0.02031,
        "sigma_m": 0.00042,
    }
    assert plain["confirmation"] == {
        "agreeing": 412,
        "contradicting": 3,
        "missing": 10,
        "contradicted": 13 / 425,
        "better_at_m": 1.75,
        "lead": 2.5,
        "vouched": True,
        "trusted": False,
        "together": False,
        "deceiving_share": DECEIVING,
        "along": None,
        "probability_wrong": pytest.approx(STATED_CONFIRMATION.probability_wrong),
    }


def test_the_covariance_is_the_sum_of_its_two_parts() -> None:
    plain = json.loads(encode(written(STATED)))
    random, systematic = (np.array(plain["uncertainty"][k]) for k in ("random", "systematic"))
    assert random.shape == systematic.shape == (6, 6)
    np.testing.assert_allclose(random + systematic, plain["covariance"], rtol=1e-12)


def test_what_was_written_is_read_back() -> None:
    document = decode(encode(written(STATED)))
    found, stated = document.whole_uncertainty, STATED.uncertainty
    assert found is not None
    assert stated is not None
    np.testing.assert_array_equal(found.random, stated.random)
    np.testing.assert_array_equal(found.systematic, stated.systematic)
    assert found.budget == stated.budget
    assert document.radius == STATED.radius
    assert document.confirmation == STATED.confirmation


@pytest.mark.parametrize(
    "found",
    [Confirmation(agreeing=412, contradicting=3), Confirmation(agreeing=0, contradicting=0)],
)
def test_what_stands_in_the_scene_may_fit_nowhere_better(found: Confirmation) -> None:
    document = decode(encode(written(calibration(confirmation=found))))
    assert document.confirmation == found
    assert found.contradicted == found.conflicting / max(found.total, 1)


def test_what_follows_is_worked_out_again() -> None:
    stated = json.loads(encode(written(STATED)))
    stated["confirmation"] |= {"contradicted": 0.5, "probability_wrong": 0.25}
    assert decode(json.dumps(stated).encode()).confirmation == STATED.confirmation


def test_numbers_of_numpy_are_written_as_numbers() -> None:
    share = np.float64(1)
    entry = BudgetEntry("scale", "target", np.float64(1e-4), "1", np.float64(2e-5), share)
    document = written(calibration(Uncertainty(RANDOM, SYSTEMATIC, (entry,))))
    assert document.budget is not None
    (found,) = document.budget
    assert (found.sigma, found.estimated, found.share_at_30m) == (1e-4, 2e-5, 1.0)
    assert decode(encode(document)) == document


@pytest.mark.parametrize("missing", ["null", "absent"])
def test_files_that_do_not_state_it_are_read(missing: str) -> None:
    plain = json.loads(encode(written(calibration())))
    for name in ("uncertainty", "budget", "radius", "confirmation"):
        assert plain[name] is None
        if missing == "absent":
            del plain[name]
    document = decode(json.dumps(plain).encode())
    assert (document.uncertainty, document.budget, document.radius) == (None, None, None)
    assert document.confirmation is None
    assert document.whole_uncertainty is None
