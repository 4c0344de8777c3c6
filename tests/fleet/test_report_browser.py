"""The page of a fleet in a browser: phone, keys, paper; nothing serious for axe-core."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from retropole.fleet.overview import Overview, overview_of
from retropole.fleet.report import WORST, render_fleet
from tests.fleet.made_up import write_city
from tests.fleet.test_report import write_history
from tests.report.browser import Browser, needs_browser
from tests.report.test_accessibility import AUDIT, AXE, serious
from tests.report.test_phone import LEAST_TARGET

pytestmark = [needs_browser, pytest.mark.full]


@pytest.fixture(scope="module")
def overview(tmp_path_factory: pytest.TempPathFactory) -> Overview:
    city = write_city(tmp_path_factory.mktemp("city"), 120)
    answered = [site.id for site in overview_of(str(city)).sites if site.status == "ok"]
    write_history(city / "history", dict.fromkeys(answered[:3], "{}"))
    return overview_of(str(city))


def test_a_phone_scrolls_down_only_and_has_large_targets(
    phone: Browser, overview: Overview, tmp_path: Path
) -> None:
    phone.logs()
    phone.open(tmp_path, render_fleet(overview, lambda site: f"{site.id}/report.html"))
    phone.run("for (const d of document.querySelectorAll('details')) d.open = true")
    assert phone.run("return document.documentElement.scrollWidth") == 390
    small = phone.run(
        "return [...document.querySelectorAll('button, summary, .links a, th a')].filter((e) => {"
        " const b = e.getBoundingClientRect();"
        " return b.width && (b.width < arguments[0] || b.height < arguments[0]) })"
        ".map((e) => e.outerHTML.slice(0, 100))",
        LEAST_TARGET,
    )
    assert small == []
    assert phone.logs() == ([], [])


def test_it_is_used_by_keys_and_printed_light(
    browser: Browser, overview: Overview, tmp_path: Path
) -> None:
    refused = {"status": "refused", "codes": ("ambiguous",), "messages": ("why",)}
    many = [
        msgspec.structs.replace(overview.sites[0], id=f"post-{k}", **refused)
        for k in range(WORST + 10)
    ]
    # More than are listed unfolded.
    browser.open(tmp_path, render_fleet(replace(overview, sites=tuple(many))))
    browser.press("\ue007", "#theme")
    assert browser.root("theme") == "dark"
    reached = browser.run(
        "return [...document.querySelectorAll('.scroll')].every((e) => e.tabIndex === 0)"
    )
    assert reached
    browser.run("document.querySelector('details').open = false")
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.root("theme") == "light"
    assert browser.run("return document.querySelector('details').open")
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.root("theme") == "dark"
    assert not browser.run("return document.querySelector('details').open")
    assert browser.logs()[0] == []


@pytest.mark.skipif(
    not AXE.is_file(),
    reason="axe-core is not installed: npm install axe-core, and AXE_CORE=…/axe.min.js",
)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_serious_is_found(
    phone: Browser, overview: Overview, tmp_path: Path, scheme: str
) -> None:
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    phone.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        phone.open(tmp_path, render_fleet(overview))
        phone.run("for (const d of document.querySelectorAll('details')) d.open = true")
        phone.run(AXE.read_text(encoding="utf-8"))
        found = phone.driver.execute_async_script(AUDIT)
    finally:
        phone.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert serious(found["violations"]) == []
