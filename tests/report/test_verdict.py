"""The verdict: every reason with what to do, how sure the poses are, and what comes next."""

from __future__ import annotations

import re
from dataclasses import replace as replaced

import pytest
from msgspec.structs import replace

from retropole.adjustment.agreement import MAX_AXES_CHI2
from retropole.adjustment.blunders import is_poor
from retropole.adjustment.snooping import POOR
from retropole.alignment.certainty import normalised
from retropole.base.bounded import Status
from retropole.base.reasons import plain, reasons
from retropole.base.uncertainty.confirmation import UNUSABLE, Confirmation
from retropole.base.uncertainty.purpose import Fitness
from retropole.report.curves import curve_sentence, error_curve
from retropole.report.listings import checks_of_site, probability, statements
from retropole.report.page import NO_BREAK
from retropole.report.poses import certainty, certificate
from retropole.report.subject import Subject, as_subject
from retropole.report.text import describe_result
from retropole.report.verdict import next_steps, verdict
from retropole.result import ReasonDoc, ResultDoc
from retropole.result.site import SiteDoc
from tests.report.made_up import Page, made_up
from tests.report.pages import of_each_kind, subject_of
from tests.report.site.made_up import document_of, made_up_site


def with_reason(kind: str, reason: ReasonDoc, status: Status = "warn") -> Page:
    subject = subject_of(kind, status)
    return Page(verdict(replaced(subject, site=replace(subject.site, reasons=[reason]))))


def of_pair_with(status: Status = "ok", **fields: object) -> Page:
    result: ResultDoc = replace(made_up(status, 500).result, **fields)
    return Page(verdict(as_subject(result, ())))


def site(status: Status = "ok") -> SiteDoc:
    return document_of(made_up_site(status, lidars=5, placements=2, count=10))


def said_of(document: SiteDoc) -> str:
    """Give the verdict of a site, and what is certain of an answer."""
    return Page(verdict(Subject(document)) + certainty(Subject(document))).text


@of_each_kind
@pytest.mark.parametrize("code", reasons())
def test_a_reason_is_reported_with_its_meaning_and_all_that_helps(kind: str, code: str) -> None:
    page, known = with_reason(kind, ReasonDoc(code, "because of 7", {})), reasons()[code]
    assert page.open == []
    said = [plain(text) for text in (known.help, *known.advice)]
    for words in (code, "because of 7", known.title, *said):
        assert words in page.text
    assert "](" not in page.text
    assert "`" not in page.text


@of_each_kind
def test_an_unknown_code_is_shown_with_its_message_alone(kind: str) -> None:
    reason = ReasonDoc("struck_by_lightning", "12 kA through the target", {})
    page = with_reason(kind, reason, "refused")
    assert "struck_by_lightning" in page.text
    assert "12 kA through the target" in page.text
    assert "What to do" not in page.text


@of_each_kind
def test_an_answer_says_what_to_do_next(kind: str) -> None:
    said = {
        "pair": ("retropole export .", "retropole check . TARGET SOURCE"),
        "site": ("Look at the tests", "site-result.json"),
    }
    for status in ("ok", "warn"):
        subject = subject_of(kind, status)
        text = Page(verdict(subject) + next_steps(subject)).text
        for words in ("What to do next", *said[kind]):
            assert words in text
        assert ("Resolve the warning first" in text) is (status == "warn")
    refused = subject_of(kind, "refused")
    assert "What to do next" not in Page(verdict(refused) + next_steps(refused)).text


def test_says_how_certain_a_pair_is_and_in_which_direction() -> None:
    text = Page(certainty(as_subject(made_up("ok", 500).result, ()))).text.replace(NO_BREAK, " ")
    for said in (
        "weakest direction, 1 sigma: height along the poles: 6.0 mm",
        "± 16 mm at 60 m",
        "main error source at 30 m: range offset of the source LiDAR (58 %)",
        "scene check: 412 patches agree, 3 contradict (0.7 % against it)",
    ):
        assert said in text


def test_the_verdict_of_a_pair_is_a_sentence_and_says_the_rest_below() -> None:
    page = of_pair_with()
    assert not [1 for tag, _ in page.tags if tag in ("li", "dl")]
    curve = error_curve(as_subject(made_up("ok", 500).result, ()))
    assert curve is not None
    assert curve_sentence(curve).startswith("Points up to 30 m away are within ")


def test_a_refusal_reports_what_the_scene_showed() -> None:
    contradicted = Confirmation(agreeing=61, contradicting=202, better_at=2.0)
    text = of_pair_with("refused", confirmation=contradicted).text
    said = "61 patches agree, 202 contradict (76.8 % against it); it fits better 2.0 m away"
    assert f"scene check: {said}" in text
    assert "scene check" not in of_pair_with("refused").text


def doubted(**fields: object) -> ResultDoc:
    """An answer that is wrong with a probability of 39 %."""
    found = Confirmation(agreeing=31, contradicting=5, missing=2, z_margin=-0.5)
    assert found.probability_wrong is not None
    assert found.probability_wrong > UNUSABLE
    return replace(made_up("warn", 500).result, confirmation=replace(found, **fields))


def test_what_is_too_likely_wrong_is_not_advised_to_be_used() -> None:
    """On the page and the terminal alike, until somebody trusts the poles."""
    following = {"next": "retropole export ."}
    for is_trusted in (False, True):
        result = doubted(trusted=is_trusted)
        subject = as_subject(result, ())
        page = Page(verdict(subject) + next_steps(subject)).text
        words = " ".join(describe_result(result, [], following).split())
        for text in (page, words):
            assert ("do not use it. Add another pole" in text) is not is_trusted
            assert ("retropole export ." in text) is is_trusted
        assert (certificate(subject) == "") is not is_trusted
    unsure = ReasonDoc("not_confirmed", "", {"probability_wrong": 0.34})
    for wrong in (UNUSABLE, 0.34):
        unsure = replace(unsure, values={"probability_wrong": wrong})
        doubtful = Subject(replace(site("warn"), reasons=[unsure]))
        page = Page(verdict(doubtful) + next_steps(doubtful)).text
        assert (certificate(doubtful) == "") is (wrong > UNUSABLE)
        assert ("do not use it" in page) is (wrong > UNUSABLE)
        assert ("What to do next" in page) is (wrong == UNUSABLE)


def test_the_verdict_answers_what_was_requested() -> None:
    assert "sure" not in of_pair_with().text
    asked = Fitness(0.02, 30.0, "yes", 0.98, 0.018, "within 2 cm <at> 30 m: yes, 98 % sure")
    page = of_pair_with(fitness=asked)
    assert page.open == []
    assert "within 2 cm <at> 30 m: yes, 98 % sure." in page.text
    assert "not every LiDAR; crane-high: not shown" in said_of(site())
    good = site().lidars[1].fitness
    lidars = [replace(each, fitness=good) for each in site().lidars]
    assert "within 2 cm at 30 m: yes, every LiDAR." in said_of(replace(site(), lidars=lidars))


def test_a_path_keeps_its_small_letter_at_the_start_of_a_message() -> None:
    path = made_up("refused", 500).result.inputs[0].path
    for message, kind in ((f"{path} has no intensity", "said"), ("few poles", "said sentence")):
        result = replace(
            made_up("refused", 500).result, reasons=[ReasonDoc("few_points", message, {})]
        )
        assert f'<p class="{kind}">{message}</p>' in verdict(as_subject(result, ()))


def test_a_site_says_how_good_it_is_and_what_checked_it() -> None:
    text = said_of(site())
    for said in (
        "Calibrated: 5 LiDARs in one frame",
        "datum: LiDAR mast-a stands still",
        "crane-high being the worst",
        "none suspicious",
        "3 loops; the worst, mast-a → crane-low → crane-high → mast-a: misses by",
        "1 observation without a check",
    ):
        assert said in text
    warned = said_of(site("warn"))
    assert "1 suspicious: pole 2 of morning as mast-b sees it (w 6.3, 5 expected at most)" in warned


@pytest.mark.parametrize(
    ("w", "chi2", "freedom", "is_said"),
    [(4.5, 20.3, 1, False), (5.1, 26.0, 1, True), (5.1, 40.0, 6, False), (-5.1, 26.0, 1, True)],
)
def test_what_is_suspicious_is_what_the_verdict_warns_of(
    w: float, chi2: float, freedom: int, is_said: bool
) -> None:
    """By the same limits; else the largest is named beside the most to expect."""
    document = document_of(made_up_site("ok"))
    allowed = max(POOR, normalised(MAX_AXES_CHI2 * freedom, freedom))
    test = replace(document.tests[0], w=w, chi2=chi2, freedom=freedom, allowed=allowed)
    others = [replace(each, w=0.5, chi2=0.25) for each in document.tests[1:] if each.w is not None]
    words = " ".join(checks_of_site(replace(document, tests=[test, *others])))
    assert f"{test.name} (w {abs(w):.1f}, {allowed:.2g} expected at most)" in words
    assert ("1 suspicious: " in words) is is_said
    assert ("none suspicious; the largest: " in words) is not is_said
    assert is_poor(abs(w), chi2, freedom) is is_said


def test_a_refused_site_names_its_groups_and_no_figures() -> None:
    text = said_of(site("refused"))
    assert "Refused: no pose" in text
    assert "mast-a, mast-b, gate, crane-low | crane-high" in text
    assert "1 sigma" not in text


def test_a_site_without_tests_says_that_nothing_checks_it() -> None:
    bare = replace(site(), tests=[], loops=[])
    said = list(statements(Subject(bare)))
    assert "no consistency checks: there is no verification of these poses" in said
    assert "no closed loop: there is no third LiDAR to check a pair" in said
    refused = " ".join(statements(Subject(site("refused"))))
    assert not re.search("checks|loop|pairs", refused)


@pytest.mark.parametrize(
    ("p", "words"),
    [(None, "–"), (1e-9, "< 0.1 %"), (0.012, "1.2 %"), (0.6, "60 %"), (1.0, "100 %")],
)
def test_probabilities_are_written_as_they_matter(p: float | None, words: str) -> None:
    assert probability(p) == words
