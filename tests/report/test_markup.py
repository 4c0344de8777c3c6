"""Numbers, tables and Markdown as HTML: nothing that is written can become markup."""

from __future__ import annotations

import pytest

from retropole.report.certainty import number
from retropole.report.page import NO_BREAK, inline, plus_minus, share_styles, table
from tests.report.made_up import HOSTILE, Page


def test_numbers_that_are_none_are_dashes() -> None:
    assert number(1.25, 1, 100, " %") == "125.0 %"
    assert {number(value, 2) for value in (None, float("nan"), float("inf"))} == {"–"}
    said = [plus_minus(v).replace(NO_BREAK, " ") for v in (0.0009, 0.0234, None)]
    assert said == ["± 0.90 mm", "± 23 mm", "–"]


def test_table_escapes_every_cell() -> None:
    html = table(HOSTILE, (HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)], (1,))
    page = Page(html)
    assert page.open == []
    assert page.text.count(HOSTILE) == 5
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
