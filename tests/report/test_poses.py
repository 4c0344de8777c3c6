"""The poses: every one can be read, copied and doubted, its error told by state and by source."""

from __future__ import annotations

import json
import re
from dataclasses import replace as replaced
from html import unescape

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.bounded import Status
from retropole.base.uncertainty.purpose import Fitness
from retropole.export import FORMATS, export_lines
from retropole.report import render_report
from retropole.report.curves import error_curve
from retropole.report.listings import error_parts
from retropole.report.page import NO_BREAK, fill
from retropole.report.poses import FRAMES, LISTED_SOURCES, UNFOLDED, certainty, poses, transform
from retropole.report.poses import certificate as certificate_of
from retropole.report.subject import Subject, as_subject
from retropole.result import BudgetEntry, ResultDoc
from retropole.result.site import LIDARS
from tests.report.made_up import AS_SHOWN, BUDGET, HOSTILE, RANDOM, T_TRUE, Page, made_up
from tests.report.pages import of_each_kind, page_of, subject_of
from tests.report.site.made_up import document_of, made_up_site

RESULT = made_up(count=500).result
SITE = subject_of("site")


def whole(subject: Subject) -> str:
    """The transform of a pair and how certain it is, as they stand on the page."""
    return transform(subject, error_curve(subject)) + certainty(subject)


def of_result(**fields: object) -> Page:
    page = Page(whole(as_subject(replace(RESULT, **fields), ())))
    assert page.open == []
    return page


@of_each_kind
def test_a_refused_page_gives_no_pose_to_copy(kind: str) -> None:
    html = page_of(kind, "refused")
    assert "data-export" not in html.split("<script")[0]
    assert poses(subject_of(kind, "refused")) == ""
    assert whole(subject_of(kind, "refused")) == ""
    assert "too_wide" in html
    assert all(pose["id"] != "result" for pose in json.loads(Page(html).data)["poses"])


def test_lines_to_copy_are_those_of_export() -> None:
    html = whole(as_subject(RESULT, ()))
    written = dict(re.findall(r'data-export="(\w+)">(.*?)</pre>', html, re.S))
    expected = export_lines(T_TRUE, *FRAMES, "verdict of the calibration: ok")
    assert set(written) == set(expected)
    assert set(UNFOLDED) <= set(expected)
    for key, text in expected.items():
        assert unescape(written[key]) == text.strip()
    matrix = [line.split() for line in unescape(written["cloudcompare"]).splitlines()[:4]]
    assert np.allclose(np.array(matrix, dtype=float), T_TRUE, atol=1e-12)


def test_what_is_copied_of_a_site_is_the_pose_of_each_lidar() -> None:
    found = re.findall(r'data-export="matrix">(.*?)</pre>', poses(SITE), re.DOTALL)
    for text, lidar in zip(found, SITE.site.lidars, strict=True):
        (read,) = FORMATS["matrix"].read(unescape(text).encode())
        assert np.allclose(read.pose(), np.array(lidar.T_site_lidar))
        assert (read.parent, read.child) == ("site", lidar.name)


def test_each_pose_of_a_site_has_its_certainty_and_what_it_is_made_of() -> None:
    text = Page(poses(SITE)).text
    assert text.count("Sources of the error") == 3
    assert "Its frame is that of the site: its pose has no error." in text
    assert "range offset of gate" in text
    assert "-0.000" not in text


def test_poses_are_in_the_coordinates_of_the_frame() -> None:
    frame = replace(SITE.site.frame, offset=np.array([565_000.0, 5_934_000.0, 0.0]))
    far = Page(poses(Subject(replace(SITE.site, frame=frame)))).text
    for said in ("Add (565000.000, 5934000.000, 0.000) m", "565013.980", "5934001.500"):
        assert said in far
    assert "Add (" not in poses(SITE)


def test_a_name_that_no_frame_can_have_is_shown_and_not_copied() -> None:
    lidars = list(SITE.site.lidars)
    lidars[1] = replace(lidars[1], name=f"a\nb{HOSTILE}")
    lidars[2] = replace(lidars[2], name="site")
    page = Page(poses(replaced(SITE, site=replace(SITE.site, lidars=lidars))))
    assert page.open == []
    assert "lidar_1" in page.text
    assert "site_frame" in page.text


def test_a_covariance_is_recognized_by_its_states() -> None:
    page = of_result()
    assert page.text.count("height along the poles: 6.0 mm") == 1
    for said in ("rotation about x (phi_x)0.013°0.0057°0.011°", "(delta_z)4.1 mm1.1 mm4.0 mm"):
        assert said in page.text
    assert "R_true = Exp(phi) R" in page.text
    assert "gives no covariance" in of_result(covariance=None).text


def test_both_parts_are_reported_at_every_range() -> None:
    text = of_result().text.replace(NO_BREAK, " ")
    parts = error_parts(RESULT.predicted_error, RESULT.uncertainty)
    assert [f"{each.range_m:g}" for each in parts] == ["1", "10", "30", "60"]
    # At 60 m the rotation rules: √(2/3) of its σ over all axes, with that of the translation.
    turned = np.sqrt(2 / 3 * np.trace(RANDOM[:3, :3])) * 60
    random = 1000 * np.hypot(turned, np.sqrt(np.trace(RANDOM[3:, 3:])))
    assert re.search(rf"60 m± \d+ mm{random:.1f} mm", text)
    for each in parts:
        assert np.hypot(each.random, each.systematic) == pytest.approx(each.together)


def test_every_source_of_error_is_listed_the_largest_first() -> None:
    page = of_result(budget=list(BUDGET[::-1]))
    listed = page.text[page.text.index("Error budget") :]
    places = [listed.index(entry.name) for entry in BUDGET]
    assert places == sorted(places)
    for said in (
        "range offsetsource10 mm-12 mm58 %",
        "elevation of the beamssource0.029°–14 %",
        "scale of rangestarget0.20 ‰-0.03 ‰3 %",
        "radius of the poles0.42 mm0.31 mm< 1 %",
    ):
        assert said in listed
    bars = [str(a["class"]) for tag, a in page.tags if "share" in str(a.get("class"))]
    assert bars[0].split()[1] == "share-58"
    assert "1 smaller, together < 1 %" in listed
    assert len(bars) == len(BUDGET)


def test_the_largest_of_many_small_errors_is_not_folded_away() -> None:
    many = [replace(BUDGET[0], name=f"part {k}", share_at_30m=0.004) for k in range(200)]
    html = whole(as_subject(replace(RESULT, budget=many), ()))
    budget = html[html.index("Sources of the error") :]
    assert "part 0" in budget.split("<details>")[0]
    assert "199 smaller, together 80 %" in budget
    assert "smaller" not in of_result(budget=many[:1]).text


def test_words_of_a_budget_stay_words() -> None:
    hostile: list[BudgetEntry] = [replace(entry, name=HOSTILE) for entry in BUDGET]
    # Each in the table, and the largest in a sentence.
    assert of_result(budget=hostile).text.count(AS_SHOWN) == len(hostile) + 1


def test_a_result_that_does_not_state_its_parts_shows_the_whole() -> None:
    older: ResultDoc = replace(RESULT, uncertainty=None, budget=None)
    page = of_result(uncertainty=None, budget=None)
    assert "(delta_z)4.1 mm" in page.text
    for word in ("systematic", "Error budget"):
        assert word not in page.text
    assert error_parts(older.predicted_error, older.uncertainty) == []


TO_FILL = fill("to-fill")


def certificate(result: ResultDoc, place: str = "", serials: tuple[str, str] = ("", "")) -> str:
    return certificate_of(as_subject(result, (), dict(zip(LIDARS, serials, strict=True))), place)


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


def test_the_tolerance_is_what_was_requested() -> None:
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
