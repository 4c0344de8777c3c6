"""The report on paper: A4, a certificate first, few pages, nothing cut; read back from a PDF."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape
from pathlib import Path

import msgspec
import numpy as np
import pytest

from retropole.base.bounded import Status
from retropole.report import render_report
from retropole.result import ReasonDoc, ResultDoc
from tests.report.browser import Browser, Image, needs_browser
from tests.report.made_up import made_up
from tests.tiers import first_of

pytestmark = [
    pytest.mark.full,
    needs_browser,
    pytest.mark.skipif(
        not shutil.which("pdftotext") or not shutil.which("pdftoppm"),
        reason="poppler-utils is not installed",
    ),
]

MOST_PAGES = 6
A4_POINTS = (595.0, 842.0)
TEXT_MM, PANEL_MM = 182.0, 42.0
MM_PER_INCH = 25.4
DOTS_PER_INCH = 100


def printed(browser: Browser, folder: Path, html: str) -> list[str]:
    """Print a page as a reader does, and give the text of each sheet, laid out as it stands."""
    browser.open(folder, html)
    pdf = browser.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    path = folder / "report.pdf"
    path.write_bytes(base64.b64decode(pdf["data"]))
    return sheets(path)


def sheets(path: Path, *options: str) -> list[str]:
    words = ["pdftotext", *(options or ["-layout"]), str(path), "-"]
    done = subprocess.run(words, capture_output=True, check=True)
    return done.stdout.decode().rstrip("\f").split("\f")


def made_long(status: Status) -> ResultDoc:
    """A run with what a usual one has at most: eight hypotheses, and twenty sources of error."""
    result = made_up(status, 500).result
    hypotheses = [*result.hypotheses, *result.hypotheses]
    for k in range(4, 8):
        hypotheses[k] = msgspec.structs.replace(hypotheses[k], chosen=False)
    budget = result.budget and [
        msgspec.structs.replace(result.budget[0], name=f"kind {k} of error", share_at_30m=0.05)
        for k in range(20)
    ]
    path = "/data/2025-05-05 morning/" + "a_long-name." * 9 + "pcd"
    inputs = [msgspec.structs.replace(item, path=path) for item in result.inputs]
    return msgspec.structs.replace(result, hypotheses=hypotheses, budget=budget, inputs=inputs)


def joined(text: str) -> str:
    """Leave out all space: a cell may be of several lines."""
    return "".join(text.split())


def tables_of(html: str) -> list[str]:
    """Give the text of every table outside of what is folded, without space."""
    shown = re.sub(r"<details>.*?</details>", "", html.split("<script", 1)[0], flags=re.DOTALL)
    tables = re.findall("<table.*?</table>", shown, re.DOTALL)
    return [joined(unescape(re.sub("<[^>]*>", " ", table))) for table in tables]


@pytest.mark.parametrize("status", first_of(["ok", "warn", "refused"]))
def test_it_prints_on_few_sheets_of_a4_and_no_table_is_cut(
    browser: Browser, tmp_path: Path, status: Status
) -> None:
    html = render_report(made_long(status), made_up(status, 500).placements)
    pages = printed(browser, tmp_path, html)
    assert len(pages) <= MOST_PAGES
    info = subprocess.run(["pdfinfo", tmp_path / "report.pdf"], capture_output=True, check=True)
    (size,) = re.findall(r"Page size: +([\d.]+) x ([\d.]+)", info.stdout.decode())
    assert [float(x) for x in size] == pytest.approx(A4_POINTS, abs=1.0)
    # In the order of the document, where what is cut has the foot of a sheet in its midst.
    raw = [joined(page) for page in sheets(tmp_path / "report.pdf", "-raw")]
    tables = tables_of(html)
    assert len(tables) >= 4
    for table in tables:
        assert any(table in page for page in raw), table


def test_the_certificate_is_the_first_sheet_and_one_alone(browser: Browser, tmp_path: Path) -> None:
    result = made_long("warn")
    pages = printed(browser, tmp_path, render_report(result, made_up("warn", 500).placements))
    assert pages[0].split()[:2] == ["Calibration", "certificate"]
    for said in ("Site", "serial number", "T_target_source", "Uncertainty budget", "Signature"):
        assert said in pages[0]
        assert said == "T_target_source" or said not in "".join(pages[1:])
    assert all(item.sha256 in pages[0] for item in result.inputs)
    # The button prints this sheet only.
    browser.run("window.print = () => { window.asked = true; }")
    browser.find("#print-certificate").click()
    assert browser.run("return window.asked")
    pdf = browser.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    (tmp_path / "alone.pdf").write_bytes(base64.b64decode(pdf["data"]))
    assert len(sheets(tmp_path / "alone.pdf")) == 1
    assert browser.root("print") is None


def test_a_refused_run_prints_no_certificate(browser: Browser, tmp_path: Path) -> None:
    pages = printed(browser, tmp_path, render_report(*made_up("refused", 500)))
    assert "certificate" not in "".join(pages)
    assert "Refused: no pose" in pages[0]


@pytest.mark.parametrize("shape", [(390, 844), (1300, 500)])
def test_the_picture_has_its_shape_and_is_on_white(
    browser: Browser, tmp_path: Path, shape: tuple[int, int]
) -> None:
    """Whatever the window, a circle on screen is a circle on paper, in light colours."""
    size = {"width": shape[0], "height": shape[1], "deviceScaleFactor": 1, "mobile": False}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.open(tmp_path, render_report(*made_up("warn", 6000)))
        browser.find("#theme").click()
        dark = browser.root("theme")
        browser.find('[data-preset="top"]').click()
        pdf = browser.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
        restored = browser.root("theme")
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert (dark, restored) == ("dark", "dark")
    path = tmp_path / "report.pdf"
    path.write_bytes(base64.b64decode(pdf["data"]))
    listed = subprocess.run(["pdfimages", "-list", path], capture_output=True, check=True)
    rows = [line.split() for line in listed.stdout.decode().splitlines()[2:]]
    # The view, as wide as the text, and four hypotheses: none is stretched, nor has a blank edge.
    widths = {int(row[3]): MM_PER_INCH * int(row[3]) / float(row[12]) for row in rows}
    assert sorted(widths.values()) == pytest.approx([PANEL_MM, TEXT_MM], rel=0.01)
    for row in rows:
        assert float(row[12]) == pytest.approx(float(row[13]), rel=0.01)
    words = ["pdftoppm", "-r", str(DOTS_PER_INCH), "-png", "-f", "2", "-l", "2", str(path)]
    subprocess.run([*words, str(tmp_path / "page")], check=True)
    (page,) = tmp_path.glob("page*.png")
    seen = np.asarray(Image.open(page).convert("RGB"), dtype=np.int16)
    assert np.median(seen) == 255
    blue, orange = seen[..., 2] - seen[..., 0] > 60, seen[..., 0] - seen[..., 2] > 60
    assert blue.mean() > 5e-4
    assert orange.mean() > 5e-4


@pytest.mark.parametrize("count", [2, 4])
def test_wherever_a_sheet_ends_no_warning_and_no_table_is_cut(
    browser: Browser, tmp_path: Path, count: int
) -> None:
    made, words = made_up("warn", 500), "words " * 60
    reasons = [ReasonDoc("few_points", f"start{k} {words}end{k}", {}) for k in range(count)]
    result = msgspec.structs.replace(made_long("warn"), reasons=reasons)
    html = render_report(result, made.placements)
    pages = printed(browser, tmp_path, html)
    for k in range(count):
        assert any(f"tart{k}" in page and f"end{k}" in page for page in pages)
    raw = [joined(page) for page in sheets(tmp_path / "report.pdf", "-raw")]
    for table in tables_of(html):
        assert any(table in page for page in raw), table


def test_a_table_longer_than_a_sheet_goes_on_below_its_heading(
    browser: Browser, tmp_path: Path
) -> None:
    result, (placement,) = made_up("refused", 500)
    detection = placement.source.detection
    assert detection is not None
    rejected = [
        replace(detection.rejected[0], reason=f"start{k} {'words ' * 30}end{k}") for k in range(90)
    ]
    found = replace(placement.source, detection=replace(detection, rejected=tuple(rejected)))
    html = render_report(result, [replace(placement, source=found)])
    printed(browser, tmp_path, html)
    raw = sheets(tmp_path / "report.pdf", "-raw")
    for k in range(90):
        assert any(f"start{k} " in page and f"end{k}\n" in page.replace(" ", "\n") for page in raw)
    listing = [page for page in raw if "start" in page]
    assert len(listing) > 2
    assert all("mark code reason points" in page for page in listing)
