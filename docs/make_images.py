"""Make the pictures of the documentation again, from simulated scans, and one from real ones.

python docs/make_images.py docs/images
python docs/make_images.py docs/images data
python docs/make_images.py docs/images --only setup placements

The picture of the report needs Chromium, chromedriver and selenium, and is left out without. So is
that of real scans without the folder of test recordings (CONTRIBUTING.md).
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np
from PIL import Image

import retropole as rp
from retropole.api import se3
from retropole.report.figures import new_figure

EXAMPLES = Path(__file__).parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))
from plot_placement import sigma_at_10_m  # noqa: E402

BLUE, ORANGE, RED, GREY = "#0072b2", "#e69f00", "#d55e00", "#9aa0a6"
PLACEMENTS = {
    "good": (20.0, 5.0, 2.0),
    "nearly parallel": (5.0, 5.0, 2.0),
    "too close together": (20.0, 5.0, 0.3),
    "too far": (20.0, 11.0, 2.0),
}


def run(*words: object) -> None:
    """Run a command line of retropole."""
    subprocess.run([sys.executable, "-m", "retropole", *map(str, words)], check=True)


def draw_placements(path: Path) -> None:
    """Four placements as the LiDARs see them and from above, each with what it costs."""
    figure = new_figure(10.0, 4.6)
    for k, (name, (angle, distance, spacing)) in enumerate(PLACEMENTS.items()):
        sigma = float(
            np.median([sigma_at_10_m(angle, distance, spacing, n, "XT32") for n in range(8)])
        )
        print(f"{name}: {100 * sigma:.1f} cm at 10 m")
        colour = BLUE if k == 0 else RED
        lean = np.radians(angle) / 2
        front = figure.add_subplot(2, 4, k + 1, xlim=(-2.5, 2.5), ylim=(0, 2.4), aspect="equal")
        front.set_title(f"{name}\n{100 * sigma:.1f} cm", color=colour, fontsize=11)
        above = figure.add_subplot(2, 4, k + 5, xlim=(-2.5, 2.5), ylim=(-1, 12), aspect=0.42)
        for side in (-1, 1):
            ends = side * (spacing / 2 + np.array([-1, 1]) * np.sin(lean))
            heights = 1 + np.array([-1, 1]) * np.cos(lean)
            front.plot(ends, heights, color=colour, lw=3, solid_capstyle="round")
            above.plot(ends, [distance] * 2, color=colour, lw=3, solid_capstyle="round")
            above.plot([0.5 * side], [0], "o", color=ORANGE)
        if k == 0:
            front.set_ylabel("as seen, m")
            above.set_ylabel("from above, m")
            above.annotate("LiDARs", (0, 0.7), ha="center", fontsize=9)
        for axes in (front, above):
            axes.tick_params(labelsize=8)
            axes.grid(alpha=0.25)
    figure.savefig(path)


def draw_bias(path: Path) -> None:
    """A pole from above: returns on the facing sides, and the lines fitted to them."""
    figure = new_figure(5.0, 4.0)
    axes = figure.add_subplot(1, 1, 1, aspect="equal", xlim=(-45, 45), ylim=(-32, 32))
    circle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(20 * np.cos(circle), 20 * np.sin(circle), color=GREY)
    axes.plot(0, 0, "+", color="black", ms=10)
    for angle, colour, name in ((np.pi, BLUE, "target"), (np.radians(-40), ORANGE, "source")):
        across = np.linspace(-19, 19, 9)
        facing = np.stack([np.sqrt(20**2 - across**2), across])
        c, s = np.cos(angle), np.sin(angle)
        x, y = np.array([[c, -s], [s, c]]) @ facing
        u, v = 20 * np.pi / 4 * c, 20 * np.pi / 4 * s
        axes.plot(x, y, "o", color=colour, ms=4)
        axes.plot(u, v, "x", color=colour, ms=10, mew=2.5)
        words, place = f"line seen by\nthe {name}", (2.1 * u, 2.1 * v)
        axes.annotate(words, place, color=colour, ha="center", va="center")
        arrow = {"arrowstyle": "->", "color": colour}
        axes.annotate("", (0.97 * u, 0.97 * v), (0, 0), arrowprops=arrow)
    axes.set(xlabel="mm", ylabel="mm")
    figure.savefig(path)


def draw_car_park(data: Path, path: Path) -> None:
    """The same of a real car park, with poles that `benchmarks/insert.py` puts into it."""
    recorded = data / "pandar_scene1"
    reference = json.loads((recorded / "reference.json").read_text())["T_p64_qt_201"]
    with tempfile.TemporaryDirectory() as name:
        transform = Path(name) / "transform.txt"
        np.savetxt(transform, reference)
        insert = Path(__file__).parents[1] / "benchmarks" / "insert.py"
        scans = recorded / "p64.pcd", recorded / "qt_201.pcd"
        words = [*scans, "--transform", transform, "--out", name]
        subprocess.run([sys.executable, str(insert), *map(str, words)], check=True)
        draw_pair(Path(name), path)


def draw_pair(folder: Path, path: Path) -> None:
    """Calibrate the two clouds of a folder, and draw them before and after, and the poles."""
    figure = rp.calibrate(folder / "lidar0.pcd", folder / "lidar1.pcd").plot()
    whole = folder / "whole.png"
    figure.savefig(whole, dpi=70)
    # Points of two colours on white: few colours show all, in a third of the bytes.
    Image.open(whole).convert("RGB").quantize(32).save(path, optimize=True)


def photograph(page: Path, path: Path, part: str = "") -> None:
    """Take a picture of a page as a desktop shows it, from its top or from a part on."""
    try:
        from selenium import webdriver
    except ImportError:
        return print("no picture of the report: selenium is not installed")
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        return print("no picture of the report: no chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in ("headless", "no-sandbox", "hide-scrollbars", "window-size=1000,960"):
        options.add_argument(f"--{flag}")
    for flag in ("use-gl=angle", "use-angle=swiftshader", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{flag}")
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        chrome.get(page.resolve().as_uri() + part)
        time.sleep(5)
        chrome.save_screenshot(str(path))
        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
    finally:
        chrome.quit()


def draw_street(out: Path, wanted: Collection[str]) -> None:
    """What commands make of a simulated street: pictures of `detect`, `plan` and `calibrate`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scans = folder / "lidar0.pcd", folder / "lidar1.pcd"
        run("simulate", "street", "--seed", 1, "--out", folder, "-q")
        if "detect" in wanted:
            run("detect", scans[0], "--out", folder, "-q")
            shutil.copy(folder / "detect.svg", out / "detect.svg")
        if "plan" in wanted:
            sensors = ("--sensor", "Pandar64", "--sensor", "OS1")
            run("plan", *scans, *sensors, "--out", folder / "p", "-q")
            photograph(folder / "p" / "plan.html", out / "plan.png", "#place")
        if "report" in wanted:
            run("calibrate", *scans, "--out", folder / "r", "-q")
            photograph(folder / "r" / "report.html", out / "report.png")


def draw_merged(path: Path) -> None:
    """A merged street from above, and how far surfaces lie apart, there and at a pose that is off.

    The pose is turned by 0.1 degrees about an axis between the vertical and the level.
    """
    figure = new_figure(12.0, 4.4)
    with tempfile.TemporaryDirectory() as name:
        folder, result = Path(name), Path(name) / "r" / "result.json"
        run("simulate", "street", "--seed", 1, "--sweeps", 5, "--out", folder, "-q")
        run("calibrate", folder / "lidar0", folder / "lidar1", "--out", folder / "r", "-q")
        points = ["--voxel", "0.15", "--colour", "lidar"]
        titles = "both LiDARs", "surfaces apart", "the same, pose turned by 0.1°"
        for k, (title, more) in enumerate(
            zip(titles, (points, ["--surfels"], ["--surfels"]), strict=True)
        ):
            if k == 2:
                document = json.loads(result.read_text())
                T = np.array(document["T_target_source"])
                turn = se3.exp_so3(np.radians(0.1) * np.array([0.5, 0.5, 0.5**0.5]))
                T[:3, :3] = turn @ T[:3, :3]
                result.write_text(json.dumps(document | {"T_target_source": T.tolist()}))
            run("merge", folder / "r", "-o", folder / "m.ply", *more, "-q")
            head, _, body = (folder / "m.ply").read_bytes().partition(b"end_header\n")
            kinds = {"float": "f4", "uchar": "u1", "ushort": "u2", "uint": "u4", "double": "f8"}
            lines = [line.split() for line in head.decode().splitlines()]
            rows = np.frombuffer(body, [(w[2], kinds[w[1]]) for w in lines if w[0] == "property"])
            colour = np.column_stack([rows[c] for c in ("red", "green", "blue")]) / 255
            axes = figure.add_subplot(
                1, 3, k + 1, aspect="equal", xlim=(-18, 18), ylim=(-18, 18), title=title
            )
            axes.set_facecolor("white" if k == 0 else "#1b2027")
            axes.scatter(rows["x"], rows["y"], s=0.4 if k == 0 else 2.5, c=colour, lw=0)
            axes.set(xlabel="m")
    figure.savefig(path, dpi=80)
    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


def draw_carried(path: Path) -> None:
    """What the report shows of a walk with one pole."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run("simulate", "street", "--carried", "--seed", 1, "--out", folder, "-q")
        sensors = ("--sensor", "VLP-16")
        recordings = folder / "lidar0", folder / "lidar1"
        run("calibrate", *recordings, "--carried", *sensors, "--out", folder / "r", "-q")
        photograph(folder / "r" / "report.html", path, "#walk")


def draw_placement(path: Path) -> None:
    """What the example about placing the poles draws."""
    with tempfile.TemporaryDirectory() as name:
        plot = EXAMPLES / "plot_placement.py"
        command = [sys.executable, str(plot), "--out", name, "--draws", "8"]
        subprocess.run(command, check=True)
        shutil.copy(Path(name) / "placement.png", path)


STYLE = """
text { font: 15px system-ui, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif; fill: #1b2027 }
.dim { font-weight: 600; fill: #0072b2 }
.line { stroke: #0072b2; stroke-width: 1.5; fill: none }
.beam { fill: #e69f00; opacity: 0.14 }
.dark { fill: #454d57 }
.leg { stroke: #454d57; stroke-width: 4; stroke-linecap: round }
"""
GROUND, FEET, LIDARS, LEAN_DEG, LENGTH = 300.0, (350.0, 490.0), (80.0, 760.0), 20.0, 210.0
"""Of the drawing of a set-up: level of the ground, places, lean and length, in its own units."""


def draw_setup(path: Path) -> None:
    """Two LiDARs on tripods, and two taped poles on their stands, one of them leaning."""
    parts = [
        f'<line x1="20" y1="{GROUND}" x2="820" y2="{GROUND}" stroke="#8b939e" stroke-width="2"/>'
    ]
    lean = np.radians(LEAN_DEG)
    tops = (
        (FEET[0], GROUND - 12 - LENGTH),
        (
            FEET[1] + LENGTH * np.sin(lean),
            GROUND - 12 - LENGTH * np.cos(lean),
        ),
    )
    for x in LIDARS:
        for foot, top in zip(FEET, tops, strict=True):
            corners = f"{x},136 {top[0]:.0f},{top[1]:.0f} {foot},{GROUND - 12}"
            parts.append(f'<polygon class="beam" points="{corners}"/>')
    for foot, angle, name in zip(FEET, (0.0, LEAN_DEG), ("upright", "leaning"), strict=True):
        stripes = "".join(
            f'<path d="M{foot - 7} {y} l14 -8" stroke="#8b939e"/>'
            for y in np.arange(GROUND - 20, GROUND - LENGTH, -18.0)
        )
        parts.append(
            f'<g transform="rotate({angle} {foot} {GROUND - 12})"><rect x="{foot - 7}" '
            f'y="{GROUND - 12 - LENGTH}" width="14" height="{LENGTH}" rx="3" fill="#d9dde2" '
            f'stroke="#8b939e"/>{stripes}<rect class="dark" x="{foot - 11}" y="{GROUND - 46}" '
            'width="22" height="36" rx="2"/></g>'
        )
        stand = f"M{foot - 46} {GROUND} l8 -14 h76 l8 14 Z"
        parts.append(f'<path class="dark" d="{stand}"/>')
        parts.append(label(foot, GROUND + 20, name))
    for x, name in zip(LIDARS, ("target", "source"), strict=True):
        parts += [
            f'<line class="leg" x1="{x}" y1="150" x2="{x + dx}" y2="{GROUND - 2}"/>'
            for dx in (-30, 0, 30)
        ]
        parts.append(
            f'<rect x="{x - 20}" y="118" width="40" height="34" rx="6" fill="{ORANGE}"/>'
            f'<rect x="{x - 20}" y="130" width="40" height="10" fill="#1b2027"/>'
        )
        parts.append(label(x, 106, f"{name} LiDAR"))
    upright, leaning = FEET
    for x0, x1, words in (
        (LIDARS[0], upright, "3 to 7 m"),
        (upright, leaning, "1 to 4 m"),
        (leaning, LIDARS[1], "3 to 7 m"),
    ):
        parts.append(arrow(f"M{x0 + 4} {GROUND + 40} H{x1 - 4}"))
        parts.append(label((x0 + x1) / 2, GROUND + 60, words, "dim"))
    side = upright - 60
    parts.append(arrow(f"M{side} {GROUND - LENGTH - 12} V{GROUND - 2}"))
    middle = GROUND - LENGTH / 2
    turned = f' transform="rotate(-90 {side - 8} {middle})"'
    parts.append(label(side - 8, middle, "1.5 to 2.5 m", "dim", turned))
    reach = 150.0
    end = leaning + reach * np.sin(lean), GROUND - 12 - reach * np.cos(lean)
    parts.append(
        f'<path d="M{leaning} {GROUND - 12} v-180" stroke="#8b939e" stroke-dasharray="5 4"/>'
    )
    parts.append(
        arrow(f"M{leaning} {GROUND - 12 - reach} A{reach} {reach} 0 0 1 {end[0]:.0f} {end[1]:.0f}")
    )
    parts.append(label(leaning - 6, GROUND - 200, "15° or more", "dim", ' dx="-30"'))
    parts.append(label(420, 40, "two tubes of 4 cm, retro-reflective tape all round"))
    marker = (
        '<marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" '
        'markerUnits="userSpaceOnUse" orient="auto-start-reverse"><path fill="#0072b2" '
        'd="M0 0 L10 5 L0 10 Z"/></marker>'
    )
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 840 380" role="img" '
        'aria-label="Two LiDARs, and two taped poles on stands, one upright, one leaning">'
        f"<style>{STYLE}</style><defs>{marker}</defs>"
        '<rect x="0.5" y="0.5" width="839" height="379" rx="8" fill="#fff" stroke="#cfd4da"/>'
        f"{''.join(parts)}</svg>\n",
        encoding="utf-8",
    )


def label(x: float, y: float, words: str, kind: str = "", more: str = "") -> str:
    """Text about a point."""
    known = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle"{known}{more}>{words}</text>'


def arrow(line: str) -> str:
    """A line with a tip at either end."""
    return f'<path class="line" d="{line}" marker-start="url(#tip)" marker-end="url(#tip)"/>'


OF_STREET = "detect", "plan", "report"
PICTURES = "bias", "car_park", *OF_STREET, "carried", "merge", "placement", "placements", "setup"


def main() -> None:
    """Make them all, or some."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", default=Path("images"), help="folder")
    parser.add_argument("data", type=Path, nargs="?", help="folder with the recordings")
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=PICTURES, metavar="NAME")
    given = parser.parse_args()
    out, wanted = given.out, given.only
    out.mkdir(parents=True, exist_ok=True)
    if "bias" in wanted:
        draw_bias(out / "bias.png")
    if given.data is not None and "car_park" in wanted:
        draw_car_park(given.data, out / "car_park.png")
    if set(OF_STREET) & set(wanted):
        draw_street(out, wanted)
    if "carried" in wanted:
        draw_carried(out / "carried.png")
    if "merge" in wanted:
        draw_merged(out / "merge.png")
    if "placement" in wanted:
        draw_placement(out / "placement.png")
    if "placements" in wanted:
        draw_placements(out / "placements.png")
    if "setup" in wanted:
        draw_setup(out / "setup.svg")
    print(f"written: {out}")


if __name__ == "__main__":
    main()
