"""A page is one file that opens offline, says all the result says, and runs nothing of it."""

from __future__ import annotations

import base64
import hashlib
import json
import re

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.bounded import Status
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.base.errors import visible
from retropole.report import render_recordings, render_report
from retropole.report.view import MAX_PAIR_POINTS
from retropole.result import PlacementDoc, PolesDoc, ResultDoc, RunConfig, StagesDoc, encode
from tests.report.hostile import hostile_pair, hostile_site
from tests.report.made_up import HOSTILE, Page, made_up, placement_of
from tests.report.pages import cloud_of, of_each_kind, page_of, subject_of, with_each_verdict
from tests.report.site.made_up import document_of, made_up_site

MOST_BYTES = 20e6
"""Of a page of eight LiDARs and as many placements as there may be (chosen: an e-mail's limit)."""

PARTS = {
    "pair": {"transform", "view-title", "next", "hypotheses", "certainty", "poles", "run"},
    "site": {
        *("poses", "map", "view-title", "next", "certainty", "pairs", "loops", "tests"),
        *("placements", "poles", "run"),
    },
}
"""What can be reached on the page of an answer."""


@of_each_kind
@with_each_verdict
def test_a_page_is_whole_and_every_part_of_it_can_be_reached(kind: str, status: Status) -> None:
    page = Page(page_of(kind, status))
    assert page.open == []
    for reason in subject_of(kind, status).site.reasons:
        assert reason.code in page.text
        assert reason.message in page.text
        assert "What to do" in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {str(attributes["href"])[1:] for tag, attributes in page.tags if tag == "a"}
    assert links <= set(ids)
    answered = {"transform", "next", "certainty", "poses", "map", "loops", "tests", "placements"}
    refused = answered if status == "refused" else set()
    assert links - {"main"} == PARTS[kind] - refused
    assert json.loads(page.data)["status"] == status


@of_each_kind
def test_every_button_and_field_has_a_name(kind: str) -> None:
    html = page_of(kind)
    for tag, attributes in Page(html).tags:
        if tag == "button":
            assert attributes.get("type") == "button"
    for body in re.findall(r"<button[^>]*>(.*?)</button>", html.split("<script")[0], re.S):
        assert re.sub("<[^>]*>", "", body).strip()
    assert len(re.findall(r"<(?:input|select)\b", html.split("<script")[0])) == len(
        re.findall(r"<label[^>]*>[^<]*<(?:input|select)\b", html.split("<script")[0])
    )


@of_each_kind
def test_a_page_asks_for_nothing_from_anywhere(kind: str) -> None:
    html = page_of(kind)
    page = Page(html)
    for tag, attributes in page.tags:
        for name in ("src", "href", "action", "srcset", "data", "poster"):
            if tag != "a":
                assert str(attributes.get(name) or "data:").startswith("data:")
    style = html.split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    # The one address in the page is the name of XHTML, by which three.js makes a canvas.
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) <= {"http://www.w3.org/1999/xhtml"}
    (policy,) = (a for tag, a in page.tags if tag == "meta" and "http-equiv" in a)
    assert policy["http-equiv"] == "Content-Security-Policy"
    assert str(policy["content"]).startswith("default-src 'none';")
    assert "unsafe" not in str(policy["content"])
    hashed = re.findall(r"<(?:script|style)>(.*?)</(?:script|style)>", html, re.DOTALL)
    assert len(hashed) == 5
    for text in hashed:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in str(policy["content"])
    # No style and no handler of an element's own: the policy would not let them pass.
    assert not [a for _, a in page.tags if any(n == "style" or n[:2] == "on" for n in a)]


@of_each_kind
@with_each_verdict
def test_text_of_a_run_stays_text(kind: str, status: Status) -> None:
    given: list[str] = []

    def text() -> str:
        given.append(f"{HOSTILE}{len(given)}")
        return given[-1]

    if kind == "pair":
        html = render_report(*hostile_pair(status, text), notes=[text()])
    else:
        html = render_report(*hostile_site(status, text), notes=[text()])
    page = Page(html)
    # Its data, three.js, and three of its own.
    assert [tag for tag, _ in page.tags].count("script") == 5
    assert page.open == []
    assert page.text.count("window.injected=1") >= 30
    assert visible(given[-1]) in page.text


def incomplete(result: ResultDoc) -> dict[str, ResultDoc]:
    """The result without what a document may lack."""
    lacking = {"covariance": None, "predicted_error": None, "weakest": None}
    return {
        "hypotheses": replace(result, hypotheses=[], margin=None),
        "uncertainty": replace(result, stages=StagesDoc(None, None), **lacking),
        "poles": replace(result, poles=PolesDoc([], []), hypotheses=[]),
        "inputs": replace(result, inputs=[], seconds={}),
    }


@pytest.mark.parametrize("missing", ["hypotheses", "uncertainty", "poles", "inputs"])
@pytest.mark.parametrize("status", ["ok", "refused"])
def test_what_may_be_missing_may_be_missing(status: Status, missing: str) -> None:
    result, placements = made_up(status, 500)
    without = incomplete(result)[missing]
    undetected = [Placement(Scan(p.target.cloud), Scan(p.source.cloud)) for p in placements]
    for each in (placements, undetected):
        assert Page(render_report(without, each)).open == []


def test_a_page_of_nothing_or_of_another_site_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one placement"):
        render_report(made_up(count=500).result, [])
    site = made_up_site(lidars=3, placements=2, count=20)
    for other in (made_up_site(lidars=4, placements=2), made_up_site(lidars=3, placements=1)):
        with pytest.raises(ValueError, match="other LiDARs or placements"):
            render_report(document_of(site), other.scans)


def test_a_page_without_clouds_has_all_but_the_view() -> None:
    page = Page(render_report(document_of(made_up_site(lidars=3, count=20))))
    assert page.data == "null"
    assert not [tag for tag, _ in page.tags if tag == "canvas"]
    assert "Poses of the LiDARs; frame: " in page.text


@with_each_verdict
def test_a_result_is_not_changed(status: Status) -> None:
    result, placements = made_up(status, 500)
    before = encode(result)
    render_report(result, placements)
    assert encode(result) == before


def random_cloud(count: int) -> PointCloud:
    rng = np.random.default_rng(5)
    return PointCloud(rng.uniform(-80, 80, (count, 3)), rng.uniform(0, 255, count))


@pytest.mark.full
def test_a_page_stays_small_and_says_how_much_it_shows() -> None:
    result = made_up(count=500).result
    page = render_report(result, [placement_of(random_cloud(100_000))])
    assert "the page shows 200,000 of 200,000 points" in page
    assert len(page.encode()) < 3e6
    some = render_report(result, [placement_of(random_cloud(2000))], max_points=700)
    assert "the page shows 1,400 of 4,000 points" in some


@pytest.mark.full
def test_pages_of_many_clouds_stay_small() -> None:
    page = render_report(made_up(count=500).result, 10 * [placement_of(random_cloud(60_000))])
    assert f"shows {MAX_PAIR_POINTS:,} of 1,200,000 points" in Page(page).text
    assert len(page.encode()) < 8e6
    site = made_up_site(placements=2, count=100_000)
    page = render_report(document_of(site), site.scans)
    assert len(page.encode()) < MOST_BYTES
    shown = re.findall(r"the page shows ([\d,]+) of ([\d,]+) points", page)[0]
    assert int(shown[0].replace(",", "")) > 1_400_000


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_hardly_any_points(count: int) -> None:
    cloud = PointCloud(np.full((count, 3), 2.0), np.zeros(count))
    html = render_report(made_up("refused", 500).result, [placement_of(cloud)])
    assert Page(html).open == []


def test_several_placements_are_reported_and_packed() -> None:
    result, (placement,) = made_up(count=500)
    changes = ((0.001, 0.004), (0.002, 0.0123), (None, None))
    result = replace(
        result,
        placements=[PlacementDoc(2, 2, *change) for change in changes],
        inputs=3 * result.inputs,
    )
    unsearched = Placement(Scan(placement.target.cloud), Scan(placement.source.cloud))
    page = Page(render_report(result, [placement, placement, unsearched]))
    for said in ("0.057", "12.3", "3: front.pcd ← rear.pcd", "2 + 2", "2 LiDARs, 3 placements"):
        assert said in page.text
    packed = json.loads(page.data)["clouds"]
    assert [(c["lidar"], c["placement"]) for c in packed] == [
        (k, j) for k in (0, 1) for j in (0, 1, 2)
    ]
    assert [len(c["poles"]) for c in packed] == [2, 2, 0, 2, 2, 0]
    assert [len(c["rejected"]) for c in packed] == [1, 1, 0, 1, 1, 0]


def test_topics_tell_two_lidars_of_one_bag_apart() -> None:
    result, placements = made_up(count=500)
    bag = [replace(item, path="/data/drive.bag") for item in result.inputs]
    config = RunConfig(target_topic="/front", source_topic="/rear")
    text = Page(render_report(replace(result, inputs=bag, config=config), placements)).text
    assert "drive.bag /front" in text
    assert "drive.bag /rear" in text


@of_each_kind
def test_notes_stand_before_the_verdict(kind: str) -> None:
    page = Page(page_of(kind, notes=(HOSTILE,)))
    sentence = {"pair": "Points up to 30 m away", "site": "Calibrated: "}[kind]
    assert page.text.index("window.injected") < page.text.index(sentence)


def test_the_page_of_recordings_says_what_was_found() -> None:
    page = Page(page_of("recordings"))
    assert page.open == []
    assert "2 poles in" in page.text
    assert "no_intensity: it has none." in page.text
    assert "frames  1\nrings  64" in page_of("recordings")
    links = {str(attributes["href"])[1:] for tag, attributes in page.tags if tag == "a"}
    assert links == {"main", "view-title", "recording-0", "recording-1", "recording-2"}
    alone = render_recordings(["front.pcd"], [Scan(cloud_of(300))])
    assert "<h1>front.pcd</h1>" in alone
    assert "data-lidar" not in alone.split("<script")[0]
