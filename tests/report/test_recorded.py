"""Poles, checks, recordings and options are told as the result and the clouds have them."""

from __future__ import annotations

import re
from dataclasses import replace as replaced

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.report import listings
from retropole.report.page import SHOWN, listed
from retropole.report.recorded import poles, run
from retropole.report.subject import (
    Subject,
    hypothesis_name,
    input_names,
    of_pair,
    pair_name,
    pole_labels,
    pole_name,
)
from retropole.result import PlacementDoc, ResultDoc, RunConfig
from retropole.result.site import SiteDoc
from tests.report.made_up import AS_SHOWN, HOSTILE, Page, made_up
from tests.report.site.made_up import NAMES, document_of, made_up_site

RESULT, PLACEMENTS = made_up(count=500)
REFUSED = document_of(made_up_site("refused", lidars=8, placements=2, count=10))
WARNED = document_of(made_up_site("warn", lidars=5, placements=4, count=10))


def pair(**fields: object) -> Subject:
    return of_pair(replace(RESULT, **fields), PLACEMENTS)


def headings(html: str) -> list[str]:
    return re.findall(r'<th scope="row">(.*?)</th>', html)


def test_poles_and_rejected_clusters_of_a_pair_are_listed() -> None:
    text = Page(poles(pair())).text
    for name in ("T0", "T1", "S0", "S1", "× 0", "+ 0"):
        assert name in text
    assert text.count("too_wide") == 2


def test_residuals_are_those_of_the_points_from_the_lines() -> None:
    ours, theirs = PLACEMENTS[0].target.poles[0], PLACEMENTS[0].source.poles[0]
    away = se3.apply(np.array(RESULT.T_target_source), theirs.xyz) - ours.point
    distances = np.linalg.norm(np.cross(away, ours.direction), axis=1)
    (row,) = re.findall(r'<tr><th scope="row">T0–S0</th>(.*?)</tr>', poles(pair()))
    figures = [float(cell) for cell in re.findall(r"<td>([\d.]+)</td>", row)]
    assert figures[2] == pytest.approx(1000 * np.sqrt(np.mean(distances**2)), abs=0.05)
    assert figures[3] == pytest.approx(1000 * distances.max(), abs=0.05)


def test_the_radius_is_told_as_given_and_as_estimated() -> None:
    said = "Radius of the poles: 20.00 mm given, 20.31 ± 0.42 mm estimated (1 σ)."
    assert said in Page(poles(pair())).text
    assert "estimated" not in Page(poles(pair(radius=None))).text


def test_every_recording_of_a_site_says_what_was_found() -> None:
    html = poles(Subject(REFUSED))
    for said in ("not recorded", "too_few_poles", "0.8 m wide, at most 0.12 m", *NAMES):
        assert said in html
    # A refused one unfolds what has too little.
    assert "<details open>" in html
    answered = document_of(made_up_site("ok", lidars=8, placements=2, count=10))
    assert "<details open>" not in poles(Subject(answered))


def test_change_without_each_placement_is_told_in_degrees_and_millimetres() -> None:
    changes = [PlacementDoc(2, 3, 0.001, 0.004), PlacementDoc(2, 2, None, None)]
    rows = listings.changes(pair(placements=changes)).rows
    assert [row[1:4] for row in rows] == [["2 + 3", "0.057", "4.0"], ["2 + 2", "–", "–"]]
    assert not listings.changes(pair(placements=changes[:1])).rows
    rows = listings.changes(Subject(WARNED)).rows
    assert [row[0] for row in rows] == ["1: morning", "2: noon", "3: after lunch", "4: evening"]
    assert rows[3][1:] == ["–", "–", "–"]


def test_hypotheses_without_icp_figures() -> None:
    def dashes(result: ResultDoc) -> int:
        return sum(row.count("–") for row in map(list, listings.hypotheses(result).rows))

    none = {"icp_rotation_rad": None, "icp_translation_m": None}
    without = [replace(each, **none) for each in RESULT.hypotheses]
    assert dashes(RESULT) == 0
    assert dashes(replace(RESULT, hypotheses=without)) == 8


def test_loops_are_closed_and_the_least_likely_comes_first() -> None:
    first = min(WARNED.loops, key=lambda each: each.probability or 0.0)
    names = [WARNED.lidars[k].name for k in first.lidars]
    assert listings.loops(WARNED).rows[0][0] == " → ".join([*names, names[0]])


def test_tests_go_by_w_and_the_rest_is_folded() -> None:
    html = listed(listings.tests(WARNED))
    named = headings(html)
    assert named[0] == "pole 2 of morning as mast-b sees it"
    assert len(named) == len(WARNED.tests)
    assert len(headings(html.split("<details>")[0])) == SHOWN
    assert "6.30 stands out" in html
    assert html.count("stands out") == 1
    assert "–" in html


def test_options_of_a_run_are_listed_where_they_are_no_defaults() -> None:
    config = RunConfig(up=True, prior_rpy_deg=(1.0, 2.0, 3.0), poles=3, frames=(None, 20, None))
    text = Page(run(pair(config=config))).text
    for said in ("upyes", "prior_rpy_deg1.0, 2.0, 3.0", "poles3", "frames:20"):
        assert said in text
    given = {"up", "prior_rpy_deg", "poles", "frames"}
    for field in msgspec.structs.fields(RunConfig):
        named = f'<th scope="row">{field.name}</th>' in run(pair(config=config))
        assert named is (field.name in given)
    assert "Every option is at its default." in Page(run(pair(config=RunConfig()))).text
    text = Page(run(Subject(REFUSED))).text
    for said in ("quay.toml", "2 cm at 30 m", "20 ± 0.5 mm"):
        assert said in text


@pytest.mark.parametrize("subject", [pair(inputs=2 * RESULT.inputs), Subject(REFUSED)])
def test_inputs_are_listed_with_their_hash_and_stay_text(subject: Subject) -> None:
    site: SiteDoc = subject.site
    text = Page(run(subject)).text
    for item in site.inputs:
        assert text.count(item.sha256) == sum(each.sha256 == item.sha256 for each in site.inputs)
    inputs = [replace(site.inputs[0], path=HOSTILE, notes=[HOSTILE])]
    page = Page(run(replaced(subject, site=replace(site, inputs=inputs))))
    assert page.open == []
    assert page.text.count(AS_SHOWN) == 2


def test_parts_have_names_that_no_two_share() -> None:
    names = [hypothesis_name(k) for k in range(60)]
    assert names[:3] == ["a", "b", "c"]
    assert len(set(names)) == 60
    assert (pole_name("target", 0), pole_name("source", 12)) == ("T0", "S12")
    assert pair_name((0, 1)) == "T0–S1"
    assert pole_labels(REFUSED) == []
    assert pole_labels(WARNED)[:4] == ["1.1", "1.2", "2.1", "2.2"]
    named = Subject(replace(WARNED, placements=["morning", "2", "", "x"]))
    assert named.placements == ["1: morning", "2", "3", "4: x"]


def test_inputs_are_named_by_file_and_topic() -> None:
    assert input_names(RESULT) == ["front.pcd", "rear.pcd"]
    config = RunConfig(target_topic="/a", source_topic="/b")
    named = input_names(replace(RESULT, config=config, inputs=2 * RESULT.inputs))
    assert named == ["front.pcd /a", "rear.pcd /b", "front.pcd /a", "rear.pcd /b"]
