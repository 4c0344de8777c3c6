"""The page of a watch in a phone's browser: one thing to do, in large, whatever else is shown."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from retropole.base.uncertainty import ErrorAtRange
from retropole.base.uncertainty.purpose import Need
from retropole.report.watch_server import WatchServer, watch_page
from retropole.result.watching import LidarNow, PoleNow, WatchDoc
from tests.report.browser import Browser, WebDriverWait, needs_browser
from tests.report.hostile import everywhere
from tests.report.made_up import HOSTILE, Page

AXE = Path(os.environ.get("AXE_CORE", ""))

PHONE = (360, 740)
SIZES = {"phone": PHONE, "on its side": (740, 360), "desk": (1300, 900)}

HEARD = """
    window.heard = []; window.shaken = [];
    navigator.vibrate = (pattern) => { shaken.push(pattern); return true; };
    window.AudioContext = class extends AudioContext {
      createOscillator() {
        const made = super.createOscillator();
        const start = made.start.bind(made);
        made.start = (at) => { heard.push(made.frequency.value); start(at); };
        return made;
      }
    };
"""
"""Notes which tones a page plays, and how it shakes the phone."""


LUMINANCE = """
    const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    function luminance(colour) {
      canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
      const [r, g, b] = [...canvas.getImageData(0, 0, 1, 1).data].slice(0, 3).map((c) => c / 255)
        .map((c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
      return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    }
    function ground(node) {
      const colour = getComputedStyle(node).backgroundColor;
      return colour === "rgba(0, 0, 0, 0)" && node.parentElement
        ? ground(node.parentElement) : colour;
    }
    return [...document.querySelectorAll("body *")].filter((e) => e.checkVisibility())
      .filter((e) => [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))
      .map((e) => [luminance(getComputedStyle(e).color), luminance(ground(e)), e.outerHTML])
      .map(([a, b, html]) => [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), html])
      .sort((a, b) => a[0] - b[0]);
"""
"""The contrast of every text with what is behind it, the least first."""


def pole(name: str, is_good: bool = True, word: str = "", rings: int | None = 12) -> PoleNow:
    return PoleNow(
        name=name,
        distance_m=7.416,
        returns=1320,
        rings=rings,
        is_still=is_good,
        is_good=is_good,
        word=word,
    )


def lidar(name: str, *poles: PoleNow, word: str = "", age_s: float | None = 0.12) -> LidarNow:
    return LidarNow(
        name=name,
        source=f"/{name}/points",
        sweeps_per_s=9.97,
        age_s=age_s,
        points=52_341,
        poles=list(poles),
        word=word,
    )


PLACING = WatchDoc(
    phase="placing",
    is_good=False,
    code="pole_moves",
    next="Hold pole B still",
    seconds=3.0,
    lidars=[
        lidar("front", pole("A"), pole("B", False, "moving")),
        lidar("rear", pole("A", rings=None), word="12 % of its sweeps are lost"),
    ],
    angle_rad=0.6,
    words=["The front LiDAR is heard.", "Pole A is seen.", "Pole B is seen."],
)
CAPTURING = WatchDoc(
    phase="capturing",
    is_good=True,
    code="capturing",
    next="Keep the poles still",
    seconds=9.0,
    lidars=[lidar("front", pole("A"), pole("B")), lidar("rear", pole("A"), pole("B"))],
    angle_rad=0.6,
    captured=8,
    wanted=30,
    placements=1,
    need=Need(0.02, 30.0),
    predicted_error=[ErrorAtRange(10.0, 0.0043), ErrorAtRange(30.0, 0.0124)],
    bound_m=0.0305,
    probability=0.405,
    words=[*PLACING.words, "Both poles stand still."],
)
DONE = msgspec.structs.replace(
    CAPTURING,
    phase="done",
    code="done",
    next="Done: it is as accurate as it must be. Collect the poles",
    captured=30,
    placements=3,
    bound_m=0.0142,
    probability=0.994,
    status="ok",
)


class Watch:
    """A watch that says what a test sets; its seconds go on."""

    def __init__(self) -> None:
        self.doc: WatchDoc = PLACING
        self.is_stuck = False
        self.asked = 0
        self.server: WatchServer = WatchServer(self.state)

    def state(self) -> bytes:
        self.asked += 1
        seconds = 1.0 if self.is_stuck else float(self.asked)
        return msgspec.json.encode(msgspec.structs.replace(self.doc, seconds=seconds))


@pytest.fixture
def watch() -> Iterator[Watch]:
    watch = Watch()
    yield watch
    watch.server.stop()


@pytest.fixture
def page(browser: Browser) -> Iterator[Browser]:
    """A browser as small as a phone, and touched."""
    see(browser, PHONE, "light")
    browser.logs()
    yield browser
    browser.driver.get("about:blank")
    command = browser.driver.execute_cdp_cmd
    command("Emulation.setEmulatedMedia", {"features": []})
    command("Emulation.setTouchEmulationEnabled", {"enabled": False})
    command("Emulation.clearDeviceMetricsOverride", {})
    browser.logs()


def see(browser: Browser, size: tuple[int, int], scheme: str) -> None:
    """Take a screen of some size, light or dark."""
    screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 2, "mobile": True}
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)


def said(browser: Browser) -> tuple[str, str, str]:
    """Tone, word and next thing of the large field."""
    found = browser.run(
        "const text = (id) => document.getElementById(id).textContent;"
        "return [document.getElementById('field').dataset.tone, text('word'), text('next')]"
    )
    return (found[0], found[1], found[2])


def wait_for(browser: Browser, next_: str, seconds: float = 10.0) -> tuple[str, str, str]:
    """Wait until the large field says something."""
    WebDriverWait(browser.driver, seconds, poll_frequency=0.1).until(
        lambda _: said(browser)[2] == next_
    )
    return said(browser)


def open_page(browser: Browser, watch: Watch, doc: WatchDoc) -> None:
    watch.doc = doc
    browser.driver.get(watch.server.url)
    wait_for(browser, doc.next)


def fade(browser: Browser) -> None:
    """Wait until the field has faded to its colour."""
    browser.driver.execute_async_script("setTimeout(arguments[0], 400)")


def text(browser: Browser) -> str:
    return str(browser.find("body").text).replace("\u00a0", " ")


def test_the_page_is_one_file_that_runs_its_own_code_alone() -> None:
    html, policy = watch_page()
    tags = [(tag, a) for tag, a in Page(html).tags]
    assert [tag for tag, a in tags if a.get("src") or tag in ("iframe", "img", "base")] == []
    links = [link for _, a in tags if (link := a.get("href"))]
    assert all(link.startswith(("#", "data:")) for link in links)
    assert not any("style" in a or any(name.startswith("on") for name in a) for _, a in tags)
    assert "unsafe" not in policy
    assert len(re.findall(r"'sha256-[\w+/]{43}='", policy)) == 2
    assert "innerHTML" not in html
    assert not re.search(r"\$(style|script)", html), "no place of the template is left"
    assert len(html) < 40_000


# --- in a browser --------------------------------------------------------------------------------


@needs_browser
@pytest.mark.full
def test_it_shows_the_next_thing_and_follows(page: Browser, watch: Watch) -> None:
    open_page(page, watch, PLACING)
    assert said(page) == ("todo", "To do", "Hold pole B still")
    assert not page.find("#progress").is_displayed()
    shown = text(page)
    for words in (
        "front\n/front/points\n10.0 sweeps a second · 0.1 s old · 52 341 points",
        "12 % of its sweeps are lost",
        "Pole A good\n7.42 m · 1 320 returns · 12 rings · still",
        "Pole B moving\n7.42 m · 1 320 returns · 12 rings · moving",
        "Pole A good\n7.42 m · 1 320 returns · still",
        "Angle between the poles\n34°",
        "newest first\nPole B is seen.\nPole A is seen.\nThe front LiDAR is heard.",
    ):
        assert words in shown
    assert "Needed" not in shown
    # The same words are not said again: nothing in the spoken field is touched.
    page.run(
        "window.touched = 0; new MutationObserver((all) => { touched += all.length; })"
        ".observe(document.getElementById('said'), {subtree: true, childList: true, "
        "characterData: true})"
    )
    before = watch.asked
    WebDriverWait(page.driver, 10).until(lambda _: watch.asked > before + 3)
    assert page.run("return touched") == 0
    watch.doc = CAPTURING
    assert wait_for(page, CAPTURING.next) == ("good", "Good, keep still", "Keep the poles still")
    assert page.run("return touched") > 0
    shown = text(page)
    assert "8 of 30 sweeps" in shown
    assert "within 2 cm at 30 m, now 3.1 cm, 40 % sure" in shown
    assert "4.3 mm at 10 m, 12 mm at 30 m" in shown
    assert "Placements kept\n1" in shown
    assert page.run("const b = document.getElementById('bar'); return [b.value, b.max]") == [8, 30]
    watch.doc = DONE
    assert wait_for(page, DONE.next)[:2] == ("good", "Done")
    assert not page.find("#progress").is_displayed()
    assert page.find("#said").get_attribute("aria-live") == "polite"
    errors, asked = page.logs()
    assert errors == []
    assert {url.removeprefix(watch.server.url) for url in asked} == {"", "state"}


@needs_browser
@pytest.mark.full
@pytest.mark.parametrize(
    ("status", "tone", "word"),
    [
        ("ok", "good", "Done"),
        ("warn", "doubt", "Done, with a warning"),
        ("refused", "todo", "No answer"),
        (None, "todo", "No answer"),
        ("constructor", "todo", "No answer"),
    ],
)
def test_the_end_has_the_colour_of_its_verdict(
    page: Browser, watch: Watch, status: str | None, tone: str, word: str
) -> None:
    open_page(page, watch, msgspec.structs.replace(DONE, status=status))
    assert said(page)[:2] == (tone, word)


@needs_browser
@pytest.mark.full
def test_before_anything_comes(page: Browser, watch: Watch) -> None:
    silent = LidarNow(
        name="front",
        source="udp",
        sweeps_per_s=0.0,
        age_s=None,
        points=0,
        poles=[],
        word="no packets",
    )
    waiting = WatchDoc(
        phase="waiting",
        is_good=False,
        code="silent",
        next="Start the LiDARs",
        seconds=0.0,
        lidars=[silent],
    )
    open_page(page, watch, waiting)
    shown = text(page)
    assert "0.0 sweeps a second · no sweep yet · 0 points\nno packets\nNo pole is seen." in shown
    assert "So far" not in shown
    assert "What happened" not in shown
    open_page(page, watch, msgspec.structs.replace(waiting, lidars=[]))
    assert page.logs()[0] == []


@needs_browser
@pytest.mark.full
def test_a_lost_connection_is_reported_and_found_again(page: Browser, watch: Watch) -> None:
    open_page(page, watch, CAPTURING)
    port, token = int(re.findall(r":(\d+)/", watch.server.url)[0]), watch.server.path.strip("/")
    watch.server.stop()
    lost = wait_for(page, "Connection lost, trying again", 8)
    assert lost[:2] == ("lost", "No connection")
    assert not page.find("#progress").is_displayed()
    assert "Below is what was seen last." in text(page)
    for scheme in ("dark", "light"):
        see(page, PHONE, scheme)
        fade(page)
        assert page.run(LUMINANCE)[0][0] >= 7.0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("secrets.token_urlsafe", lambda _: token)
        watch.server = WatchServer(watch.state, port=port)
    assert wait_for(page, CAPTURING.next)[0] == "good"
    assert "seen last" not in text(page)
    watch.is_stuck = True
    assert wait_for(page, "Connection lost, trying again", 10)[0] == "lost"
    watch.is_stuck = False
    assert wait_for(page, CAPTURING.next)[0] == "good"


@needs_browser
@pytest.mark.full
def test_what_was_stated_at_the_end_stands(page: Browser, watch: Watch) -> None:
    open_page(page, watch, DONE)
    watch.server.stop()
    WebDriverWait(page.driver, 10).until(lambda _: "The program has ended" in text(page))
    assert said(page) == ("good", "Done", DONE.next)


@needs_browser
@pytest.mark.full
def test_sounds_tell_what_changes(page: Browser, watch: Watch) -> None:
    command = page.driver.execute_cdp_cmd
    added = command("Page.addScriptToEvaluateOnNewDocument", {"source": HEARD})
    try:
        open_page(page, watch, PLACING)
        watch.doc = CAPTURING
        wait_for(page, CAPTURING.next)
        assert page.run("return heard") == [], "nobody asked for sound"
        button = page.find("#sound")
        assert (button.text, button.get_attribute("aria-pressed")) == ("Turn sound on", "false")
        button.click()
        assert (button.text, button.get_attribute("aria-pressed")) == ("Turn sound off", "true")
        heard = [page.run("return heard.splice(0)")]
        kept = msgspec.structs.replace(CAPTURING, placements=2, next="Move the poles")
        placing = msgspec.structs.replace(PLACING, placements=1)
        for doc in (placing, CAPTURING, kept, DONE):
            watch.doc = doc
            wait_for(page, doc.next)
            heard.append([round(tone) for tone in page.run("return heard.splice(0)")])
        assert heard == [[880], [247], [880], [880, 880], [660, 880, 1320]]
        assert page.run("return shaken.length") == 5
        button.click()
        watch.doc = PLACING
        wait_for(page, PLACING.next)
        assert page.run("return heard") == []
    finally:
        command("Page.removeScriptToEvaluateOnNewDocument", added)
    assert page.logs()[0] == []


@pytest.mark.full
@needs_browser
def test_hostile_text_stays_text(page: Browser, watch: Watch) -> None:
    doc = everywhere(msgspec.structs.replace(CAPTURING, status="ok"), lambda: HOSTILE)
    assert doc.words[0] == HOSTILE
    open_page(page, watch, doc)
    assert page.run("return window.injected") is None
    assert page.run("return document.scripts.length") == 1
    places = page.run(
        "return [...document.querySelectorAll('#next, #lidars h2, #lidars .soft, #lidars .fault, "
        "#words li, .poles b')].map((e) => e.textContent)"
    )
    assert len(places) > 10
    assert all(place.removeprefix("Pole ") == HOSTILE for place in places)
    assert page.logs()[0] == []


LONG = "Turn pole A by the width of a hand towards the rear LiDAR, so that it leans more than B"


@needs_browser
@pytest.mark.full
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_nothing_is_cut_off(page: Browser, watch: Watch, size: tuple[int, int]) -> None:
    see(page, size, "light")
    unbroken = "w" * 300
    wide = everywhere(CAPTURING, lambda: unbroken)
    long = msgspec.structs.replace(CAPTURING, next=LONG)
    for doc in (PLACING, CAPTURING, DONE, long, wide):
        open_page(page, watch, doc)
        assert page.run(
            "const r = document.documentElement, f = document.getElementById('field');"
            "return [r.scrollWidth - r.clientWidth, f.scrollWidth - f.clientWidth]"
        ) == [0, 0], doc.next
        if doc is not wide:
            bottom, high = page.run(
                "return [document.getElementById('next').getBoundingClientRect().bottom, "
                "innerHeight]"
            )
            assert bottom <= high, doc.next


AUDIT = """
    const done = arguments[0];
    axe.run(document, { resultTypes: ["violations"] }).then((found) => done(found.violations));
"""

DOUBTFUL = msgspec.structs.replace(DONE, status="warn")


@needs_browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    "doc", [PLACING, CAPTURING, DONE, DOUBTFUL], ids=["to do", "good", "done", "doubtful"]
)
@pytest.mark.full
def test_it_is_read_in_the_sun_and_by_all(
    page: Browser, watch: Watch, doc: WatchDoc, scheme: str
) -> None:
    see(page, PHONE, scheme)
    open_page(page, watch, doc)
    fade(page)
    least = page.run(LUMINANCE)[0]
    assert least[0] >= 7.0, least
    small = page.run(
        "return [...document.querySelectorAll('button')].map((e) => e.getBoundingClientRect())"
        ".filter((b) => b.width < 44 || b.height < 44).length"
    )
    assert small == 0
    if not AXE.is_file():
        return
    page.run(AXE.read_text(encoding="utf-8"))
    found: list[dict[str, Any]] = page.driver.execute_async_script(AUDIT)
    assert [f["id"] for f in found if f["impact"] in ("serious", "critical")] == []
