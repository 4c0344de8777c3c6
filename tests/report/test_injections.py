"""No text of a document, a file, a topic or a frame becomes code in the report or the viewer."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from retropole.base.bounded import Status
from retropole.base.datatypes import Detection, Placement, PointCloud, RejectedCluster, Scan
from retropole.report import render_report
from retropole.report.viewer import Shown, Viewer, serve
from retropole.result import ResultDoc
from tests.report.browser import Browser, WebDriverWait, needs_browser
from tests.report.injections import INJECTIONS, ONLY_TEXT, injection
from tests.report.made_up import made_up

pytestmark = needs_browser


def everywhere(value: Any, text: Callable[[], str]) -> Any:
    """Put a text in place of every string of a document, names of values too."""
    if isinstance(value, str):
        return text()
    if isinstance(value, msgspec.Struct):
        fields = {name: everywhere(getattr(value, name), text) for name in value.__struct_fields__}
        return msgspec.structs.replace(value, **fields)
    if isinstance(value, dict):
        return {text(): everywhere(each, text) for each in value.values()}
    if isinstance(value, list | tuple):
        return type(value)(everywhere(each, text) for each in value)
    return value


def hostile(start: int, status: Status) -> tuple[ResultDoc, list[Placement], list[str]]:
    """Make up a run whose every string is another injection, the first with number `start`."""
    given: list[str] = []

    def text() -> str:
        given.append(injection(start + len(given)))
        # Names of values differ.
        return given[-1] + " " * (len(given) // len(INJECTIONS))

    result, placements = made_up(status, 200)
    config = msgspec.structs.replace(result.config, target_topic="/a", source_topic="/b")
    result = everywhere(msgspec.structs.replace(result, config=config), text)
    if start % 3:
        result = msgspec.structs.replace(result, status=status)

    def scan(given: Scan) -> Scan:
        detection = given.detection
        assert detection is not None
        rejected = tuple(
            replace(r, code=cast("Any", text()), reason=text()) for r in detection.rejected
        )
        detection = replace(detection, rejected=rejected, threshold_source=text())
        return replace(given, detection=detection)

    hostile = [Placement(scan(p.target), scan(p.source)) for p in placements]
    return result, [*hostile, *hostile], given


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


def check_report(browser: Browser, tmp_path: Path, start: int) -> set[str]:
    statuses: tuple[Status, ...] = ("ok", "warn", "refused")
    status = statuses[start // 3 % 3]
    result, placements, given = hostile(start, status)
    html = render_report(result, placements, notes=[injection(start + 7), injection(start + 23)])
    browser.open(tmp_path, html)
    press_all(browser)
    browser.run(
        """const set = (e, text, what) => { e.value = text; e.dispatchEvent(new Event(what)); };
           for (const field of document.querySelectorAll('[data-frame]'))
             for (const text of arguments[0]) set(field, text, 'input');
           for (const e of document.querySelectorAll('select'))
             for (const option of [...e.options]) set(e, option.value, 'change');
           for (const e of document.querySelectorAll('.panel, [data-mode]')) e.click();""",
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


def test_no_text_of_a_document_runs_in_the_report(browser: Browser, tmp_path: Path) -> None:
    given = check_report(browser, tmp_path, 1) | check_report(browser, tmp_path, 32)
    assert given >= set(map(injection, range(len(INJECTIONS))))


@pytest.mark.slow
def test_no_text_runs_in_any_place_of_the_report(browser: Browser, tmp_path: Path) -> None:
    for start in range(len(INJECTIONS)):
        check_report(browser, tmp_path, start)


NAMES = [injection(k) for k in range(len(INJECTIONS))]


@pytest.fixture(scope="module")
def hostile_viewer() -> Iterator[Viewer]:
    """A viewer of clouds by every name, in each of which clusters are rejected for every reason."""
    pytest.importorskip("viser", reason="viser is not installed (extra 'view')")
    count = 0

    def found(_: float | None) -> Detection:
        nonlocal count
        count += 3
        rejected = tuple(
            RejectedCluster(np.arange(3), np.zeros(3), cast("Any", injection(j)), injection(j + 5))
            for j in range(count, count + 3)
        )
        return Detection((), rejected, 200.0, injection(count), 9)

    cloud = PointCloud(np.eye(3), np.arange(3.0))
    served = serve([Shown(name, cloud, found) for name in NAMES], port=9010)
    yield served
    served.stop()


# The browser ends first: viser waits for the connections that it holds ready.
@pytest.mark.slow
def test_no_text_runs_in_the_viewer(hostile_viewer: Viewer, browser: Browser) -> None:
    browser.driver.get(hostile_viewer.url)
    text = "return document.body.textContent"
    WebDriverWait(browser.driver, 60).until(
        lambda _: browser.run(text).count("rejected:") == len(NAMES)
    )
    # An address in words becomes a link; where it leads is what is read.
    links = "return [...document.querySelectorAll('a[href]')].map((a) => a.href)"
    assert {link.partition("/")[0] for link in browser.run(links)} <= {"https:"}
    press_all(browser)
    seen = browser.run(text)
    assert [name for name in NAMES if name.replace("\x00", "\ufffd") not in seen] == []
    assert ran(browser) == set()
    assert browser.run("return document.querySelectorAll('iframe, object, base').length") == 0
    own = hostile_viewer.url.split("/")[2]
    assert [url for url in browser.logs()[1] if own not in url] == []
