"""Numbers, tables and Markdown as HTML: nothing that is written can become markup."""

from __future__ import annotations

import pytest

from retropole.report.markup import NO_BREAK, centimetres, inline, number, table
from tests.report.made_up import HOSTILE, Page


def test_numbers_that_are_none_are_dashes() -> None:
    assert number(1.25, 1, 100, " %") == "125.0 %"
    assert {number(value, 2) for value in (None, float("nan"), float("inf"))} == {"–"}
    said = [centimetres(v).replace(NO_BREAK, " ") for v in (0.0009, 0.0234, None)]
    assert said == ["± 0.09 cm", "± 2.3 cm", "–"]


def test_table_escapes_every_cell() -> None:
    html = table(HOSTILE, (HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)], (1,))
    page = Page(html)
    assert page.open == []
    assert page.text.count(HOSTILE) == 5
    assert "script" not in [tag for tag, _ in page.tags]


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
