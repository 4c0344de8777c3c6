"""Loops, tests and placements: the worst first, what is not known a dash."""

from __future__ import annotations

import re

import msgspec

from retropole.report.site import checks
from retropole.report.site.checks import SHOWN, loops, without
from tests.report.made_up import Page
from tests.report.site.made_up import document_of, made_up_site

DOCUMENT = document_of(made_up_site("warn", lidars=5, placements=4, count=10))


def rows(html: str) -> list[str]:
    return re.findall(r'<th scope="row">(.*?)</th>', html)


def test_loops_are_closed_and_the_least_likely_comes_first() -> None:
    first = min(DOCUMENT.loops, key=lambda each: each.probability or 0.0)
    names = [DOCUMENT.lidars[k].name for k in first.lidars]
    assert rows(loops(DOCUMENT))[0] == " → ".join([*names, names[0]])


def test_tests_go_by_w_and_the_rest_is_folded() -> None:
    html = checks.tests(DOCUMENT)
    named = rows(html)
    assert named[0] == "pole 2 of morning as mast-b sees it"
    assert len(named) == len(DOCUMENT.tests)
    assert len(rows(html.split("<details>")[0])) == SHOWN
    assert "6.30 stands out" in html
    assert html.count("stands out") == 1


def test_what_nothing_checks_is_said() -> None:
    assert "Nothing checks 1 observation" in checks.tests(DOCUMENT)
    assert "–" in Page(checks.tests(DOCUMENT)).text


def test_a_placement_that_cannot_be_left_out_is_a_dash_with_its_reason() -> None:
    text = Page(without(DOCUMENT)).text
    assert "4: evening" in text
    assert "without that placement the others give no poses" in text
    some = [each for each in DOCUMENT.without if each.rotation is not None]
    assert "A dash" not in without(msgspec.structs.replace(DOCUMENT, without=some))


def test_nothing_checked_is_no_section() -> None:
    bare = msgspec.structs.replace(DOCUMENT, loops=[], tests=[], without=[])
    assert loops(bare) == checks.tests(bare) == without(bare) == ""
