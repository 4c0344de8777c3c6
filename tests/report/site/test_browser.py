"""The page of a site in a browser: keys, refusals, phone, paper; nothing serious for axe-core."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from retropole.base.bounded import Status
from retropole.report.site import render_site
from tests.report.browser import Browser, needs_browser
from tests.report.site.made_up import document_of, made_up_site
from tests.report.test_accessibility import AUDIT, AXE, serious
from tests.report.test_phone import LEAST_TARGET

pytestmark = needs_browser


def page(status: Status = "ok", lidars: int = 4, count: int = 3000) -> str:
    site = made_up_site(status, lidars=lidars, placements=2, count=count)
    return render_site(document_of(site), site)


def test_keys_switch_lidars_and_placements(browser: Browser, tmp_path: Path) -> None:
    browser.logs()
    browser.open(tmp_path, page())
    assert browser.root("view") == "webgl"
    assert (browser.root("lidars"), browser.root("places")) == ("1111", "10")
    all_on = browser.picture()
    for key in "134":
        browser.press(key)
    assert browser.root("lidars") == "0100"
    assert "mast-b; placement 1: morning" in browser.find("#state").text
    alone = browser.picture()
    assert np.abs(all_on - alone).max() > 50
    # Its colour is seen, and that of the others is not.
    assert (np.abs(alone - [0xD5, 0x5E, 0x00]).max(axis=-1) < 12).any()
    browser.press("a")
    browser.press("2", "#marks")
    assert browser.root("lidars") == "1011"
    browser.run(
        "document.body.dispatchEvent(new KeyboardEvent('keydown',"
        " {key: '\"', code: 'Digit2', shiftKey: true, bubbles: true}))"
    )
    assert browser.root("places") == "11"
    browser.press("p")
    assert browser.find('[data-layer="poles"]').get_attribute("aria-pressed") == "false"
    errors, asked = browser.logs()
    assert errors == asked == []


def test_a_refused_site_shows_one_lidar_at_a_time(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, page("refused"))
    assert browser.root("lidars") == "1000"
    browser.find('[data-lidar="2"]').click()
    browser.find('[data-place="1"]').click()
    assert (browser.root("lidars"), browser.root("places")) == ("0010", "01")
    state = browser.find("#state").text
    assert "no poses: gate alone, in its own frame" in state
    assert "It recorded nothing there" in state
    browser.press("1")
    assert "nothing" not in browser.find("#state").text
    assert browser.logs()[0] == []


def test_a_page_without_clouds_works(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_site(document_of(made_up_site(lidars=2, count=20))))
    browser.find("#theme").click()
    assert browser.root("theme") == "dark"
    assert browser.logs()[0] == []


def test_a_phone_scrolls_down_only_and_has_large_targets(phone: Browser, tmp_path: Path) -> None:
    phone.open(tmp_path, page(lidars=8, count=300))
    phone.run("for (const d of document.querySelectorAll('details')) d.open = true")
    assert phone.run("return document.documentElement.scrollWidth") == 390
    small = phone.run(
        "return [...document.querySelectorAll('button, summary, .links a, select')].filter((e) => {"
        " const b = e.getBoundingClientRect();"
        " return b.width && (b.width < arguments[0] || b.height < arguments[0]) })"
        ".map((e) => e.outerHTML.slice(0, 100))",
        LEAST_TARGET,
    )
    assert small == []


def test_paper_shows_every_pose_in_light_colours(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, page(count=300))
    browser.find("#theme").click()
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.root("theme") == "light"
    assert browser.run("return document.querySelectorAll('details.lidar[open]').length") == 4
    assert browser.run("return document.querySelector('#printed').hidden") is False
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.root("theme") == "dark"
    assert browser.run("return document.querySelectorAll('details.lidar[open]').length") == 0


@pytest.mark.skipif(
    not AXE.is_file(),
    reason="axe-core is not installed: npm install axe-core, and AXE_CORE=…/axe.min.js",
)
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("status", ["warn", "refused"])
def test_nothing_serious_is_found(
    phone: Browser, tmp_path: Path, status: Status, scheme: str
) -> None:
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    phone.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        phone.open(tmp_path, page(status, count=100))
        phone.run("for (const d of document.querySelectorAll('details')) d.open = true")
        phone.run(AXE.read_text(encoding="utf-8"))
        found = [phone.driver.execute_async_script(AUDIT)]
        # And on a desktop.
        phone.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": 1300, "height": 1000, "deviceScaleFactor": 1, "mobile": False},
        )
        found.append(phone.driver.execute_async_script(AUDIT))
    finally:
        phone.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert [serious(each["violations"]) for each in found] == [[], []]
