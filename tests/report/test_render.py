"""The report is one file that opens offline, says all the result says, and runs nothing of it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.bounded import Status
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.report import render_report, write_report
from retropole.report.render import MAX_PAGE_POINTS_TOGETHER
from retropole.result import (
    PlacementDoc,
    PolesDoc,
    ReasonDoc,
    ResultDoc,
    RunConfig,
    StagesDoc,
    encode,
)
from tests.paths import PACKAGE
from tests.report.made_up import HOSTILE, Page, made_up, placement_of


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_page_is_well_formed_and_names_each_reason(status: Status) -> None:
    result, placements = made_up(status, 500)
    page = Page(render_report(result, placements))
    assert page.open == []
    for reason in result.reasons:
        assert reason.code in page.text
        assert reason.message in page.text
        assert "What to do" in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_every_button_and_field_has_a_name() -> None:
    html = render_report(*made_up(count=500))
    for tag, attributes in Page(html).tags:
        if tag == "button":
            assert attributes.get("type") == "button"
    for body in re.findall(r"<button[^>]*>(.*?)</button>", html.split("<script")[0], re.S):
        assert re.sub("<[^>]*>", "", body).strip()
    assert len(re.findall(r"<(?:input|select)\b", html.split("<script")[0])) == len(
        re.findall(r"<label[^>]*>[^<]*<(?:input|select)\b", html.split("<script")[0])
    )


def test_page_asks_for_nothing_from_anywhere() -> None:
    html = render_report(*made_up(count=500))
    for tag, attributes in Page(html).tags:
        for name in ("src", "href", "action", "srcset", "data", "poster"):
            if tag != "a":
                assert str(attributes.get(name) or "data:").startswith("data:")
    style = html.split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    # The one address in the page is the name of XHTML, by which three.js makes a canvas.
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) <= {"http://www.w3.org/1999/xhtml"}
    (policy,) = (a for tag, a in Page(html).tags if tag == "meta" and "http-equiv" in a)
    assert policy["http-equiv"] == "Content-Security-Policy"
    assert str(policy["content"]).startswith("default-src 'none';")
    assert "unsafe" not in str(policy["content"])
    hashed = re.findall(r"<(?:script|style)>(.*?)</(?:script|style)>", html, re.DOTALL)
    assert len(hashed) == 5
    for text in hashed:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in str(policy["content"])
    # No style and no handler of an element's own: the policy would not let them pass.
    assert not [a for _, a in Page(html).tags if any(n == "style" or n[:2] == "on" for n in a)]


def test_text_of_the_run_stays_text() -> None:
    result, placements = made_up("refused", 500)
    hostile = replace(
        result,
        status=HOSTILE,
        reasons=[ReasonDoc(HOSTILE, HOSTILE, {})],
        inputs=[
            replace(item, path=f"/data/{HOSTILE.replace('/', '')}.pcd", sensor=HOSTILE)
            for item in result.inputs
        ],
        config=RunConfig(sensor_target=HOSTILE, sensor_source=HOSTILE),
        seconds={HOSTILE: 1.0},
        version=HOSTILE,
        created=HOSTILE,
    )
    page = Page(render_report(hostile, placements))
    assert [tag for tag, _ in page.tags].count("script") == 5
    assert page.open == []
    assert page.text.count("window.injected=1") >= 9
    assert json.loads(page.data)["status"] == HOSTILE


def incomplete(result: ResultDoc) -> dict[str, ResultDoc]:
    """The result without what a document may lack."""
    return {
        "hypotheses": replace(result, hypotheses=[], margin=None),
        "uncertainty": replace(
            result,
            stages=StagesDoc(None, None),
            covariance=None,
            predicted_error=None,
            weakest=None,
        ),
        "poles": replace(result, poles=PolesDoc([], []), hypotheses=[]),
        "inputs": replace(result, inputs=[], seconds={}),
    }


@pytest.mark.parametrize("missing", ["hypotheses", "uncertainty", "poles", "inputs"])
@pytest.mark.parametrize("status", ["ok", "refused"])
def test_what_may_be_missing_may_be_missing(status: Status, missing: str) -> None:
    result, placements = made_up(status, 500)
    without = incomplete(result)[missing]
    undetected = [
        Placement(Scan(placement.target.cloud), Scan(placement.source.cloud))
        for placement in placements
    ]
    for each in (placements, undetected):
        assert Page(render_report(without, each)).open == []


def test_page_of_no_placement_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one placement"):
        render_report(made_up(count=500).result, [])


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_result_is_not_changed(status: Status) -> None:
    result, placements = made_up(status, 500)
    before = encode(result)
    render_report(result, placements)
    assert encode(result) == before


def test_subsampled_clouds_are_said_to_be_subsampled() -> None:
    run = made_up(count=2000)
    page = Page(render_report(*run, max_points=700))
    assert "target: showing 700 of 2,160 points" in page.text
    assert "source: showing 700 of 2,160 points" in page.text
    whole = Page(render_report(*run))
    assert "target: showing 2,160 of 2,160 points" in whole.text


def random_cloud(count: int) -> PointCloud:
    rng = np.random.default_rng(5)
    return PointCloud(rng.uniform(-80, 80, (count, 3)), rng.uniform(0, 255, count))


def test_page_stays_small() -> None:
    page = render_report(made_up(count=500).result, [placement_of(random_cloud(100_000))])
    assert "target: showing 100,000 of 100,000 points" in Page(page).text
    assert len(page.encode()) < 3e6


@pytest.mark.slow
def test_page_of_many_placements_stays_small() -> None:
    placements = 10 * [placement_of(random_cloud(60_000))]
    page = render_report(made_up(count=500).result, placements)
    assert f"showing {MAX_PAGE_POINTS_TOGETHER // 20:,} of 60,000 points" in Page(page).text
    assert len(page.encode()) < 8e6


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_hardly_any_points(count: int) -> None:
    cloud = PointCloud(np.full((count, 3), 2.0), np.zeros(count))
    html = render_report(made_up("refused", 500).result, [placement_of(cloud)])
    assert Page(html).open == []


def test_several_placements_are_told_and_packed() -> None:
    result, (placement,) = made_up(count=500)
    result = replace(
        result,
        placements=[
            PlacementDoc(2, 2, angle, metres)
            for angle, metres in ((0.001, 0.004), (0.002, 0.0123), (None, None))
        ],
        inputs=3 * result.inputs,
    )
    unsearched = Placement(Scan(placement.target.cloud), Scan(placement.source.cloud))
    page = Page(render_report(result, [placement, placement, unsearched]))
    for said in ("Placements", "0.057", "12.3", "placement 3", "source 3", "(and 2 more)"):
        assert said in page.text
    packed = json.loads(page.data)["placements"]
    assert [len(p["poles"][0]) for p in packed] == [2, 2, 0]
    assert [len(p["rejected"][1]) for p in packed] == [1, 1, 0]
    assert packed[0]["poles"] == packed[1]["poles"]


def test_topics_tell_two_lidars_of_one_bag_apart() -> None:
    result, placements = made_up(count=500)
    result = replace(
        result,
        inputs=[replace(item, path="/data/drive.bag") for item in result.inputs],
        config=RunConfig(target_topic="/front", source_topic="/rear"),
    )
    text = Page(render_report(result, placements)).text
    assert "drive.bag /front" in text
    assert "drive.bag /rear" in text


def test_notes_stand_before_the_verdict_as_text() -> None:
    page = Page(render_report(*made_up(count=500), notes=[HOSTILE]))
    assert page.open == []
    assert page.text.index("window.injected") < page.text.index("The transform below maps")


def luminance(colour: str) -> float:
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", [0, 1, 2], ids=["light", "dark by system", "dark by button"])
def test_colours_are_told_apart(theme: int) -> None:
    """WCAG 2: 4.5 to 1 for text, 3 to 1 for what is drawn."""
    style = (PACKAGE / "report" / "assets" / "style.css").read_text()
    block = [b for b in re.findall(r"{([^{}]*)}", style) if "--ground" in b][theme]
    colour = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", block))
    for front, back, least in (
        ("text", "ground", 4.5), ("text", "card", 4.5), ("soft", "card", 4.5),
        ("soft", "ground", 4.5), ("text", "press", 4.5), ("text", "warn-soft", 4.5),
        ("accent", "card", 4.5), ("accent", "ground", 4.5),
        ("ok", "card", 4.5), ("ok", "ok-soft", 4.5), ("warn", "card", 4.5),
        ("warn", "warn-soft", 4.5), ("refused", "card", 4.5), ("refused", "refused-soft", 4.5),
        ("target", "view", 3.0), ("source", "view", 3.0), ("denied", "view", 3.0),
        ("soft", "view", 4.5),
    ):  # fmt: skip
        a, b = sorted((luminance(colour[front]), luminance(colour[back])))
        assert (b + 0.05) / (a + 0.05) >= least, (front, back)


def test_write_report_writes_the_page(tmp_path: Path) -> None:
    run = made_up(count=500)
    write_report(tmp_path / "new" / "report.html", *run)
    written = (tmp_path / "new" / "report.html").read_text(encoding="utf-8")
    assert written == render_report(*run)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["report.html"]
