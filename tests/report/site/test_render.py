"""The page of a site: whole, offline, small enough, and text stays text."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from retropole.base.bounded import Status
from retropole.report.site import render_site, write_site_report
from tests.report.made_up import HOSTILE, Page
from tests.report.site.made_up import document_of, made_up_site

MOST_BYTES = 20e6
"""Of a page of eight LiDARs and as many placements as there may be (chosen: an e-mail's limit)."""


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_every_part_that_there_is_can_be_reached(status: Status) -> None:
    site = made_up_site(status, lidars=4, placements=2, count=50)
    html = render_site(document_of(site), site)
    page = Page(html)
    assert page.open == []
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [a["href"] for tag, a in page.tags if tag == "a"]
    assert {str(link)[1:] for link in links} <= set(ids)
    answered = {"map", "view-title", "pairs", "loops", "tests", "placements", "poses", "found"}
    refused = {"view-title", "found", "pairs", "run"}
    assert (refused if status == "refused" else answered) <= {str(link)[1:] for link in links}
    assert json.loads(page.data)["status"] == status


def test_the_page_asks_for_nothing_from_anywhere() -> None:
    site = made_up_site(lidars=3, placements=1, count=50)
    html = render_site(document_of(site), site)
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) <= {"http://www.w3.org/1999/xhtml"}
    assert "unsafe" not in html.split("</head>")[0].split("<style>")[0]
    assert not re.findall(r"<[^>]* style=", html.split("<script")[0])


def test_a_page_without_clouds_has_all_but_the_view() -> None:
    page = Page(render_site(document_of(made_up_site(lidars=3, count=20))))
    assert page.data == "null"
    assert not [tag for tag, _ in page.tags if tag == "canvas"]
    assert "Poses of all LiDARs" in page.text


def test_what_others_wrote_stays_text() -> None:
    site = made_up_site("warn", lidars=3, placements=2, count=20)
    lidars = tuple(
        replace(lidar, name=f"{HOSTILE}{k}", serial=HOSTILE)
        for k, lidar in enumerate(site.site.lidars)
    )
    hostile = replace(
        site,
        datum=HOSTILE,
        site=replace(
            site.site,
            name=HOSTILE,
            lidars=lidars,
            placements=(HOSTILE, "b"),
            frame=msgspec.structs.replace(site.site.frame, name=HOSTILE),
        ),
        poles=tuple(msgspec.structs.replace(pole, name=HOSTILE) for pole in site.poles),
        tests=tuple(replace(test, name=HOSTILE) for test in site.tests),
        reasons=(replace(site.reasons[0], message=HOSTILE),),
    )
    page = Page(render_site(document_of(hostile), hostile, notes=[HOSTILE]))
    assert page.open == []
    # Its data, three.js, and three of its own.
    assert [tag for tag, _ in page.tags].count("script") == 5
    assert page.text.count(HOSTILE) > 20


def test_a_document_of_another_site_is_an_error() -> None:
    site = made_up_site(lidars=3, placements=2, count=20)
    other = msgspec.structs.replace(document_of(site), placements=["a", "b"])
    with pytest.raises(ValueError, match="placements"):
        render_site(other, site)
    with pytest.raises(ValueError, match="LiDARs"):
        render_site(document_of(site), made_up_site(lidars=4, placements=2, count=20))


def test_eight_lidars_of_many_points_stay_small(tmp_path: Path) -> None:
    # Without intensity the points are as many, and the clouds are made in no time.
    site = made_up_site(placements=2, count=100_000)
    path = tmp_path / "report.html"
    write_site_report(path, document_of(site), site)
    assert path.stat().st_size < MOST_BYTES
    shown = re.findall(r"the page holds ([\d,]+) of ([\d,]+) points", path.read_text())[0]
    assert int(shown[0].replace(",", "")) > 1_400_000
