"""axe-core finds nothing serious on the report: every verdict, desktop and phone, light and dark.

axe-core (MPL-2.0) is a tool of this test alone. To run it: ``npm install axe-core`` in any folder,
and the environment variable ``AXE_CORE`` names the file ``node_modules/axe-core/axe.min.js`` of it.
"""

from __future__ import annotations

import os
from itertools import product
from pathlib import Path
from typing import Any, cast

import pytest

from retropole.base.bounded import Status
from retropole.report import render_report
from tests.report.browser import Browser, needs_browser
from tests.report.pages import STATUSES, page_of
from tests.report.test_recorded import lacking

AXE = Path(os.environ.get("AXE_CORE", ""))

pytestmark = [
    pytest.mark.full,
    needs_browser,
    pytest.mark.skipif(
        not AXE.is_file(),
        reason="axe-core is not installed: npm install axe-core, and AXE_CORE=…/axe.min.js",
    ),
]

DESKTOP, PHONE = (1300, 1000), (390, 844)

AUDIT = """
    const done = arguments[0];
    axe.run(document, { resultTypes: ["violations", "incomplete"] }).then((found) => done(found));
"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize(
    ("kind", "status"),
    [*product(("pair", "site"), STATUSES), ("pair", "missing"), ("recordings", "ok")],
)
def test_nothing_serious_is_found(
    browser: Browser, tmp_path: Path, kind: str, status: str, size: tuple[int, int], scheme: str
) -> None:
    screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": size == PHONE})
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        if status == "missing":
            result, placement = lacking(4)
            html = render_report(result, [placement])
        else:
            html = page_of(kind, cast("Status", status), notes=("A note on an input.",))
        browser.open(tmp_path, html)
        browser.run("for (const d of document.querySelectorAll('details')) d.open = true")
        # The page's policy lets no other script in; the driver's own commands are no part of it.
        browser.run(AXE.read_text(encoding="utf-8"))
        found = browser.driver.execute_async_script(AUDIT)
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        browser.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert serious(found["violations"]) == []
    assert kind != "recordings" or found["violations"] == []


def serious(violations: list[dict[str, Any]]) -> list[str]:
    """Name what axe-core calls serious or critical, with the elements it is found on."""
    return [
        f"{each['id']}: {[node['html'][:200] for node in each['nodes'][:3]]}"
        for each in violations
        if each["impact"] in ("serious", "critical")
    ]
