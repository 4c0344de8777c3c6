"""No text of a document, a file, a topic or a frame becomes code in a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from retropole.base.datatypes import Detection, PointCloud, RejectedCluster, Scan
from retropole.base.errors import visible
from retropole.report import render_recordings, render_report
from tests.report.browser import Browser, WebDriverWait, needs_browser
from tests.report.hostile import hostile_pair, hostile_site
from tests.report.injections import INJECTIONS, ONLY_TEXT, injection
from tests.report.pages import STATUSES, of_each_kind

pytestmark = needs_browser


def ran(browser: Browser) -> set[int]:
    """Numbers of the injections that ran since the page was opened."""
    numbers = browser.run("return top.ran || ''").split(",")
    return {int(number) for number in numbers if number}


def press_all(browser: Browser) -> None:
    """Press every link that leads neither to a place in the page nor away, focus what can be."""
    browser.run(
        """for (const a of document.querySelectorAll('a[href]'))
             if (!/^(#|https:)/.test(a.getAttribute('href'))) a.click();
           for (const e of document.querySelectorAll('[tabindex], input, button')) e.focus();"""
    )
    browser.driver.execute_async_script("setTimeout(arguments[0], 100)")


def contexts(text: str) -> list[str]:
    """Put a text into pages that take it for markup, or for code."""
    if text.startswith(('" ', "' ")):
        return [f"<p title={text[0]}{text}{text[0]}>"]
    if "<" in text:
        return [f"<body>{text}>"]
    quoted = [f"{q}{text}{q}" for q in "'\"`"] + ['"' + text.replace('"', '\\"') + '"']
    return [f"<script>{code}</script>" for code in (text, *quoted)]


@pytest.mark.full
def test_each_injection_runs_where_it_is_taken_for_markup(browser: Browser, tmp_path: Path) -> None:
    expected = [
        k
        for k, raw in enumerate(INJECTIONS)
        if not raw.startswith(ONLY_TEXT) and "data:" not in raw and "elsewhere" not in raw
    ]
    page = tmp_path / "raw.html"
    frames = json.dumps([page for k in expected for page in contexts(injection(k))])
    page.write_text(
        "<!DOCTYPE html><meta charset=utf-8><body><script>for (const html of "
        + frames.replace("<", "\\u003c")
        + """) {
          const f = document.createElement('iframe');
          f.srcdoc = html;
          f.onload = () => f.contentDocument.querySelectorAll('.pressed, [onfocus]').forEach(
            (e) => { e.click(); e.dispatchEvent(new Event('focus')); });
          document.body.append(f);
        }</script>""",
        encoding="utf-8",
    )
    browser.driver.get(page.as_uri())
    WebDriverWait(browser.driver, 30).until(lambda _: set(expected) <= ran(browser))
    assert len(expected) >= 38
    browser.driver.get("about:blank")
    browser.logs()


def check_report(browser: Browser, tmp_path: Path, kind: str, start: int) -> set[str]:
    """Open a page of which every text is another injection, the first with number `start`."""
    given: list[str] = []

    def text() -> str:
        given.append(injection(start + len(given)))
        # Names of values and of LiDARs differ.
        return given[-1] + " " * (len(given) // len(INJECTIONS))

    status, notes = STATUSES[start // 3 % 3], [injection(start + 7), injection(start + 23)]
    if kind == "pair":
        pair = hostile_pair(status, text, keeps_status=start % 3 > 0)
        html = render_report(*pair, notes=notes)
    else:
        site = hostile_site(status, text, keeps_status=start % 3 > 0)
        html = render_report(*site, notes=notes)
    browser.open(tmp_path, html)
    press_all(browser)
    browser.run(
        """const set = (e, text, what) => { e.value = text; e.dispatchEvent(new Event(what)); };
           for (const field of document.querySelectorAll('[data-frame]'))
             for (const text of arguments[0]) set(field, text, 'input');
           for (const e of document.querySelectorAll('select'))
             for (const option of [...e.options]) set(e, option.value, 'change');
           for (const e of document.querySelectorAll('.panel, .toolbar button')) e.click();""",
        given,
    )
    browser.driver.execute_async_script("setTimeout(arguments[0], 100)")
    assert ran(browser) == set()
    assert browser.logs() == ([], [])
    counted = """return ['script', 'style', 'link', 'meta', 'base', 'img', 'animate', 'math',
        'iframe', 'object', 'video', 'audio', 'form', 'textarea', 'template'].map(
        (tag) => document.getElementsByTagName(tag).length)"""
    assert browser.run(counted) == [5, 1, 1, 4, *[0] * 11]
    attributes = """return [...document.querySelectorAll('*')].flatMap((e) => [...e.attributes])
        .filter((a) => a.name.startsWith('on')
          || a.name === 'style' && a.ownerElement.tagName !== 'CANVAS'
          || /^(href|src|action|data)$/.test(a.name) && !/^#|^data:,$/.test(a.value))
        .map((a) => a.name + '=' + a.value)"""
    assert browser.run(attributes) == []
    shown = browser.run("return document.body.textContent")
    assert "<script>" in shown
    policy = browser.run("return document.querySelector('meta[http-equiv]').content")
    assert "unsafe" not in policy
    return {text.rstrip(" ") for text in given}


@pytest.mark.full
@of_each_kind
def test_no_text_of_a_document_runs_in_the_report(
    browser: Browser, tmp_path: Path, kind: str
) -> None:
    given = check_report(browser, tmp_path, kind, 1) | check_report(browser, tmp_path, kind, 32)
    assert given >= set(map(injection, range(len(INJECTIONS))))


@pytest.mark.nightly
@of_each_kind
def test_no_text_runs_in_any_place_of_the_report(
    browser: Browser, tmp_path: Path, kind: str
) -> None:
    for start in range(len(INJECTIONS)):
        check_report(browser, tmp_path, kind, start)


NAMES = [injection(k) for k in range(len(INJECTIONS))]


@pytest.mark.full
def test_no_text_runs_in_the_page_of_recordings(browser: Browser, tmp_path: Path) -> None:
    """Of clouds by every name, in each of which clusters are rejected for every reason."""
    cloud, scans = PointCloud(np.eye(3), np.arange(3.0)), []
    for k in range(0, 3 * len(NAMES), 3):
        rejected = tuple(
            RejectedCluster(np.arange(3), np.zeros(3), cast("Any", injection(j)), injection(j + 5))
            for j in range(k, k + 3)
        )
        scans.append(Scan(cloud, detection=Detection((), rejected, 1.5, injection(k), 9)))
    browser.open(tmp_path, render_recordings(NAMES, scans, NAMES))
    press_all(browser)
    browser.run("for (const e of document.querySelectorAll('.toolbar button')) e.click();")
    seen = browser.run("return document.body.textContent")
    assert [name for name in NAMES if visible(name) not in seen] == []
    assert ran(browser) == set()
    assert browser.run("return document.querySelectorAll('iframe, object, base').length") == 0
    assert browser.logs() == ([], [])
