"""What the tests of pages share: a browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.report.browser import Browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser of the module's own; only tests that are skipped without one ask for it."""
    from tests.report.browser import WEBGL, Browser

    browser = Browser(tmp_path_factory.mktemp("profile"), *WEBGL)
    yield browser
    browser.driver.quit()


@pytest.fixture
def phone(browser: Browser) -> Iterator[Browser]:
    """The browser as a phone: 390 pixels wide, two of the screen to each, and touched."""
    size = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    yield browser
    browser.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
    browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
