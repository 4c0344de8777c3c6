"""A picture of a detection: where the poles are in a cloud, and what was rejected and why."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..base.datatypes import Array, Detection, IntArray, PointCloud, every_nth
from ..base.errors import shortened
from ..base.files import write_atomically
from ..base.quantities import counted
from .figures import MAX_FIGURE_POINTS
from .page import Html, fill, join
from .svg import Chart, Labels, round_numbers

MAX_NUMBERED_POLES = 20
"""Poles that are numbered in the view from above."""

FAR_ORIGIN = 100.0
"""An origin further than this from the points, metres, is not where the beams start."""

MAX_ZOOMED = 6
"""Poles, or failing those rejected clusters, that get a separate panel."""

SHADES = 5
"""Intensities of the points on a pole are distinguished by this many colours."""


def draw_detection(cloud: PointCloud, detection: Detection, path: Path, *, title: str) -> None:
    """Write an SVG of a cloud from above and the side, its poles, and what was rejected and why.

    Parameters
    ----------
    cloud
        The cloud, with intensity.
    detection
        What `extraction.poles.extract_poles` found in it.
    path
        Of the picture.
    title
        First words of the picture.
    """
    middle, half = _frame(cloud, detection)
    offset = cloud.xyz - middle
    drawn = every_nth(offset[np.linalg.norm(offset, axis=1) < 1.5 * half], MAX_FIGURE_POINTS)
    low, high = np.quantile(drawn[:, 2], [0.005, 0.995]) if len(drawn) else (-1.0, 1.0)
    above = Chart((60.0, 90.0, 620.0, 650.0), (-half, half), (-half, half))
    heights = float(low) - 1.0, float(high) + 1.0
    chart = Chart((700.0, 90.0, 1220.0, 310.0), (-half, half), heights)
    count = f"poles {len(detection.poles)}, rejected clusters {len(detection.rejected)}"
    bright = (
        f"{detection.retro_points:,} of {len(cloud):,} returns at or above "
        f"{detection.threshold:g} ({detection.threshold_source})"
    )
    codes = Counter(each.code for each in detection.rejected).most_common(5)
    marks = [
        *_view(above, cloud, detection, drawn, middle, 1),
        *_view(chart, cloud, detection, drawn, middle, 2),
        *_numbers(above, detection, middle),
        *_histogram(cloud, detection),
        *_zooms(cloud, detection),
    ]
    page = fill(
        "detection",
        title=f"{shortened(title, 60)}: {count}, {bright}",
        rejected=", ".join(f"{code} {number}" for code, number in codes) or "none",
        marks=join(marks),
    )
    write_atomically(path, page.encode("utf-8"))


def _frame(cloud: PointCloud, detection: Detection) -> tuple[Array, float]:
    """Middle (3,) and half width, metres, of a view of the first poles and the sensor.

    The origin of a cloud in map coordinates can be far from its points; then the view is about the
    poles.
    """
    shown = [pole.xyz for pole in detection.poles] or [
        cloud.xyz[r.index] for r in detection.rejected
    ]
    points = np.concatenate(shown[:MAX_ZOOMED]) if shown else cloud.xyz
    middle = cloud.origin
    if np.linalg.norm(np.median(points, axis=0) - middle) > FAR_ORIGIN:
        middle = np.median(points, axis=0)
    half_width = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98))
    return middle, float(np.clip(1.5 * half_width, 10.0, 60.0))


def _dots(chart: Chart, points: Array, kind: str) -> Html:
    """Draw of points (N, 2) those in the box of a chart, one of those that fall together."""
    left, top, right, bottom = chart.box
    at = np.unique(np.rint(2 * chart.at(points)), axis=0) / 2
    inside = at[((at >= [left, top]) & (at <= [right, bottom])).all(axis=1)]
    return fill("path", kind=kind, path="".join(f"M{x:g} {y:g}h0" for x, y in inside))


def _view(
    chart: Chart,
    cloud: PointCloud,
    detection: Detection,
    drawn: Array,
    middle: Array,
    vertical: int,
) -> Iterator[Html]:
    """Draw points (N, 3), poles and rejected clusters against x and another coordinate."""
    names = ("x, m", "y, m") if vertical == 1 else ("x, m; heights are stretched", "z, m")
    yield from chart.axes(round_numbers(*chart.x), round_numbers(*chart.y), *names)
    yield _dots(chart, drawn[:, [0, vertical]], "all")
    for cluster in detection.rejected:
        yield _dots(chart, (cloud.xyz[cluster.index] - middle)[:, [0, vertical]], "rejected")
    for ends in _ends(detection, middle):
        if all(abs(ends[:, 0]) < chart.x[1]):
            yield fill("line", kind="pole", path=chart.line(ends[:, 0], ends[:, vertical]))


def _ends(detection: Detection, middle: Array) -> list[Array]:
    """Give both ends (2, 3) of each pole from the middle of the picture."""
    return [
        pole.point + np.outer([-0.5, 0.5], pole.length * pole.direction) - middle
        for pole in detection.poles
    ]


def _numbers(chart: Chart, detection: Detection, middle: Array) -> list[Html]:
    """Number the first poles in a view from above, so that none covers another."""
    places = [ends.mean(axis=0)[:2] for ends in _ends(detection, middle)]
    at = chart.at(np.reshape(places, (-1, 2)))
    left, top, right, bottom = chart.box
    shown = [k for k, (x, y) in enumerate(at) if left < x < right and top < y < bottom]
    shown = shown[:MAX_NUMBERED_POLES]
    labels = Labels(right, bottom)
    for x, y in at[shown]:
        labels.keep_free(x, y, 5.0)
    return [labels.place(f"pole {k}", at[k][0], at[k][1], 10.0, "name", 13.0) for k in shown]


def _histogram(cloud: PointCloud, detection: Detection) -> Iterator[Html]:
    """Draw how many returns have which intensity, and the threshold."""
    assert cloud.intensity is not None
    counts, edges = np.histogram(cloud.intensity, 64)
    decades = int(np.ceil(np.log10(max(counts.max(), 2))))
    span = float(edges[0]), float(max(edges[-1], detection.threshold))
    chart = Chart((700.0, 400.0, 1220.0, 600.0), span, (-0.3, decades))
    levels = {float(k): f"{10**k:,}" for k in range(decades + 1)}
    names = ("intensity, the sensor's scale", "returns")
    yield from chart.axes(round_numbers(*span), levels, *names)
    bars = [
        f"M{chart.line([a, a, b, b], [-0.3, *[np.log10(count)] * 2, -0.3])}z"
        for count, a, b in zip(counts, edges, edges[1:], strict=False)
        if count
    ]
    yield fill("path", kind="bars", path="".join(bars))
    at = detection.threshold
    yield fill("line", kind="threshold", path=chart.line([at, at], [-0.3, decades]))
    label = f"threshold {at:g}"
    (x, y), anchor = chart.at(np.array([[at, decades]]))[0], "end"
    if x < (chart.box[0] + chart.box[2]) / 2:
        anchor = "start"
    x += 6 if anchor == "start" else -6
    yield fill("label", x=x, y=y + 12, anchor=anchor, style="threshold", text=label)


def _zooms(cloud: PointCloud, detection: Detection) -> Iterator[Html]:
    """Draw each of the first poles and rejected clusters as the sensor sees it."""
    assert cloud.intensity is not None
    top = float(cloud.intensity.max())
    shades = np.linspace(detection.threshold, max(top, detection.threshold), SHADES + 1)
    panels: list[tuple[IntArray, float, str, str, str]] = []
    for k, pole in enumerate(detection.poles[:MAX_ZOOMED]):
        text = f"{counted(pole.rings, 'ring')}, rms {1000 * pole.rms:.0f} mm"
        name = f"pole {k}: {pole.length:.2f} m, {counted(len(pole.xyz), 'point')}"
        panels.append((pole.index, max(1.1 * pole.length, 0.6), "pole", name, text))
    for cluster in detection.rejected[: MAX_ZOOMED - len(panels)]:
        size = float(np.clip(np.ptp(cloud.xyz[cluster.index], axis=0).max(), 0.6, 6.0))
        name = f"{cluster.code}, {counted(len(cluster.index), 'point')}:"
        text = textwrap.shorten(cluster.reason, 34, placeholder=" …")
        panels.append((cluster.index, size, "rejected", name, text))
    for k, (index, size, kind, name, text) in enumerate(panels):
        left, half = 60.0 + 200 * k, 0.7 * size
        box = left, 740.0, left + 150, 890.0
        yield fill("zoom", kind=kind, x=box[0], y=box[1], wide=150, high=150)
        for shown, y in ((name, 718.0), (text, 733.0)):
            place = {"x": left, "y": y, "anchor": "start"}
            yield fill("label", **place, style=f"small {kind}", text=shown)
        yield from _zoom(Chart(box, (-half, half), (-half, half)), cloud, index, size, shades)
    if not panels:
        label = "no retro-reflective returns"
        yield fill("label", x=620.0, y=800.0, anchor="middle", style="", text=label)


def _zoom(
    chart: Chart, cloud: PointCloud, index: IntArray, size: float, shades: Array
) -> Iterator[Html]:
    """Draw what is within a square of this size, metres, at right angles to the line of sight."""
    assert cloud.intensity is not None
    centre = cloud.xyz[index].mean(axis=0)
    ray = centre - cloud.origin
    across = np.cross(ray, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across) or 1.0
    axes = np.stack([across, np.cross(across, ray / (np.linalg.norm(ray) or 1.0))])
    numbers = round_numbers(*chart.x)
    yield from chart.axes(numbers, numbers, "m, as the sensor sees it")
    near = cloud.xyz[np.abs(cloud.xyz - centre).max(axis=1) < 0.75 * size] - centre
    yield _dots(chart, near @ axes.T, "all")
    shade = np.searchsorted(shades[1:-1], cloud.intensity[index])
    for k in range(SHADES):
        own = (cloud.xyz[index[shade == k]] - centre) @ axes.T
        yield _dots(chart, own, f"own shade-{k}")
