"""The certificate says what was calibrated, how well and from what; else it has a line to fill."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from retropole.base.bounded import Status
from retropole.base.uncertainty.purpose import Fitness
from retropole.report import render_report
from retropole.report.page import fill
from retropole.report.poses import LISTED_SOURCES
from retropole.report.poses import certificate as certificate_of
from retropole.report.subject import Subject, of_pair
from retropole.result import ResultDoc
from tests.report.made_up import HOSTILE, Page, made_up
from tests.report.site.made_up import document_of, made_up_site

TO_FILL = fill("to-fill")


def certificate(result: ResultDoc, place: str = "", serials: tuple[str, str] = ("", "")) -> str:
    return certificate_of(of_pair(result, (), serials), place)


def test_it_states_all_that_a_reader_would_ask_for() -> None:
    result = made_up().result
    html = certificate(result, "Pier 4", ("11002", "11007"))
    text = Page(html).text.replace("\u00a0", " ")
    assert result.T_target_source is not None
    for row in result.T_target_source:
        for value in row:
            assert f"{value:.6f}" in text
    for item in result.inputs:
        assert item.path in text
        assert item.sha256 in text
    for said in ("Pier 4", "11002", "11007", "VLP-16", result.created, "Signature", "Calibrated"):
        assert said in text
    for error in ("at range", "60 m", "± 16 mm", "rotation about z", "412 patches agree"):
        assert error in text
    assert result.budget is not None
    assert result.budget[0].name in text
    # The site and the serial numbers are given; the tolerance and the target's model are not.
    assert html.count(TO_FILL) == 3


def test_what_is_not_given_is_a_line_to_write_on() -> None:
    assert certificate(made_up().result).count(TO_FILL) == 6


def test_the_tolerance_is_what_was_asked_for() -> None:
    asked = Fitness(0.02, 30.0, "yes", 0.98, 0.018, "within 2 cm <at> 30 m: yes, 98 % sure")
    html = certificate(replace(made_up().result, fitness=asked))
    assert html.count(TO_FILL) == 4
    assert "Within 2 cm <at> 30 m: yes, 98 % sure" in Page(html).text


def test_a_warning_is_on_it_by_its_code() -> None:
    result = made_up("warn").result
    text = Page(certificate(result)).text
    assert "Calibrated, with a warning: " in text
    assert all(reason.code in text for reason in result.reasons)


def test_shares_of_the_budget_are_all_there() -> None:
    result = made_up().result
    assert result.budget is not None
    many = [replace(result.budget[0], name=f"kind {k}", share_at_30m=0.05) for k in range(20)]
    text = Page(certificate(replace(result, budget=many))).text
    assert f"{20 - LISTED_SOURCES} smaller" in text
    assert "60 %" in text


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_only_an_answer_has_one(status: Status) -> None:
    html = render_report(*made_up(status, 500))
    assert ('id="certificate"' in html) is (status != "refused")
    assert ('id="print-certificate"' in html) is (status != "refused")


def test_a_site_has_one_with_every_pose_and_what_checked_it() -> None:
    site = document_of(made_up_site("ok", lidars=4, placements=2, count=20))
    text = Page(certificate_of(Subject(site), "Pier 4")).text.replace("\u00a0", " ")
    for lidar in site.lidars:
        assert lidar.T_site_lidar is not None
        for said in (lidar.name, f"{lidar.T_site_lidar[0, 3]:.3f}"):
            assert said in text
    for item in site.inputs:
        assert item.sha256 in text
    for said in ("Pier 4", site.datum, "none suspicious", "Where a point lands", "Signature"):
        assert said in text
    assert site.name in Page(certificate_of(Subject(site))).text
    refused = document_of(made_up_site("refused", lidars=4, placements=2, count=20))
    assert certificate_of(Subject(refused)) == ""


def test_what_is_given_stays_text() -> None:
    page = Page(certificate(made_up().result, HOSTILE, (HOSTILE, HOSTILE)))
    assert page.open == []
    assert "script" not in {tag for tag, _ in page.tags}
    assert page.text.count("window.injected=1") == 3
