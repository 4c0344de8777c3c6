"""The graph of pairs: drawn and said alike, so that colour is never alone."""

from __future__ import annotations

import re

import msgspec
import pytest

from retropole.report.listings import pair_words
from retropole.report.pairs import level_of, pairs
from tests.report.made_up import Page
from tests.report.site.made_up import document_of, made_up_site

DOCUMENT = document_of(made_up_site(lidars=5, placements=2, count=10))


def test_every_pair_is_a_line_as_it_stands() -> None:
    html = pairs(DOCUMENT).split("<figcaption>")[0]
    drawn = re.findall(r'class="pair (\w+) (\w+)"', html)
    stated = [
        (level_of(each.w), "solid" if each.standing == 1 else "dashed") for each in DOCUMENT.pairs
    ]
    assert sorted(drawn) == sorted(stated)


def test_the_table_says_what_colour_says() -> None:
    text = Page(pairs(DOCUMENT)).text
    for each in DOCUMENT.pairs:
        assert " – ".join(DOCUMENT.lidars[k].name for k in each.lidars) in text
    beyond = [each for each in DOCUMENT.pairs if level_of(each.w) == "blunder"]
    assert text.count("stands out") == len(beyond) > 0


@pytest.mark.parametrize(
    ("w", "level"),
    [(None, "untested"), (0.0, "calm"), (-1.9, "calm"), (2.5, "doubt"), (-9.0, "blunder")],
)
def test_levels_go_by_the_size_of_w(w: float | None, level: str) -> None:
    assert level_of(w) == level


def test_what_a_pair_says_alone() -> None:
    pair = DOCUMENT.pairs[0]
    words = [
        pair_words(msgspec.structs.replace(pair, standing=standing), refused=refused)
        for refused in (False, True)
        for standing in (0, 1, 2)
    ]
    assert words == [
        "linked through others",
        "decides by itself",
        "leaves 2 ways, others decide",
        "no answer of its own",
        "decides by itself",
        "leaves 2 ways",
    ]


def test_two_lidars_are_one_line_and_none_is_no_section() -> None:
    two = document_of(made_up_site(lidars=2, placements=1, count=10))
    assert len(re.findall(r'class="pair', pairs(two).split("<figcaption>")[0])) == 1
    assert pairs(msgspec.structs.replace(two, pairs=[])) == ""
