"""The map: LiDARs where they stand, to scale, with their uncertainty enlarged as it says."""

from __future__ import annotations

import re

import msgspec
import numpy as np
import pytest

from retropole.report.listings import pair_words
from retropole.report.map import level_of, pairs, site_map
from retropole.report.plan import Plan, plan_of
from retropole.report.subject import Subject
from tests.report.made_up import Page
from tests.report.site.made_up import NAMES, document_of, made_up_site

DOCUMENT = document_of(made_up_site(lidars=4, placements=2, count=10))
MAP = site_map(Subject(DOCUMENT), plan_of(DOCUMENT))


def places(html: str) -> np.ndarray:
    found = re.findall(r'class="place [^"]*" cx="([-\d.]+)" cy="([-\d.]+)"', html)
    return np.array(found, dtype=float)


def test_lidars_stand_to_the_scale_that_is_drawn() -> None:
    (bar,) = re.findall(r'class="bar" d="M[\d. ]+m0 -5v5h([\d.]+)v-5"/><text[^>]*>(\d+) m', MAP)
    units_per_metre = float(bar[0]) / float(bar[1])
    at = np.array([np.array(each.T_site_lidar)[:2, 3] for each in DOCUMENT.lidars])
    drawn = places(MAP) * [1, -1]
    for i in range(4):
        for j in range(i):
            apart = np.linalg.norm(drawn[i] - drawn[j]) / units_per_metre
            assert apart == pytest.approx(np.linalg.norm(at[i] - at[j]), abs=0.05)


def test_ellipses_are_enlarged_by_what_is_reported() -> None:
    (factor,) = re.findall(r"enlarged ([\d,]+) times", MAP)
    (bar,) = re.findall(r'class="bar" d="M[\d. ]+m0 -5v5h([\d.]+)v-5"/><text[^>]*>(\d+) m', MAP)
    scale = float(factor.replace(",", "")) * float(bar[0]) / float(bar[1])
    drawn = re.findall(
        r'class="ellipse lidar-(\d)" rx="([\d.]+)" ry="([\d.]+)" '
        r'transform="translate\(([\d.]+) ([\d.]+)\) rotate\(([-\d.]+)\)"',
        MAP,
    )
    assert [k for k, *_ in drawn] == ["1", "2", "3"]
    for k, *numbers in drawn:
        long, wide, x, y, turn = map(float, numbers)
        assert (x, y) == pytest.approx(places(MAP)[int(k)])
        # The picture's y axis points down.
        axis = np.array([np.cos(np.radians(turn)), -np.sin(np.radians(turn))])
        across = np.array([-axis[1], axis[0]])
        covariance = np.array(DOCUMENT.lidars[int(k)].covariance)[3:5, 3:5] * scale**2
        assert long == pytest.approx(np.sqrt(axis @ covariance @ axis), rel=0.02, abs=0.2)
        assert wide == pytest.approx(np.sqrt(across @ covariance @ across), rel=0.02, abs=0.2)


def test_everything_is_named_and_reported_in_words() -> None:
    page = Page(MAP)
    for name in NAMES[:4]:
        assert name in page.text
    assert "mast-a has none: its frame is the site's" in page.text
    assert "N" not in re.findall(r"<text[^>]*>(.*?)</text>", MAP)


def test_north_is_drawn_where_it_is_known() -> None:
    surveyed = document_of(made_up_site(lidars=3, placements=2, count=10, surveyed=True))
    html = site_map(Subject(surveyed), plan_of(surveyed))
    assert "North is at the top" in html
    assert 'class="north"' in html
    assert "P1" in re.findall(r"<text[^>]*>(.*?)</text>", html)


def test_one_lidar_upon_another_is_drawn_all_the_same() -> None:
    same = [
        msgspec.structs.replace(each, T_site_lidar=np.eye(4), covariance=np.zeros((6, 6)))
        for each in DOCUMENT.lidars
    ]
    alone = msgspec.structs.replace(DOCUMENT, lidars=same, poles=[])
    html = site_map(Subject(alone), Plan(np.eye(3), "z", None))
    assert np.isfinite(places(html)).all()
    assert "No LiDAR has an ellipse" in html


def test_a_refused_site_has_no_map() -> None:
    refused = document_of(made_up_site("refused", lidars=3, placements=2, count=10))
    assert site_map(Subject(refused), plan_of(refused)) == ""


PAIRED = document_of(made_up_site(lidars=5, placements=2, count=10))


def test_every_pair_is_a_line_as_it_stands() -> None:
    html = pairs(PAIRED).split("<figcaption>")[0]
    drawn = re.findall(r'class="pair (\w+) (\w+)"', html)
    stated = [
        (level_of(each.w), "solid" if each.standing == 1 else "dashed") for each in PAIRED.pairs
    ]
    assert sorted(drawn) == sorted(stated)


def test_the_table_says_what_colour_says() -> None:
    text = Page(pairs(PAIRED)).text
    for each in PAIRED.pairs:
        assert " – ".join(PAIRED.lidars[k].name for k in each.lidars) in text
    beyond = [each for each in PAIRED.pairs if level_of(each.w) == "blunder"]
    assert text.count("stands out") == len(beyond) > 0


@pytest.mark.parametrize(
    ("w", "level"),
    [(None, "untested"), (0.0, "calm"), (-1.9, "calm"), (2.5, "doubt"), (-9.0, "blunder")],
)
def test_levels_go_by_the_size_of_w(w: float | None, level: str) -> None:
    assert level_of(w) == level


def test_what_a_pair_says_alone() -> None:
    pair = PAIRED.pairs[0]
    words = [
        pair_words(msgspec.structs.replace(pair, standing=standing), refused=refused)
        for refused in (False, True)
        for standing in (0, 1, 2)
    ]
    assert words == [
        "linked through others",
        "decides by itself",
        "leaves 2 ways, decided by others",
        "no separate answer",
        "decides by itself",
        "leaves 2 ways",
    ]


def test_two_lidars_are_one_line_and_none_is_no_section() -> None:
    two = document_of(made_up_site(lidars=2, placements=1, count=10))
    assert len(re.findall(r'class="pair', pairs(two).split("<figcaption>")[0])) == 1
    assert pairs(msgspec.structs.replace(two, pairs=[])) == ""
