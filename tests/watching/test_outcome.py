"""What follows from an answer."""

import msgspec
import numpy as np
import pytest

from retropole.base.sway import Sway
from retropole.base.uncertainty import BudgetEntry
from retropole.base.uncertainty.purpose import USABLE, Need
from retropole.result import ReasonDoc, ResultDoc, SwayDoc
from retropole.watching.outcome import advice_after, keep_still, outcome_of
from tests.report.made_up import made_up


@pytest.fixture
def answer() -> ResultDoc:
    return made_up().result


def test_an_answer_that_is_good_enough_ends_it(answer: ResultDoc) -> None:
    good = msgspec.structs.replace(
        answer, status="ok", reasons=[], covariance=np.eye(6) * 1e-10, fitness=None
    )
    outcome = outcome_of(good, Need(0.02, 30.0))
    assert outcome.is_enough
    assert advice_after(outcome, 1).code == "done"
    assert "up to 30 m away" in advice_after(outcome, 1).words
    # Nothing asked for: what any answer is good for.
    assert outcome_of(good, None).need == USABLE
    poor = msgspec.structs.replace(good, covariance=np.eye(6) * 1e-6)
    outcome = outcome_of(poor, Need(0.02, 30.0))
    assert not outcome.is_enough
    assert advice_after(outcome, 1).code == "need_not_met"
    assert advice_after(outcome, 1).words.startswith("Placement 2")
    # What no recording can show is not sent after.
    outcome = outcome_of(good, Need(0.0001, 30.0))
    assert advice_after(outcome, 1).code == "need_too_small"


def test_a_warning_and_a_refusal_say_what_to_do(answer: ResultDoc) -> None:
    doubt = ReasonDoc("not_confirmed", "the scene has too little", {})
    warned = msgspec.structs.replace(answer, status="warn", reasons=[doubt], fitness=None)
    outcome = outcome_of(warned, None)
    assert not outcome.is_enough
    advice = advice_after(outcome, 1)
    assert (advice.code, advice.is_good) == ("not_confirmed", False)
    assert "placement" in advice.words
    refused = msgspec.structs.replace(
        answer,
        status="refused",
        covariance=None,
        fitness=None,
        reasons=[ReasonDoc("moving_pole", "a pole moved", {})],
    )
    outcome = outcome_of(refused, None)
    assert outcome.bound is None
    assert outcome.is_spoilt
    assert advice_after(outcome, 1).words.startswith("Refused")
    ambiguous = msgspec.structs.replace(refused, reasons=[ReasonDoc("ambiguous", "two fit", {})])
    assert not outcome_of(ambiguous, None).is_spoilt


def test_masts_that_sway_are_recorded_for_longer(answer: ResultDoc) -> None:
    sway = Sway(0.001, 0.25, 3.0, np.eye(6) * 1e-8)
    entry = BudgetEntry("sway while it recorded", "target", 0.001, "rad", None, 1.0)
    swaying = msgspec.structs.replace(
        answer,
        status="ok",
        reasons=[],
        fitness=None,
        covariance=np.eye(6) * 1e-6,
        sways=[SwayDoc(0, 0, sway)],
        budget=[entry],
    )
    outcome = outcome_of(swaying, Need(0.02, 30.0))
    assert outcome.seconds_more == pytest.approx(5.0)
    assert outcome_of(swaying, Need(5.0, 30.0)).seconds_more == 0.0


def test_how_much_is_to_come() -> None:
    assert keep_still(8, 30, 0.0).words == "Good: keep still, 8 of 30 sweeps."
    assert "4 s more" in keep_still(30, 30, 3.2).words
