"""The report on a phone: a finger scrolls the page, a tap hands it the view, targets are large."""

from __future__ import annotations

from pathlib import Path

import pytest

from retropole.base.bounded import Status
from retropole.report import render_report
from tests.report.browser import Browser, needs_browser
from tests.report.made_up import made_up
from tests.report.pages import of_each_kind, page_of, with_each_verdict

pytestmark = [needs_browser, pytest.mark.full]

LEAST_TARGET = 44
"""CSS pixels of a target's height and width (WCAG 2.2, 2.5.5)."""


def touch(browser: Browser, x: float, y: float, dx: int = 0, dy: int = 0) -> None:
    """Put a finger down, move it, and lift it."""
    steps = [0.1 * k for k in range(1, 11)] if dx or dy else []
    points = [("touchStart", x, y), *(("touchMove", x + s * dx, y + s * dy) for s in steps)]
    for kind, px, py in points:
        event = {"type": kind, "touchPoints": [{"x": px, "y": py}]}
        browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", event)
    event = {"type": "touchEnd", "touchPoints": []}
    browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", event)
    browser.driver.execute_async_script("setTimeout(arguments[0], 300)")


def swipe(browser: Browser, dx: int, dy: int) -> float:
    """Move a finger from the middle of the view, and say how far the page has scrolled."""
    x, y, before = browser.run(
        "document.querySelector('.stage').scrollIntoView({behavior: 'instant', block: 'center'});"
        "const b = document.querySelector('#marks').getBoundingClientRect();"
        "return [b.x + b.width / 2, b.y + b.height / 2, scrollY]"
    )
    touch(browser, x, y, dx, dy)
    return float(browser.run("return scrollY")) - float(before)


def tap(browser: Browser, selector: str) -> None:
    x, y = browser.run(
        "const e = document.querySelector(arguments[0]);"
        "e.scrollIntoView({behavior: 'instant', block: 'center'});"
        "const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]",
        selector,
    )
    touch(browser, x, y)


@pytest.mark.nightly  # of two busy cores a swipe may end before the page has scrolled
def test_a_finger_scrolls_the_page_and_a_tap_hands_it_the_view(
    phone: Browser, tmp_path: Path
) -> None:
    phone.open(tmp_path, render_report(*made_up(count=6000)))
    # What is drawn over the points shows where they are looked at from, to the pixel.
    drawn = "return document.querySelector('#marks').toDataURL()"
    phone.picture()
    seen = phone.run(drawn)
    assert "Tap" in phone.find("#hint").text
    assert swipe(phone, 0, -200) > 100
    assert phone.run(drawn) == seen
    tap(phone, "#marks")
    assert phone.root("active") == "view"
    assert "tap outside the view" in phone.find("#hint").text
    assert swipe(phone, 120, -200) == 0
    assert phone.run(drawn) != seen
    tap(phone, "#state")
    assert phone.root("active") == ""
    assert swipe(phone, 0, -200) > 100


@of_each_kind
@with_each_verdict
def test_targets_are_as_large_as_a_finger(
    phone: Browser, tmp_path: Path, kind: str, status: Status
) -> None:
    phone.open(tmp_path, page_of(kind, status))
    small = phone.run(
        "for (const d of document.querySelectorAll('details')) d.open = true;"
        "return [...document.querySelectorAll('a, button, select, input, summary')]"
        ".filter((e) => e.offsetParent && !e.classList.contains('skip'))"
        ".map((e) => [e.outerHTML.slice(0, 120), e.getBoundingClientRect()])"
        ".filter(([_, b]) => b.width < arguments[0] || b.height < arguments[0])"
        ".map(([html, b]) => `${html}: ${b.width} x ${b.height}`)",
        LEAST_TARGET,
    )
    assert small == []


def test_what_is_wider_than_the_screen_says_that_it_scrolls(phone: Browser, tmp_path: Path) -> None:
    phone.open(tmp_path, render_report(*made_up(count=500)))
    wrong = phone.run(
        "return [...document.querySelectorAll('.scroll')].filter((e) => e.checkVisibility())"
        ".filter((e) => (e.scrollWidth > e.clientWidth + 1) !== e.hasAttribute('data-scrolls')"
        ").length"
    )
    assert wrong == 0
    said = "return getComputedStyle(document.querySelector(arguments[0]), '::after').content"
    narrow = {"width": 320, "height": 700, "deviceScaleFactor": 2, "mobile": True}
    phone.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", narrow)
    phone.driver.execute_async_script("setTimeout(arguments[0], 200)")
    assert phone.find("main .scroll:has(.matrix)").get_attribute("data-scrolls") is not None
    assert "scrolls" in phone.run(said, "main .scroll:has(.matrix) caption")


def test_a_path_is_copied_as_it_is(phone: Browser, tmp_path: Path) -> None:
    result, placements = made_up(count=500)
    phone.open(tmp_path, render_report(result, placements))
    copied = phone.run(
        "const cell = document.querySelector('#run ~ .scroll td.text');"
        "getSelection().selectAllChildren(cell); return getSelection().toString()"
    )
    assert copied == result.inputs[0].path
