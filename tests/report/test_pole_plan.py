"""The page of a plan: it stands alone, has the lengths to measure, and the card is printed."""

from __future__ import annotations

import base64
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from retropole.base.uncertainty.purpose import Need
from retropole.report.pole_plan import render_pole_plan, stated, stated_alone
from retropole.report.pole_plan_picture import WIDTH, drawn, view_of
from tests.report.made_up import AS_SHOWN, HOSTILE, Page
from tests.report.plans import LENGTH, made_picture, made_plan
from tests.tiers import first_of

AXE = Path(os.environ.get("AXE_CORE", ""))


def made_page(placements: int = 1, lidars: int = 2, **options: Any) -> str:
    picture = made_picture(placements, lidars)
    return render_pole_plan(made_plan(picture, **options), picture)


@pytest.mark.parametrize("placements", [1, 2])
@pytest.mark.parametrize("lidars", [2, 3])
def test_the_page_says_the_plan_and_asks_for_nothing(placements: int, lidars: int) -> None:
    html = made_page(placements, lidars, need=Need(0.02, 20.0))
    assert "default-src 'none'" in html
    assert not re.search(r"(?:src|href)=\"(?!#|data:)", html)
    body = html.partition("<body>")[2].partition("<script")[0]
    assert "$" not in body
    page = Page(body)
    assert page.open == []
    for said in ("The error to expect at 20 m is 3.2 mm.", "within 2 cm at 20 m", "worth it"):
        assert said in page.text
    assert html.count('class="certificate card"') == placements
    assert html.count("mask id=") == 2


def test_names_are_escaped() -> None:
    html = made_page(name=HOSTILE, status="warn")
    page = Page(html.partition("<body>")[2].partition("<script")[0])
    assert page.open == []
    assert "script" not in [tag for tag, _ in page.tags]
    assert AS_SHOWN in page.text


def test_it_says_and_draws_what_to_measure() -> None:
    html = made_page()
    page = Page(html.partition("<body>")[2].partition("<script")[0])
    lengths = re.findall(r"from below (\w+) to (\w): ([\d.]+ m)", page.text)
    assert ("front", "A", "5.22 m") in lengths
    assert "80 on 12 rings" in page.text
    # Two poles, each from two LiDARs, and from one to the other; on the page and on the card.
    assert html.count('class="tape"') == 2 * 5
    assert re.search(r"<text[^>]*>5.22 m</text>", html)


def test_of_several_placements_the_cards_draw_what_to_measure() -> None:
    plan = made_plan(picture := made_picture(2))
    view = view_of(plan, picture)
    assert 'class="tape"' not in drawn(plan, picture, view)
    for placement in range(2):
        html = str(drawn(plan, picture, view, placement))
        ends = re.findall(r'class="tape" d="M([-\d.]+) ([-\d.]+)l([-\d.]+) ([-\d.]+)"', html)
        found = [np.hypot(float(dx), float(dy)) / view.scale for *_, dx, dy in ends]
        measured = [each.metres for each in plan.placements[placement].tape]
        assert found == pytest.approx(measured, abs=0.02)


def test_a_place_that_was_drawn_has_no_points_and_no_recordings() -> None:
    picture = replace(made_picture(), points=())
    html = render_pole_plan(made_plan(picture), picture)
    assert "darker above" not in html
    assert "SHA-256" not in html


def test_all_that_stands_there_is_in_the_picture() -> None:
    picture = made_picture(lidars=4)
    view = view_of(made_plan(picture), picture)
    feet, axes = picture.feet[[*picture.chosen[0]]], picture.axis[[*picture.chosen[0]]]
    there = [feet, feet + LENGTH * axes, picture.lidars[:, :3, 3]]
    for x, y in view.of(np.concatenate(there)):
        assert 0 < x < WIDTH
        assert 0 < y < view.height
    # Ahead is up, left is left.
    (ahead, left) = view.way(np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert ahead == pytest.approx([0.0, -view.scale])
    assert left == pytest.approx([-view.scale, 0.0])


def test_errors_at_other_ranges_follow_from_those_stated() -> None:
    plan = made_plan(made_picture())
    for at in (5.0, 30.0, 80.0):
        other = msgspec.structs.replace(plan, range_m=at)
        assert stated_alone(other)[0] == pytest.approx(5 * stated(other)[0], rel=1e-6)


def test_it_is_small() -> None:
    assert len(made_page()) < 200_000


# --- in a browser ---

pytest.importorskip("selenium", reason="selenium is not installed")

from tests.report.browser import Browser, needs_browser  # noqa: E402
from tests.report.test_accessibility import AUDIT, serious  # noqa: E402


@needs_browser
@pytest.mark.full
def test_a_phone_shows_it_whole_and_a_finger_hits(phone: Browser, tmp_path: Path) -> None:
    phone.open(tmp_path, made_page(2))
    assert phone.run("return document.documentElement.scrollWidth") <= 390
    small = phone.run(
        "return [...document.querySelectorAll('a, button, select, summary, .lengths label')]"
        ".filter((e) => e.offsetParent && !e.classList.contains('skip'))"
        ".map((e) => [e.outerHTML.slice(0, 100), e.getBoundingClientRect()])"
        ".filter(([, b]) => b.width < 44 || b.height < 44).map(([html]) => html)"
    )
    assert small == []
    assert phone.logs() == ([], [])


@needs_browser
@pytest.mark.full
@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not installed")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_serious_is_found(browser: Browser, tmp_path: Path, scheme: str) -> None:
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.open(tmp_path, made_page(2, 3, status="warn"))
        browser.run(AXE.read_text(encoding="utf-8"))
        found = browser.driver.execute_async_script(AUDIT)
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert serious(found["violations"]) == []


@needs_browser
@pytest.mark.full
@pytest.mark.skipif(not shutil.which("pdftotext"), reason="poppler-utils is not installed")
@pytest.mark.parametrize("placements", first_of([1, 2]))
def test_the_cards_are_printed_first_a_sheet_each(
    browser: Browser, tmp_path: Path, placements: int
) -> None:
    browser.open(tmp_path, made_page(placements))
    pages = _printed(browser, tmp_path)
    for k in range(placements):
        assert pages[k].split()[:5] == ["Where", "to", "set", "up", "the"] or placements > 1
        assert f"to {'BDFH'[k]}:" in pages[k]
        assert "Place and date" in pages[k]
    assert len(pages) <= placements + 2
    assert not re.search(r"[Pp]ress|Drag|Back to", "".join(pages))
    browser.run("window.print = () => {}")
    browser.find("#print-certificate").click()
    browser.run("document.documentElement.dataset.print = 'certificate'")
    assert len(_printed(browser, tmp_path)) == placements


def _printed(browser: Browser, folder: Path) -> list[str]:
    pdf = browser.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    path = folder / "plan.pdf"
    path.write_bytes(base64.b64decode(pdf["data"]))
    words = ["pdftotext", "-layout", str(path), "-"]
    done = subprocess.run(words, capture_output=True, check=True)
    return done.stdout.decode().rstrip("\f").split("\f")
