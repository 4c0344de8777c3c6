"""The one next thing to do."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from retropole.base.datatypes import PointCloud, Pole
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.base.systematic import Sway
from retropole.base.uncertainty import BudgetEntry
from retropole.base.uncertainty.purpose import USABLE, Need
from retropole.planning.live_advice import (
    Advice,
    advice_after,
    advise,
    another,
    keep_still,
    outcome_of,
)
from retropole.planning.live_poles import Looked, Tracked, View, fault_of
from retropole.result import ReasonDoc, ResultDoc, SwayDoc
from tests.conftest import PoleMaker
from tests.report.made_up import made_up

UP, LEANING = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.0, 1.0])
NOW = 10.0

ViewMaker = Callable[..., View]


@pytest.fixture
def poles(make_pole: PoleMaker) -> list[Pole]:
    return [make_pole([5, 0, 0], UP), make_pole([5, 2, 0], LEANING)]


def view(name: str, poles: list[Pole], since: float = 5.0, moved: bool = False) -> View:
    tracks = tuple(Tracked(k + 1, p, p, since, NOW, moved) for k, p in enumerate(poles))
    return View(
        name, tracks, Looked(NOW, PointCloud(np.ones((5, 3))), tuple(poles), threshold=80.0)
    )


def said(front: View, rear: View) -> Advice:
    """What is said; of front and rear exchanged the same kind of thing."""
    advice = advise([front, rear], NOW)
    assert advise([rear, front], NOW).code == advice.code
    return advice


def test_two_poles_that_stand_are_good(poles: list[Pole]) -> None:
    advice = said(view("front", poles), view("rear", poles))
    assert advice.code == "good"
    assert advice.is_good


def test_a_silent_lidar_goes_first(poles: list[Pole]) -> None:
    silent = View("rear", silent="nobody publishes /rear")
    advice = said(view("front", poles[:1]), silent)
    assert advice.code == "silent"
    assert "rear" in advice.text
    assert "nobody publishes /rear" in advice.text
    old = replace(view("rear", poles), looked=Looked(NOW - 10, PointCloud(np.ones((5, 3)))))
    assert said(view("front", poles), old).code == "silent"


def test_what_cannot_be_read_is_reported(poles: list[Pole]) -> None:
    advice = said(view("front", poles), replace(view("rear", poles), fault="point_step is 3"))
    assert advice.code == "unreadable"
    assert "point_step is 3" in advice.text
    refusal = Refusal("no_intensity", "the cloud has no intensity", {})
    looked = Looked(NOW, PointCloud(np.ones((5, 3))), refusal=refusal)
    assert said(view("front", poles), View("rear", looked=looked)).code == "no_intensity"


def test_one_pole_alone_is_missing_another(poles: list[Pole]) -> None:
    advice = said(view("front", poles[:1]), view("rear", poles[:1]))
    assert advice.code == "missing"
    assert not advice.is_good
    assert said(view("front", []), view("rear", [])).code == "no_poles"


def test_a_pole_that_one_lidar_lacks_is_hidden_from_it(poles: list[Pole]) -> None:
    advice = said(view("front", poles), view("rear", poles[:1]))
    assert advice.code == "hidden"
    assert "rear sees one pole, front sees 2" in advice.text


def test_what_fits_to_the_others_poles_is_named(poles: list[Pole], make_pole: PoleMaker) -> None:
    rear = view("rear", poles[:1])
    assert rear.looked is not None
    far = replace(poles[1], xyz=poles[1].xyz[:7], rings=3)
    seen = replace(rear, looked=replace(rear.looked, doubtful=(far,), why=("few",)))
    advice = said(view("front", poles), seen)
    assert advice.code == "too_far"
    assert "nearer to rear" in advice.text
    dim = replace(rear, looked=replace(rear.looked, dim=(poles[1],)))
    assert said(view("front", poles), dim).code == "dim"
    thick = replace(rear.looked, doubtful=(poles[1],), why=("it is 7 cm wide",))
    advice = said(view("front", poles), replace(rear, looked=thick))
    assert advice.code == "doubtful"
    assert "it is 7 cm wide" in advice.text
    # Something else that shines is not taken for it.
    other = make_pole([9, 5, 0], UP)
    clutter = replace(rear, looked=replace(rear.looked, doubtful=(other,), why=("wide",)))
    assert said(view("front", poles), clutter).code == "hidden"


def test_who_stands_before_a_lidar_is_requested_to_step_aside(poles: list[Pole]) -> None:
    rear = view("rear", poles)
    gone = replace(rear.tracks[1], seen=NOW - 5.0)
    body = poles[1].point * 0.3 + np.random.default_rng(0).uniform(-0.1, 0.1, (300, 3))
    looked = Looked(NOW, PointCloud(body), tuple(poles[:1]))
    hidden = View("rear", (rear.tracks[0], gone), looked)
    advice = said(view("front", poles), hidden)
    assert advice.code == "in_front"
    assert "Step aside" in advice.text


def test_moving_and_new_poles(poles: list[Pole]) -> None:
    assert said(view("front", poles), view("rear", poles, NOW - 0.2, moved=True)).code == "moving"
    assert said(view("front", poles), view("rear", poles, NOW - 0.2)).code == "settling"


def test_where_a_lidar_sees_that_does_not_see_all_around_is_reported(
    poles: list[Pole], make_pole: PoleMaker
) -> None:
    at128 = find_sensor("AT128")
    rear = replace(view("rear", poles[:1]), sensor=at128)
    assert "inside the 120° that rear sees" in said(view("front", poles), rear).text
    nobody = replace(view("rear", []), sensor=at128)
    assert "inside the 120° that rear sees" in said(view("front", []), nobody).text
    edge = [poles[0], make_pole([2.7, 4.4, 0], LEANING)]
    assert said(view("front", edge), replace(view("rear", poles), sensor=at128)).code == "good"
    advice = said(view("front", edge), replace(view("rear", edge), sensor=at128))
    assert advice.code == "at_edge"
    assert "5.2 m from rear is at the edge" in advice.text


def test_parallel_poles_are_to_be_leaned(poles: list[Pole], make_pole: PoleMaker) -> None:
    alike = [poles[0], make_pole([5, 2, 0], np.array([0.1, 0.0, 1.0]))]
    advice = said(view("front", alike), view("rear", alike))
    assert advice.code == "parallel"
    assert "6°" in advice.text


def test_the_second_best_pole_counts(poles: list[Pole]) -> None:
    weak = replace(poles[1], xyz=poles[1].xyz[:8], rings=3)
    advice = said(view("front", poles), view("rear", [poles[0], weak]))
    assert advice.code == "nearer"
    # A third that is weak does no harm.
    assert said(view("front", poles), view("rear", [*poles, weak])).code == "good"


def test_a_check_needs_no_poles() -> None:
    assert advise([view("front", []), view("rear", [])], NOW, needs_poles=False).is_good
    assert advise([view("front", []), View("rear")], NOW, needs_poles=False).code == "silent"


def test_words_on_a_pole(poles: list[Pole]) -> None:
    (track, _) = view("front", poles).tracks
    assert fault_of(track, NOW) == ""
    assert fault_of(track, NOW + 5) == "lost"
    assert fault_of(replace(track, since=NOW - 0.1, has_moved=True), NOW) == "moving"
    assert fault_of(replace(track, since=NOW - 0.1), NOW) == "new"
    assert fault_of(replace(track, pole=replace(track.pole, rings=2)), NOW) == "few rings"


# --- after an answer ----------------------------------------------------------------------------


@pytest.fixture
def answer() -> ResultDoc:
    return made_up().result


def test_an_answer_that_is_good_enough_ends_it(answer: ResultDoc) -> None:
    good = msgspec.structs.replace(
        answer, status="ok", reasons=[], covariance=np.eye(6) * 1e-10, fitness=None
    )
    outcome = outcome_of(good, Need(0.02, 30.0))
    assert outcome.is_enough
    assert advice_after(outcome, another(1)).code == "done"
    assert "up to 30 m away" in advice_after(outcome, another(1)).text
    # Nothing asked for: what any answer is good for.
    assert outcome_of(good, None).need == USABLE
    poor = msgspec.structs.replace(good, covariance=np.eye(6) * 1e-6)
    outcome = outcome_of(poor, Need(0.02, 30.0))
    assert not outcome.is_enough
    assert advice_after(outcome, another(1)).code == "need_not_met"
    assert advice_after(outcome, another(1)).text.startswith("Placement 2")
    # What no recording can show is not sent after.
    outcome = outcome_of(good, Need(0.0001, 30.0))
    assert advice_after(outcome, another(1)).code == "need_too_small"


def test_a_warning_and_a_refusal_say_what_to_do(answer: ResultDoc) -> None:
    doubt = ReasonDoc("not_confirmed", "the scene has too little", {})
    warned = msgspec.structs.replace(answer, status="warn", reasons=[doubt], fitness=None)
    outcome = outcome_of(warned, None)
    assert not outcome.is_enough
    advice = advice_after(outcome, another(1))
    assert (advice.code, advice.is_good) == ("not_confirmed", False)
    assert "placement" in advice.text
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
    assert advice_after(outcome, another(1)).text.startswith("Refused")
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
    assert keep_still(8, 30, 0.0).text == "Good: keep still, 8 of 30 sweeps."
    assert "4 s more" in keep_still(30, 30, 3.2).text
