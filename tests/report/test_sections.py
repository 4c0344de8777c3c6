"""The verdict says what happened and what to do; the lines to copy are those of export."""

from __future__ import annotations

import json
import re
from html import unescape

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.reasons import plain, reasons
from retropole.base.uncertainty import Confirmation
from retropole.base.uncertainty.purpose import Fitness
from retropole.export import export_lines
from retropole.report import render_report
from retropole.report.markup import NO_BREAK
from retropole.report.sections import FRAMES, UNFOLDED, hypotheses, transform, verdict
from retropole.result import ReasonDoc
from tests.report.made_up import T_TRUE, Page, made_up


@pytest.mark.parametrize("code", reasons())
def test_a_reason_is_told_with_its_meaning_and_all_that_helps(code: str) -> None:
    result = replace(made_up("warn", 500).result, reasons=[ReasonDoc(code, "because of 7", {})])
    page, known = Page(verdict(result)), reasons()[code]
    assert page.open == []
    said = [plain(text) for text in (known.help, *known.advice)]
    for words in (code, "because of 7", known.title, *said):
        assert words in page.text
    assert "](" not in page.text
    assert "`" not in page.text


def test_an_unknown_code_is_shown_with_its_message_alone() -> None:
    reason = ReasonDoc("struck_by_lightning", "12 kA through the target", {})
    page = Page(verdict(replace(made_up("refused", 500).result, reasons=[reason])))
    assert "struck_by_lightning" in page.text
    assert "12 kA through the target" in page.text
    assert "What to do" not in page.text


def test_says_how_certain_and_in_which_direction() -> None:
    text = Page(verdict(made_up(count=500).result)).text.replace(NO_BREAK, " ")
    assert "Least certain, at the poles, 1 σ: height along the poles: 6.0 mm." in text
    assert "A point 60 m away" in text
    assert "± 16 mm" in text
    share = "58 % of the variance of ± 9.5 mm at 30 m"
    assert f"Largest source of error, range offset of the source LiDAR: {share}." in text
    assert "What stands in the scene: 412 places agree, 3 deny it (0.7 %)." in text


def test_a_refusal_says_what_the_scene_said() -> None:
    denied = Confirmation(agreeing=61, contradicting=202, better_at=2.0)
    refusal = made_up("refused", 500).result
    text = Page(verdict(replace(refusal, confirmation=denied))).text
    said = "61 places agree, 202 deny it (76.8 %); it fits better 2.0 m away"
    assert f"What stands in the scene: {said}." in text
    assert "What stands in the scene" not in Page(verdict(refusal)).text


def test_refused_page_gives_no_transform_to_copy() -> None:
    html = render_report(*made_up("refused", 500))
    assert "data-export" not in html.split("<script")[0]
    assert "Refused: no transform" in html
    assert "too_wide" in html
    assert all(pose["id"] != "result" for pose in json.loads(Page(html).data)["poses"])


def test_hypotheses_without_icp_figures() -> None:
    result = made_up(count=500).result
    without = [
        replace(each, icp_rotation_rad=None, icp_translation_m=None) for each in result.hypotheses
    ]
    assert "–" not in re.sub("T.–S.", "", Page(hypotheses(result)).text)
    assert Page(hypotheses(replace(result, hypotheses=without))).text.count("––") == 4


def test_lines_to_copy_are_those_of_export() -> None:
    html = transform(made_up(count=500).result)
    written = dict(re.findall(r'data-export="(\w+)">(.*?)</pre>', html, re.S))
    expected = export_lines(T_TRUE, *FRAMES)
    assert set(written) == set(expected)
    assert set(UNFOLDED) <= set(expected)
    for key, text in expected.items():
        assert unescape(written[key]) == text.strip()
    matrix = [line.split() for line in unescape(written["cloudcompare"]).splitlines()[:4]]
    assert np.allclose(np.array(matrix, dtype=float), T_TRUE, atol=1e-12)


def test_the_verdict_answers_what_was_asked_for() -> None:
    run = made_up("ok", 500).result
    assert "sure" not in Page(verdict(run)).text
    asked = Fitness(0.02, 30.0, "yes", 0.98, 0.018, "within 2 cm <at> 30 m: yes, 98 % sure")
    page = Page(verdict(replace(run, fitness=asked)))
    assert page.open == []
    assert "Within 2 cm <at> 30 m: yes, 98 % sure." in page.text


def test_an_answer_says_what_to_do_next() -> None:
    for status in ("ok", "warn"):
        text = Page(verdict(made_up(status, 500).result)).text
        for said in ("What to do next", "retropole export .", "retropole check . TARGET SOURCE"):
            assert said in text
        assert ("Settle the warning first" in text) is (status == "warn")
    assert "What to do next" not in Page(verdict(made_up("refused", 500).result)).text


def test_a_path_keeps_its_small_letter_at_the_start_of_a_message() -> None:
    result = made_up("refused", 500).result
    path = result.inputs[0].path
    for message, kind in ((f"{path} has no intensity", "said"), ("few poles", "said sentence")):
        html = verdict(replace(result, reasons=[ReasonDoc("few_points", message, {})]))
        assert f'<p class="{kind}">{message}</p>' in html
