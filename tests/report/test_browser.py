"""The report in a browser: it draws, answers to mouse and keys, and talks to nobody."""

from __future__ import annotations

import re
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.report import render_recordings, render_report
from retropole.result import ReasonDoc
from retropole.simulation import simulate_pair
from tests.report.browser import Browser, Picture, needs_browser
from tests.report.made_up import HOSTILE, made_up
from tests.report.pages import cloud_of, of_each_kind, page_of
from tests.report.site.made_up import document_of, made_up_site
from tests.tiers import first_of

pytestmark = needs_browser


@pytest.fixture(autouse=True)
def silence(request: pytest.FixtureRequest) -> Iterator[None]:
    """No test may leave an error on the console, or have asked any address for anything."""
    yield
    if "browser" in request.fixturenames:
        assert request.getfixturevalue("browser").logs() == ([], [])


def differing(a: Picture, b: Picture) -> float:
    """Share of pixels that differ clearly."""
    return float(np.mean(np.abs(a - b).max(axis=2) > 40))


@pytest.mark.full
def test_draws_and_moves_the_source(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(*made_up(count=6000)))
    assert browser.root("view") == "webgl"
    after = browser.picture()
    blue, orange = after[..., 2] - after[..., 0] > 60, after[..., 0] - after[..., 2] > 60
    assert blue.mean() > 0.002
    assert orange.mean() > 0.002
    browser.find('[data-mode="before"]').click()
    before = browser.picture()
    assert browser.root("mode") == "before"
    assert differing(before, after) > 0.005
    browser.press("b")
    assert browser.root("mode") == "after"
    assert differing(browser.picture(), after) < 0.001


@pytest.mark.full
def test_shows_each_hypothesis(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(*made_up(count=6000)))
    result = browser.picture()
    # The scene decides: they are folded away, and drawn once they are seen.
    browser.find('[aria-labelledby="hypotheses"] summary').click()
    time.sleep(0.5)  # longer than the page waits before it draws them
    panels = browser.driver.find_elements("css selector", ".panel")
    assert len(panels) == 4
    drawn = "const c = arguments[0].querySelector('canvas'); return new Set(new Uint32Array("
    drawn += "c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer)).size"
    assert all(browser.run(drawn, panel) > 20 for panel in panels)
    browser.run("arguments[0].click()", panels[2])
    assert browser.root("pose") == "c"
    assert panels[2].get_attribute("aria-pressed") == "true"
    assert "hypothesis c" in browser.find("#state").text
    assert differing(browser.picture(), result) > 0.005
    browser.press("2")
    assert browser.root("pose") == "b"
    browser.press("0")
    assert differing(browser.picture(), result) < 0.001


@pytest.mark.full
def test_layers_camera_and_theme(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(*made_up(count=6000)))
    seen = browser.picture()
    layers = ("poles", "names", "rejected", "ellipsoid", "intensity")
    for part in ('lidar="0"', 'lidar="1"', *(f'layer="{layer}"' for layer in layers)):
        button = browser.find(f"[data-{part}]")
        button.click()
        assert button.get_attribute("aria-pressed") == "false"
        assert differing(browser.picture(), seen) > 1e-5, part
        button.click()
    assert differing(browser.picture(), seen) < 0.001
    browser.press("\ue012\ue012\ue012+", "#marks")
    rotated = browser.picture()
    assert differing(rotated, seen) > 0.005
    browser.press("\ue011", "#marks")
    browser.run("document.activeElement.blur()")
    assert differing(browser.picture(), seen) < 0.001
    light = browser.run("return getComputedStyle(document.body).backgroundColor")
    browser.find("#theme").click()
    assert browser.run("return getComputedStyle(document.body).backgroundColor") != light
    assert browser.picture().mean() < seen.mean() - 100


@pytest.mark.full
def test_marks_what_contradicts_the_pose_in_red(browser: Browser, tmp_path: Path) -> None:
    def red(picture: Picture) -> float:
        return float(np.mean(np.all(np.abs(picture - [200, 0, 60]) < 20, axis=2)))

    pair = simulate_pair("harbor", np.random.default_rng(1))
    placement = Placement(Scan(pair.target), Scan(pair.source))
    off = se3.retract(pair.T_target_source, np.r_[0.0, 0.0, 0.0, 2.0, 1.0, 0.0])
    made = made_up(count=500).result
    hypotheses = [msgspec.structs.replace(made.hypotheses[0], T_target_source=off)]
    result = msgspec.structs.replace(
        made, T_target_source=pair.T_target_source, hypotheses=hypotheses
    )
    browser.open(tmp_path, render_report(result, [placement]))
    right = browser.picture()
    browser.press("1")
    wrong = browser.picture()
    assert red(wrong) > 0.002
    assert red(right) < red(wrong) / 10
    assert "Red: in space that the other LiDAR saw to be empty." in browser.find("#state").text
    browser.press("c")
    button = browser.find('[data-layer="contradicting"]')
    assert button.get_attribute("aria-pressed") == "false"
    assert red(browser.picture()) < red(wrong) / 10
    assert "Red" not in browser.find("#state").text


@pytest.mark.full
def test_lines_have_the_frames_of_the_recordings(browser: Browser, tmp_path: Path) -> None:
    run = made_up(count=500)
    inputs = [
        msgspec.structs.replace(each, frame_id=name)
        for each, name in zip(run.result.inputs, ("front/lidar", "rear"), strict=True)
    ]
    page = render_report(msgspec.structs.replace(run.result, inputs=inputs), run.placements)
    browser.open(tmp_path, page)
    line = browser.find('[data-export="ros2"]').text
    assert line.endswith("--frame-id front/lidar --child-frame-id rear")


@pytest.mark.full
def test_copies_lines_with_the_frames_named(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(*made_up(count=500)))
    field = browser.find('[name="target"]')
    field.clear()
    field.send_keys("top; rm lidar_source")
    line = browser.find('[data-export="ros2"]').text
    assert line.endswith("--frame-id top__rm_lidar_source --child-frame-id lidar_source")
    # A robot's base is no LiDAR.
    for name, shown in (("base_link", "lidar_target"), ("a/map", "lidar_target"), ("top", "top")):
        field.clear()
        field.send_keys(name)
        line = browser.find('[data-export="ros2"]').text
        assert line.endswith(f"--frame-id {shown} --child-frame-id lidar_source")
    button = browser.find('.copy:has([data-export="ros2"]) .copy-button')
    browser.run("arguments[0].click()", button)
    browser.run("document.body.append(document.createElement('textarea'))")
    browser.press("\ue009v", "textarea")
    assert browser.run("return document.querySelector('textarea').value") == line
    assert "Copied" in button.text


def test_file_name_stays_text(browser: Browser, tmp_path: Path) -> None:
    result, placements = made_up(count=500)
    path = f"/data/{HOSTILE.replace('/', '')}"
    hostile = msgspec.structs.replace(
        result,
        inputs=[msgspec.structs.replace(item, path=path) for item in result.inputs],
        reasons=[ReasonDoc(HOSTILE, HOSTILE, {})],
    )
    browser.open(tmp_path, render_report(hostile, placements))
    assert "<script>window.injected=1" in browser.find("h1").text
    assert browser.run("return window.injected") is None
    assert browser.run("return document.scripts.length") == 5


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.full
def test_refused_shows_the_clouds_apart(browser: Browser, tmp_path: Path, empty: bool) -> None:
    result, placements = made_up("refused", 6000)
    if empty:
        result = msgspec.structs.replace(result, hypotheses=[])
    browser.open(tmp_path, render_report(result, placements))
    picture = browser.picture()
    half = picture.shape[1] // 2
    orange = picture[..., 0] - picture[..., 2] > 60
    assert orange[:, half + 2 :].mean() > 0.002
    assert orange[:, : half - 2].mean() < 0.0001
    assert browser.root("mode") == "apart"
    assert browser.find('[data-mode="after"]').is_enabled() is not empty
    if not empty:
        browser.find('[data-mode="after"]').click()
        assert "refused" in browser.find("#state").text


@pytest.mark.parametrize("width", first_of([320, 390]))
@pytest.mark.parametrize("status", ["warn", "refused"])
@of_each_kind
@pytest.mark.full
def test_fits_a_phone(
    browser: Browser, tmp_path: Path, kind: str, width: int, status: Status
) -> None:
    size = {"width": width, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.open(tmp_path, page_of(kind, status, notes=("x" * 200,)))
        assert browser.run("return document.documentElement.scrollWidth") <= width
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.full
def test_is_reached_by_the_keyboard(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(*made_up("warn", 500)))
    reached = set()
    for _ in range(45):
        browser.driver.switch_to.active_element.send_keys("\ue004")
        reached.add(browser.run("const e = document.activeElement; return e.id || e.className"))
        outline = "return getComputedStyle(document.activeElement).outlineStyle"
        assert browser.run(outline) != "none"
    assert {"theme", "marks", "pose", "size", "panel", "copy-button", "scroll"} <= reached


@pytest.mark.full
def test_switches_placements(browser: Browser, tmp_path: Path) -> None:
    result, (placement,) = made_up(count=6000)
    cloud: PointCloud = placement.target.cloud
    lowered = Scan(replace(cloud, xyz=cloud.xyz + np.array([0.0, 0.0, -0.4])))
    second = Placement(lowered, Scan(placement.source.cloud))
    browser.open(tmp_path, render_report(result, [placement, second]))
    first = browser.picture()
    for shown in ("11", "01"):
        browser.press({"11": "\ue0082", "01": "\ue0081"}[shown])
        assert browser.root("places") == shown
        assert differing(browser.picture(), first) > 0.005
    for place in browser.driver.find_elements("css selector", "[data-place]"):
        place.click()
    assert browser.root("places") == "10"
    assert differing(browser.picture(), first) < 0.001


@pytest.mark.full
def test_a_reader_who_wants_no_motion_gets_none(browser: Browser, tmp_path: Path) -> None:
    media = {"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.open(tmp_path, render_report(*made_up(count=500)))
        scroll = "return getComputedStyle(document.documentElement).scrollBehavior"
        assert browser.run(scroll) == "auto"
        frames = """
            const done = arguments[0], real = window.requestAnimationFrame;
            let count = 0;
            window.requestAnimationFrame = (f) => { count += 1; return real(f); };
            document.querySelector('[data-mode="before"]').click();
            setTimeout(() => done(count), 300);
        """
        assert browser.driver.execute_async_script(frames) <= 2
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@pytest.mark.full
def test_without_webgl_shows_the_top_view(tmp_path: Path) -> None:
    browser = Browser(tmp_path / "profile", "--disable-3d-apis")
    try:
        browser.open(tmp_path, render_report(*made_up(count=6000)))
        assert browser.root("view") == "top"
        assert "no WebGL" in browser.find("#fallback").text
        after = browser.picture()
        assert (after[..., 2] - after[..., 0] > 60).mean() > 0.001
        browser.find('[data-mode="before"]').click()
        assert differing(browser.picture(), after) > 0.005
        assert browser.logs() == ([], [])
    finally:
        browser.driver.quit()


@pytest.mark.full
def test_keys_switch_lidars_and_placements(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, page_of("site", count=3000))
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


@pytest.mark.full
def test_a_refused_site_shows_one_lidar_at_a_time(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, page_of("site", "refused", 3000))
    assert browser.root("lidars") == "1000"
    browser.find('[data-lidar="2"]').click()
    browser.find('[data-place="1"]').click()
    assert (browser.root("lidars"), browser.root("places")) == ("0010", "01")
    state = browser.find("#state").text
    assert "no poses: gate alone, in its frame" in state
    assert "It recorded nothing there" in state
    browser.press("1")
    assert "nothing" not in browser.find("#state").text


@pytest.mark.full
def test_a_page_without_clouds_works(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_report(document_of(made_up_site(lidars=2, count=20))))
    browser.find("#theme").click()
    assert browser.root("theme") == "dark"


@pytest.mark.full
def test_paper_shows_every_pose_in_light_colours(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, page_of("site", count=300))
    browser.find("#theme").click()
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.root("theme") == "light"
    assert browser.run("return document.querySelectorAll('details.lidar[open]').length") == 4
    assert browser.run("return document.querySelector('#printed').hidden") is False
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.root("theme") == "dark"
    assert browser.run("return document.querySelectorAll('details.lidar[open]').length") == 0


def as_of(html: str, kind: str) -> str:
    """Make of a page one that is opened with WebGL, or for "top" in a browser that has none."""
    if kind == "webgl":
        return html
    # The page's policy lets only its own code in.
    html = html.replace('getContext("webgl2"', 'getContext("none"')
    return re.sub(r"script-src [^;]*;", "script-src 'unsafe-inline';", html)


def move_slider(browser: Browser, value: float) -> None:
    browser.run(
        "const s = document.querySelector('#threshold'); s.value = arguments[0];"
        "for (const what of ['input', 'change']) s.dispatchEvent(new Event(what));",
        value,
    )


@pytest.mark.parametrize("kind", first_of(["webgl", "top"]))
def test_a_threshold_is_moved(browser: Browser, tmp_path: Path, kind: str) -> None:
    html = render_recordings(["a.pcd", "b.pcd"], [Scan(cloud_of(6000)), Scan(cloud_of(500))])
    browser.open(tmp_path, as_of(html, kind))
    assert browser.root("view") == kind

    def told() -> str:
        return str(browser.find("#level").text)

    def orange() -> float:
        picture = browser.picture()
        return float(np.mean(picture[..., 0] - picture[..., 2] > 120))

    assert told().endswith(": 600 points")
    bright = orange()
    assert bright > 0.001
    move_slider(browser, 0.9)
    assert told() == "0.9: 600 points"
    move_slider(browser, 0.3)
    assert 600 < int(told().split()[1].replace(",", "")) < 6000
    assert "0.3 or brighter" in browser.find("#state").text
    assert orange() > 1.5 * bright
    assert browser.find("#threshold").get_attribute("aria-valuetext") == told()
    browser.find('[data-lidar="1"]').click()
    assert told().endswith(": 50 points")
    browser.find('[data-lidar="0"]').click()
    assert told().startswith("0.3: ")


@pytest.mark.full
@pytest.mark.parametrize("kind", ["webgl", "top"])
@pytest.mark.parametrize("is_bright", [True, False])
def test_a_picked_point_is_given_in_the_frame_of_its_lidar(
    browser: Browser, tmp_path: Path, kind: str, is_bright: bool
) -> None:
    """The view looks at the middle of a plate, which is clicked."""
    rng = np.random.default_rng(3)
    at = np.array([10.0, -2.0, 1.0])
    plate = at + rng.uniform(-0.05, 0.05, (400, 3)) * [0.1, 1, 1]
    around = at + rng.uniform(-3, 3, (4000, 3)) * [1, 1, 0] - [0, 0, 1]
    xyz = np.concatenate([plate, around])
    level = np.where(np.arange(len(xyz)) < len(plate), 200.0 if is_bright else 5.0, 5.0)
    cloud = PointCloud(xyz, intensity=level + rng.random(len(xyz)), origin=at)
    browser.open(tmp_path, as_of(render_recordings(["a.pcd"], [Scan(cloud)]), kind))
    move_slider(browser, 100.0)
    assert not browser.find("#picked").is_displayed()
    seen = browser.picture()
    browser.find("#marks").click()
    assert browser.find("#picked").is_displayed()
    said = tomllib.loads(browser.find("#picked pre").text)["control_point"]["seen"]
    assert said[0]["lidar"] == "a.pcd"
    off = np.array(said[0]["at_m"]) - at
    assert np.abs(off).max() < (0.01 if is_bright else 0.3)
    assert ("bright returns" in browser.find("#picked-at").text) == is_bright
    assert differing(browser.picture(), seen) > 1e-5


@pytest.mark.full
def test_a_recording_without_tape_has_no_threshold(browser: Browser, tmp_path: Path) -> None:
    browser.open(tmp_path, render_recordings(["a.pcd"], [Scan(PointCloud(cloud_of(90).xyz))]))
    assert not browser.find("#threshold").is_displayed()
    assert "do not show tape" in browser.find("#state").text
