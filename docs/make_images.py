"""Make the pictures of the documentation again, from simulated scans, and one from real ones.

python docs/make_images.py docs/images
python docs/make_images.py docs/images data
python docs/make_images.py docs/images --only bias placements

The picture of the report needs Chromium, chromedriver and selenium, and is left out without. So is
that of real scans without the folder of test recordings (docs/contributing.md).
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


def draw_scene(scene: str, path: Path) -> None:
    """Both clouds of a simulated scene before and after, and the poles, as a small picture."""
    with tempfile.TemporaryDirectory() as name:
        run("simulate", scene, "--seed", 1, "--out", name, "-q")
        draw_pair(Path(name), path)


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
            sensors = ("--sensor-target", "Pandar64", "--sensor-source", "OS1")
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
        sensors = ("--sensor-target", "VLP-16", "--sensor-source", "VLP-16")
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


SCENES, OF_STREET = ("corridor", "harbor", "bare"), ("detect", "plan", "report")
PICTURES = ("bias", *(f"gallery_{scene}" for scene in SCENES), "gallery_car_park", *OF_STREET)
PICTURES = (*PICTURES, "carried", "merge", "placement", "placements")


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
    for scene in SCENES:
        if f"gallery_{scene}" in wanted:
            draw_scene(scene, out / f"gallery_{scene}.png")
    if given.data is not None and "gallery_car_park" in wanted:
        draw_car_park(given.data, out / "gallery_car_park.png")
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
    print(f"written: {out}")


if __name__ == "__main__":
    main()
