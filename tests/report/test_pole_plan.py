"""The page of a plan: it stands alone, poles move, the error follows, and the card is printed."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from retropole.api.plan_checking import load_plan
from retropole.base.datatypes import Array
from retropole.base.uncertainty.purpose import Need
from retropole.planning.comparison import against_plan
from retropole.report.pole_plan import PlanPicture, render_pole_plan
from retropole.report.pole_plan_data import PackedRoots, packed, stated, stated_alone
from retropole.report.pole_plan_picture import WIDTH, view_of
from retropole.result.pole_plan import (
    PolePlanDoc,
)
from tests.report.made_up import AS_SHOWN, HOSTILE, Page
from tests.report.plans import LENGTH, Model, made_picture, made_plan, model, tape_of
from tests.tiers import first_of

AXE = Path(os.environ.get("AXE_CORE", ""))


def made_page(placements: int = 1, lidars: int = 2, **options: Any) -> str:
    picture = made_picture(placements, lidars)
    return render_pole_plan(made_plan(picture, **options), picture)


def data_of(html: str) -> dict[str, Any]:
    text = html.rpartition('id="data">')[2].partition("</script>")[0]
    data: dict[str, Any] = json.loads(text)
    return data


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
    assert AS_SHOWN in data_of(html)["lidars"]


def test_it_reads_without_code() -> None:
    page = Page(made_page().partition("<body>")[2].partition("<script")[0])
    hidden = [a["class"] for tag, a in page.tags if tag in ("p", "div") and "hidden" in a]
    # What only the code can do is not offered.
    assert hidden == ["choices", "back", "note hint-of-poles"]
    lengths = re.findall(r"from below (\w+) to (\w): ([\d.]+ m)", page.text)
    assert ("front", "A", "5.22 m") in lengths
    assert "80 on 12 rings" in page.text


def test_a_place_that_was_drawn_has_no_points_and_no_recordings() -> None:
    picture = replace(made_picture(), points=())
    html = render_pole_plan(made_plan(picture), picture)
    assert "darker where" not in html
    assert "SHA-256" not in html


def test_all_that_stands_there_is_in_the_picture() -> None:
    picture = made_picture(lidars=4)
    view = view_of(picture, LENGTH)
    tops = picture.foot + LENGTH * picture.axis
    for x, y in view.of(np.concatenate([picture.foot, tops, picture.lidars[:, :3, 3]])):
        assert 0 < x < WIDTH
        assert 0 < y < view.height
    # Ahead is up, left is left.
    (ahead, left) = view.way(np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert ahead == pytest.approx([0.0, -view.scale])
    assert left == pytest.approx([-view.scale, 0.0])


def test_roots_are_packed_as_they_are() -> None:
    given = model(3, 20)
    text = packed(given)
    unpacked = Model(_floats(text.rows).reshape(-1, 6, text.size), np.array(text.rest), [])
    columns = np.frombuffer(base64.b64decode(text.roots), "<i2").reshape(-1, text.size)
    columns = columns * _floats(text.scales)[:, None]
    for part in np.split(columns, np.cumsum(text.ranks)[:-1]):
        unpacked.roots.append(part.T)
    for chosen in ([0], [3, 7], [1, 2, 19]):
        assert unpacked.error(chosen) == pytest.approx(given.error(chosen), rel=1e-3)


def _floats(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), "<f4").astype(float)


def test_errors_at_other_ranges_follow_from_those_stated() -> None:
    plan = made_plan(made_picture())
    for at in (5.0, 30.0, 80.0):
        other = msgspec.structs.replace(plan, range_m=at)
        assert stated_alone(other)[0] == pytest.approx(5 * stated(other)[0], rel=1e-6)


def test_packed_is_small() -> None:
    assert isinstance(packed(model(0, 3)), PackedRoots)
    assert len(made_page()) < 400_000


# --- in a browser ---

pytest.importorskip("selenium", reason="selenium is not installed")

from tests.report.browser import Browser, needs_browser  # noqa: E402
from tests.report.test_accessibility import AUDIT, serious  # noqa: E402

SHOWN = "return document.querySelector(arguments[0]).textContent"
AT = """
    const b = document.querySelector(`#picture [data-pole="${arguments[0]}"] .foot`)
      .getBoundingClientRect();
    return [b.x + b.width / 2, b.y + b.height / 2];
"""


def metres(text: str) -> float:
    """Read the error that the page shows now."""
    found = re.search(r"now ([\d.]+) (mm|m)", text)
    assert found is not None, text
    return float(found[1]) * (1e-3 if found[2] == "mm" else 1.0)


def expected(picture: PlanPicture, plan: PolePlanDoc, chosen: list[int]) -> list[float]:
    own = [k for each in picture.chosen for k in each]
    models = [(picture.together, stated(plan)), (picture.alone, stated_alone(plan))]
    found = []
    for each, said in models:
        assert isinstance(each, Model)
        found.append(max(said) * each.error(chosen) / each.error(own))
    return found


@needs_browser
@pytest.mark.full
def test_a_pole_goes_where_the_arrow_key_points_and_the_error_follows(
    browser: Browser, tmp_path: Path
) -> None:
    picture = made_picture()
    plan = made_plan(picture)
    browser.open(tmp_path, render_pole_plan(plan, picture))
    assert "now" not in browser.run(SHOWN, "#now-together")
    from selenium.webdriver.common.keys import Keys

    pole = browser.find('#picture [data-pole="0"]')
    browser.run("arguments[0].focus()", pole)
    # Up in the picture is ahead: from (5, -1.5) ... one row of the grid further.
    first = picture.chosen[0][0]
    pole.send_keys(Keys.ARROW_UP)
    chosen = [first + 15, picture.chosen[0][1]]
    assert picture.foot[chosen[0]] == pytest.approx(picture.foot[first] + [1.5, 0.0, 0.0])
    for name, size in zip(("together", "alone"), expected(picture, plan, chosen), strict=True):
        assert metres(browser.run(SHOWN, f"#now-{name}")) == pytest.approx(size, rel=0.06)
    away = np.linalg.norm(picture.foot[chosen[0], :2])
    assert f"below front to A: {away:.2f} m" in browser.run(SHOWN, '.card [data-tape="0-0"]')
    assert browser.run(SHOWN, '.row [data-words="0"]') == picture.words[chosen[0]]
    assert browser.find("#back").is_displayed()
    pole.send_keys(Keys.HOME)
    assert "now" not in browser.run(SHOWN, "#now-together")
    assert browser.logs() == ([], [])


@needs_browser
@pytest.mark.full
def test_a_pole_is_dragged_and_warned_of(browser: Browser, tmp_path: Path) -> None:
    picture = made_picture()
    browser.open(tmp_path, made_page())
    browser.run("document.querySelector('#picture').scrollIntoView({block: 'center'})")
    from selenium.webdriver.common.action_chains import ActionChains

    (x, y), (to_x, to_y) = browser.run(AT, 0), browser.run(AT, 1)
    pole = browser.find('#picture [data-pole="0"] .foot')
    drag = ActionChains(browser.driver).click_and_hold(pole)
    half_x, half_y = int((to_x - x) / 2), int((to_y - y) / 2)
    drag.move_by_offset(half_x, half_y)
    drag.move_by_offset(round(to_x - x) - half_x, round(to_y - y) - half_y)
    drag.release().perform()
    assert "nearer to each other than 1 m" in browser.run(SHOWN, "#warnings")
    assert browser.run(AT, 0) == pytest.approx(browser.run(AT, 1), abs=1)
    # It leans as it did; another lean is chosen from a list.
    first = picture.chosen[0][1] // 3 * 3
    assert browser.run(SHOWN, '.row [data-words="0"]') == picture.words[first]
    browser.run(
        "const s = document.querySelector('[data-lean=\"0\"]'); s.value = arguments[0];"
        "s.dispatchEvent(new Event('change'))",
        str(first + 2),
    )
    assert browser.run(SHOWN, '.row [data-words="0"]') == picture.words[first + 2]
    browser.find("#back").click()
    assert browser.run("return document.querySelector('#warnings').hidden")
    assert browser.run(AT, 0) == pytest.approx([x, y], abs=1)


@needs_browser
@pytest.mark.full
def test_two_that_lean_alike_are_warned_of(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, made_page())
    options = "return [...document.querySelector('[data-lean=\"0\"]')].map((o) => o.textContent)"
    assert browser.run(options) == ["upright", "20° away", "20° left"]
    browser.run(
        "const s = document.querySelector('[data-lean=\"0\"]'); s.selectedIndex = 2;"
        "s.dispatchEvent(new Event('change'))"
    )
    assert "lean by the same angle" in browser.run(SHOWN, "#warnings")


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
    phone.find('[data-show="1"]').click()
    assert len(phone.driver.find_elements("css selector", "#picture .stand.faded")) == 2
    phone.find("#closer").click()
    box = phone.run("return document.querySelector('#picture').getAttribute('viewBox')")
    assert float(box.split()[2]) == WIDTH / 2


@needs_browser
@pytest.mark.full
@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not installed")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_serious_is_found(browser: Browser, tmp_path: Path, scheme: str) -> None:
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.open(tmp_path, made_page(2, 3, status="warn"))
        browser.run("document.querySelector('#picture .stand').focus()")
        browser.press("\ue014", "#picture .stand")
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
        assert pages[k].split()[:5] == ["Where", "to", "stand", "the", "poles"] or placements > 1
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


class Finger:
    """A finger on the screen, by the events that Chromium has from a touch screen."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    def send(self, kind: str, *points: tuple[float, float]) -> None:
        given = {"type": kind, "touchPoints": [{"x": x, "y": y} for x, y in points]}
        self.browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", given)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.send("touchStart", start)
        for part in np.linspace(0.1, 1.0, 10):
            x, y = np.array(start) + part * (np.array(end) - start)
            self.send("touchMove", (float(x), float(y)))
        self.send("touchEnd")


SCROLLED = "return document.scrollingElement.scrollTop"


@needs_browser
@pytest.mark.full
def test_a_finger_drags_a_pole_and_scrolls_beside_it(phone: Browser, tmp_path: Path) -> None:
    phone.open(tmp_path, made_page())
    phone.run("document.querySelector('#picture').scrollIntoView({block: 'center'})")
    finger, before = Finger(phone), phone.run(SCROLLED)
    # Along the axis in which the page scrolls.
    x, y = phone.run(AT, 0)
    finger.drag((x, y), (x, y - 60))
    after_x, after_y = phone.run(AT, 0)
    assert phone.run(SCROLLED) == before
    assert after_y < y - 30
    assert after_x == pytest.approx(x, abs=20)
    assert "now" in phone.run(SHOWN, "#now-together")
    # Beside the poles the picture scrolls with the page.
    box = phone.run(
        "const b = document.querySelector('#picture').getBoundingClientRect();"
        "return [b.x + 8, b.y + b.height / 2]"
    )
    finger.drag((box[0], box[1]), (box[0], box[1] - 120))
    phone.driver.execute_async_script("const done = arguments[0]; setTimeout(done, 400)")
    assert phone.run(SCROLLED) > before + 60


@needs_browser
@pytest.mark.parametrize(("placements", "lidars"), [(1, 2), (2, 3)])
@pytest.mark.full
def test_a_moved_plan_is_saved_as_a_plan(
    browser: Browser, tmp_path: Path, placements: int, lidars: int
) -> None:
    picture = made_picture(placements, lidars)
    plan = made_plan(picture, need=Need(0.02, 20.0))
    folder = tmp_path / "saved"
    behaviour = {"behavior": "allow", "downloadPath": str(folder)}
    browser.driver.execute_cdp_cmd("Browser.setDownloadBehavior", behaviour)
    browser.open(tmp_path, render_pole_plan(plan, picture))
    assert not browser.find("#save").is_displayed()
    browser.run("arguments[0].focus()", browser.find('#picture [data-pole="0"]'))
    browser.press("\ue013", '#picture [data-pole="0"]')
    browser.find("#save").click()
    for _ in range(100):
        if list(folder.glob("*.json")):
            break
        time.sleep(0.05)
    saved = load_plan(folder / "moved-plan.json", of_pair=lidars == 2)
    assert browser.logs() == ([], [])
    chosen = [list(own) for own in picture.chosen]
    chosen[0][0] += 15
    poles = [pole for each in saved.placements for pole in each.poles]
    for pole, k in zip(poles, (k for own in chosen for k in own), strict=True):
        assert pole.foot_m == pytest.approx(picture.foot[k], abs=1e-3)
        assert pole.direction == pytest.approx(picture.axis[k], abs=1e-4)
        assert pole.words == f"pole {pole.name}: {picture.words[k]}"
        assert [each.returns for each in pole.seen] == [80] * lidars
    # Its own lengths to measure, and the error as the page computes it; nothing else is left.
    assert saved.moved is not None
    assert saved.moved.poles == ["A"]
    expected_m = expected(picture, plan, [k for own in chosen for k in own])
    assert len(saved.moved.errors) == lidars - 1
    for field, size in zip(("sigma_m", "alone_m"), expected_m, strict=True):
        found = max(getattr(each, field) for each in saved.moved.errors)
        assert lidars > 2 or found == pytest.approx(size, rel=1e-3)
    assert (saved.predicted, saved.more, saved.rehearsal, saved.probability) == ([], [], None, None)
    first = saved.placements[0]
    assert [each.metres for each in first.tape] == pytest.approx(
        [each.metres for each in tape_of(first.poles, saved.lidars)], abs=1e-3
    )
    assert against_plan(saved, [], "front").placement in range(placements)
