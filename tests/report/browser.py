"""A real browser for tests: one Chromium, quiet, with what it logs and asks for."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
WebDriverWait = pytest.importorskip("selenium.webdriver.support.ui").WebDriverWait
Image = pytest.importorskip("PIL.Image", reason="pillow is not installed")
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="chromium and chromedriver are not installed"
)

QUIET = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--window-size=1300,1000",
]
WEBGL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


Picture = NDArray[np.int16]


class Browser:
    """One Chromium with a profile of its own."""

    def __init__(self, profile: Path, *flags: str) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for flag in (*QUIET, *flags, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        self.driver.get("about:blank")
        self.logs()

    def open(self, folder: Path, html: str) -> None:
        path = folder / "report.html"
        path.write_text(html, encoding="utf-8")
        self.driver.get(path.as_uri())
        WebDriverWait(self.driver, 30).until(lambda _: self.root("usable"))

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def root(self, name: str) -> str | None:
        value = self.run("return document.documentElement.dataset[arguments[0]]", name)
        return None if value is None else str(value)

    def find(self, selector: str) -> Any:
        return self.driver.find_element("css selector", selector)

    def press(self, keys: str, selector: str = "body") -> None:
        self.find(selector).send_keys(keys)

    def picture(self) -> Picture:
        """Wait until the source has stopped moving, and see what the view shows."""
        self.run("document.querySelector('.stage').scrollIntoView()")
        self.driver.execute_async_script(
            "const done = arguments[0]; setTimeout(() => requestAnimationFrame(done), 550)"
        )
        image = Image.open(io.BytesIO(self.find(".stage").screenshot_as_png)).convert("RGB")
        return np.asarray(image, dtype=np.int16)

    def logs(self) -> tuple[list[str], list[str]]:
        """Errors on the console, and addresses asked for, since the last call."""
        errors = [e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"]
        events = [json.loads(e["message"])["message"] for e in self.driver.get_log("performance")]
        asked = [e["params"]["request"]["url"] for e in events if e["method"].endswith("BeSent")]
        return errors, [url for url in asked if not url.startswith(("file:", "data:"))]
