"""Numbers, tables and Markdown as HTML: nothing that is written can become markup."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any
from unicodedata import category

import pytest
from msgspec.structs import replace

from retropole.base.errors import escaped
from retropole.report import render_report
from retropole.report.field_test import render_field_test
from retropole.report.listings import number
from retropole.report.page import NO_BREAK, PIECE, asset, inline, plus_minus, share_styles, table
from retropole.report.text import legible
from tests.report.hostile import everywhere, hostile_pair, hostile_site
from tests.report.made_up import AS_SHOWN, HOSTILE, Page
from tests.report.pages import STATUSES
from tests.report.test_field_test import document as field_test
from tests.report.test_field_test import made_up as measured
from tests.report.test_pole_plan import made_page


def test_numbers_that_are_none_are_dashes() -> None:
    assert number(1.25, 1, 100, " %") == "125.0 %"
    assert {number(value, 2) for value in (None, float("nan"), float("inf"))} == {"–"}
    said = [plus_minus(v).replace(NO_BREAK, " ") for v in (0.0009, 0.0234, None)]
    assert said == ["± 0.90 mm", "± 23 mm", "–"]


def test_table_escapes_every_cell() -> None:
    html = table(HOSTILE, (HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)], (1,))
    page = Page(html)
    assert page.open == []
    assert page.text.count(AS_SHOWN) == 5
    assert "script" not in [tag for tag, _ in page.tags]


def test_a_bar_is_as_long_as_its_share() -> None:
    rows = [("x", "61 %"), ("y", "7 %")]
    html = table("t", ("a", "b"), rows, (), [("source", 0.614), ("", 0.07)])
    bars = [a for tag, a in Page(html).tags if tag == "td"]
    assert [bar["class"] for bar in bars] == ["share share-61 source", "share share-7 "]
    assert "td.share-61 { --share: 61%; }" in share_styles()
    beyond = table("t", ("a", "b"), rows, (), [("", -0.1), ("", 1.2)])
    assert "share-0 " in beyond
    assert "share-100 " in beyond
    with pytest.raises(ValueError, match="zip"):
        table("t", ("a", "b"), rows, (), [("source", 0.614)])


@pytest.mark.parametrize(
    ("markdown", "html"),
    [
        ("Lower `--radius`; *never* more.", "Lower <code>--radius</code>; <em>never</em> more."),
        ("[`retropole view`](viewer.md) shows it.", "<code>retropole view</code> shows it."),
        ("It is weak. [What it costs](placing.md#cost).", "It is weak."),
        ("Fits equally. [Why](a.md). In compare: no.", "Fits equally. In compare: no."),
        ("Add one, [`--placement`](b.md).", "Add one, <code>--placement</code>."),
        ("`a * b * c`, then 2 * 3 * 4", "<code>a * b * c</code>, then 2 * 3 * 4"),
        ("a < b & *c > d*", "a &lt; b &amp; <em>c &gt; d</em>"),
    ],
)  # fmt: skip
def test_markdown_is_rendered(markdown: str, html: str) -> None:
    assert inline(markdown) == html


@pytest.mark.parametrize("frame", ["%s", "`%s`", "*%s*", "[%s](x)", "[x](%s)"])
def test_markdown_is_escaped(frame: str) -> None:
    page = Page(inline(frame % HOSTILE))
    assert page.open == []
    assert {tag for tag, _ in page.tags} <= {"code", "em"}


STEERING = "\u202e\u2066\u200f\u061c\u200b\u2060\ufeff\u00ad\u2028\u2029\x1b\x07\x85\x7f\U000e0041"
"""Marks of direction, what has no width, line ends of other kinds, control characters, a tag."""


def sign_by_sign() -> Callable[[], str]:
    """Give texts with one of these each, or with all of them."""
    count = 0

    def text() -> str:
        nonlocal count
        count += 1
        one = STEERING[count % len(STEERING)]
        return f"a{one}b {STEERING} {count}"

    return text


def pages() -> Iterator[tuple[str, str]]:
    """Give every kind of page, of which each text is one that somebody chose."""
    for status in STATUSES:
        yield (
            f"pair {status}",
            render_report(*hostile_pair(status, sign_by_sign()), notes=[STEERING], site=STEERING),
        )
        yield (
            f"site {status}",
            render_report(*hostile_site(status, sign_by_sign()), notes=[STEERING], site=STEERING),
        )
    test = field_test(measured(off=0.05))
    hostile = everywhere(test, sign_by_sign())
    pairs = [replace(each, status="fail") for each in hostile.pairs]
    yield "field test", render_field_test(replace(hostile, status="fail", pairs=pairs))
    yield "plan", made_page(name=f"a{STEERING}b", status="warn")


def texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from (key, *texts_in(each))
    elif isinstance(value, list):
        for each in value:
            yield from texts_in(each)


def steering_in(text: str) -> set[str]:
    found = {sign for sign in text if category(sign) in ("Cc", "Cf", "Zl", "Zp", "Cs")}
    return found - {"\n"}


def test_no_text_of_a_document_steers_a_page() -> None:
    count = 0
    for kind, html in pages():
        # The code of the pages is not what others wrote.
        page = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
        assert steering_in(page) == set(), kind
        assert escaped("\u202e") in page, kind
        for data in re.findall(r'<script [^>]*type="application/json"[^>]*>(.*?)</script>', page):
            texts = list(texts_in(json.loads(data)))
            assert set().union(*map(steering_in, texts)) == set(), kind
            count += len(texts)
    assert count > 100


def test_what_is_on_a_terminal_and_what_a_watch_shows_has_none() -> None:
    shown = legible({"words": [STEERING], STEERING: {"name": f"a{STEERING}"}})
    assert set().union(*map(steering_in, texts_in(shown))) == set()


def test_every_piece_has_a_name_of_its_own() -> None:
    names = PIECE.findall(asset("pieces.html"))
    assert sorted(names) == sorted({*names})
