"""The page tells the covariance by its states, its ranges and its sources, in both kinds."""

from __future__ import annotations

import re

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.report.certainty import error_parts
from retropole.report.markup import NO_BREAK
from retropole.report.uncertainty import uncertainty
from tests.report.made_up import BUDGET, HOSTILE, RANDOM, Page, made_up


def test_covariance_is_told_by_its_states() -> None:
    page = Page(uncertainty(made_up(count=500).result))
    assert page.open == []
    assert "Least certain, at the poles: height along the poles: 6.0 mm" in page.text
    for said in ("rotation about x (phi_x)0.013°0.0057°0.011°", "(delta_z)4.1 mm1.1 mm4.0 mm"):
        assert said in page.text
    assert "R_true = Exp(phi) R" in page.text
    assert uncertainty(made_up("refused", 500).result) == ""


def test_a_pose_without_covariance_says_so() -> None:
    result = replace(made_up(count=500).result, covariance=None)
    assert "gives no covariance" in Page(uncertainty(result)).text


def test_both_parts_are_told_at_every_range() -> None:
    result = made_up(count=500).result
    text = Page(uncertainty(result)).text.replace(NO_BREAK, " ")
    assert [f"{each.range_m:g}" for each in error_parts(result)] == ["1", "10", "30", "60"]
    # At 60 m the rotation rules: √(2/3) of its σ over all axes, with that of the translation.
    turned = np.sqrt(2 / 3 * np.trace(RANDOM[:3, :3])) * 60
    random = 1000 * np.hypot(turned, np.sqrt(np.trace(RANDOM[3:, 3:])))
    assert re.search(rf"60 m± \d+ mm{random:.1f} mm", text)
    for each in error_parts(result):
        assert np.hypot(each.random, each.systematic) == pytest.approx(each.together)


def test_every_source_of_error_is_listed_the_largest_first() -> None:
    result = made_up(count=500).result
    assert result.budget is not None
    page = Page(uncertainty(replace(result, budget=result.budget[::-1])))
    assert page.open == []
    listed = page.text[page.text.index("Error budget") :]
    places = [listed.index(entry.name) for entry in BUDGET]
    assert places == sorted(places)
    for said in (
        "range offsetsource10 mm-12 mm58 %",
        "elevation of the beamssource0.029°–14 %",
        "scale of rangestarget0.20 ‰-0.03 ‰3 %",
        "radius of the poles–0.42 mm0.31 mm< 1 %",
    ):
        assert said in listed
    bars = [str(a["class"]) for tag, a in page.tags if "share" in str(a.get("class"))]
    assert bars[0].split()[1] == "share-58"
    assert "1 smaller, together < 1 %" in listed
    assert len(bars) == len(BUDGET)


def test_the_largest_of_many_small_errors_is_not_folded_away() -> None:
    result = made_up(count=500).result
    assert result.budget is not None
    many = [replace(result.budget[0], name=f"part {k}", share_at_30m=0.004) for k in range(200)]
    html = uncertainty(replace(result, budget=many))
    assert "part 0" in html.split("<details>")[0]
    assert "199 smaller, together 80 %" in html
    single = uncertainty(replace(result, budget=many[:1]))
    assert "smaller" not in single


def test_words_of_a_budget_stay_words() -> None:
    result = made_up(count=500).result
    assert result.budget is not None
    hostile = [replace(entry, name=HOSTILE) for entry in result.budget]
    page = Page(uncertainty(replace(result, budget=hostile)))
    assert page.open == []
    assert page.text.count(HOSTILE) == len(hostile)


def test_a_result_that_does_not_state_its_parts_shows_the_whole() -> None:
    result = replace(made_up(count=500).result, uncertainty=None, budget=None)
    page = Page(uncertainty(result))
    assert page.open == []
    assert "(delta_z)4.1 mm" in page.text
    for word in ("systematic", "Error budget"):
        assert word not in page.text
    assert error_parts(result) == []
