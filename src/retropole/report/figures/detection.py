"""A picture of a detection: where the poles are in a cloud, and what was rejected and why."""

from __future__ import annotations

import textwrap
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...base.datatypes import Array, Detection, IntArray, PointCloud, every_nth
from ...base.quantities import counted
from .canvas import BLUE, GREY, MAX_FIGURE_POINTS, ORANGE, RED, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import SubFigure

MAX_NUMBERED_POLES = 20
"""Poles that are numbered in the view from above."""

FAR_ORIGIN = 100.0
"""An origin further than this from the points, metres, is not where the beams start."""

MAX_ZOOMED = 6
"""Poles, or failing those rejected clusters, that get a panel of their own."""


def draw_detection(cloud: PointCloud, detection: Detection, path: Path, *, title: str) -> None:
    """Draw a cloud from above and from the side, its poles, and what was rejected and why.

    Parameters
    ----------
    cloud
        The cloud, with intensity.
    detection
        What `extraction.poles.extract_poles` found in it.
    path
        Of the picture; its suffix (``.png``, ``.svg``) is its format.
    title
        First line of the picture.

    Raises
    ------
    MissingExtraError
        Where matplotlib is not installed.
    """
    figure = new_figure(16, 11)
    panels: Any = figure.subfigures(2, 1, height_ratios=(3, 2))
    upper, lower = panels
    grid: Any = upper.add_gridspec(2, 2, width_ratios=(5, 4))
    above, beside = upper.add_subplot(grid[:, 0]), upper.add_subplot(grid[0, 1])
    figure.suptitle(
        f"{title}: poles {len(detection.poles)}, rejected clusters {len(detection.rejected)}, "
        f"{detection.retro_points:,} of {len(cloud):,} returns at or above "
        f"{detection.threshold:g} ({detection.threshold_source})",
        # A file name with dollar signs is no formula.
        parse_math=False,
    )
    middle, half_width = _frame(cloud, detection)
    offset = cloud.xyz - middle
    drawn = every_nth(offset[np.linalg.norm(offset, axis=1) < 1.5 * half_width], MAX_FIGURE_POINTS)
    for axes, vertical in ((above, 1), (beside, 2)):
        axes.scatter(drawn[:, 0], drawn[:, vertical], s=0.4, c=GREY, linewidths=0, rasterized=True)
        _mark(axes, cloud, detection, middle, vertical, half_width)
        axes.set_xlim(-half_width, half_width)
        axes.set_xlabel("x, m")
        axes.set_ylabel("y, m" if vertical == 1 else "z, m")
    above.set_aspect("equal")
    above.set_ylim(-half_width, half_width)
    low, high = np.quantile(drawn[:, 2], [0.005, 0.995]) if len(drawn) else (-1.0, 1.0)
    beside.set_ylim(low - 1.0, high + 1.0)
    above.set_title("from above")
    beside.set_title("from the side, heights stretched")
    if detection.poles or detection.rejected:
        above.legend(loc="upper left", bbox_to_anchor=(1.01, 1), fontsize=9, markerscale=2)
    _draw_histogram(upper.add_subplot(grid[1, 1]), cloud, detection)
    _draw_zooms(lower, cloud, detection)
    save_figure(figure, path)


def _frame(cloud: PointCloud, detection: Detection) -> tuple[Array, float]:
    """Middle (3,) and half width, metres, of a view that holds the first poles and the sensor.

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


def _mark(
    axes: Axes,
    cloud: PointCloud,
    detection: Detection,
    middle: Array,
    vertical: int,
    half_width: float,
) -> None:
    """Draw poles and rejected clusters against x and another coordinate."""
    if detection.rejected:
        index = np.concatenate([rejected.index for rejected in detection.rejected])
        points = cloud.xyz[index] - middle
        counts = Counter(rejected.code for rejected in detection.rejected)
        reasons = [f"{code} {count}" for code, count in counts.most_common(5)]
        label = "rejected: " + ",\n".join(reasons)
        axes.scatter(points[:, 0], points[:, vertical], s=6, c=ORANGE, linewidths=0, label=label)
    ends = [
        pole.point + np.outer([-0.5, 0.5], pole.length * pole.direction) - middle
        for pole in detection.poles
    ]
    for k, line in enumerate(ends):
        name = f"poles {len(ends)}" if k == 0 else None
        axes.plot(line[:, 0], line[:, vertical], c=BLUE, lw=4, solid_capstyle="round", label=name)
    if vertical == 1:
        _number(axes, np.array([line.mean(axis=0)[:2] for line in ends]).reshape(-1, 2), half_width)


def _number(axes: Axes, places: Array, half_width: float) -> None:
    """Number the first poles (K, 2) in a column at either side, so that none covers another."""
    at = places / half_width
    shown = [k for k in range(len(at)) if np.abs(at[k]).max() < 1.0][:MAX_NUMBERED_POLES]
    for side in (-1, 1):
        column = [k for k in shown if (at[k, 0] >= 0) == (side > 0)]
        column.sort(key=lambda k: float(at[k, 1]))
        heights = [float(at[k, 1]) for k in column]
        for n in range(1, len(heights)):
            heights[n] = max(heights[n], heights[n - 1] + 0.075)
        overshoot = max(0.0, heights[-1] - 0.95) if heights else 0.0
        for k, height in zip(column, heights, strict=True):
            x = float(np.clip(at[k, 0] + side * 0.18, -0.8, 0.8))
            outward = side if abs(x - at[k, 0]) > 0.1 else -side
            x = x if outward == side else float(at[k, 0]) - side * 0.18
            axes.annotate(
                f"pole {k}",
                (float(places[k, 0]), float(places[k, 1])),
                xytext=(x * half_width, (height - overshoot) * half_width),
                color=BLUE,
                fontsize=10,
                weight="bold",
                ha="left" if outward > 0 else "right",
                va="center",
                arrowprops={"arrowstyle": "-", "color": BLUE, "lw": 0.8},
            )


def _draw_histogram(axes: Axes, cloud: PointCloud, detection: Detection) -> None:
    assert cloud.intensity is not None
    axes.hist(cloud.intensity, bins=64, color=GREY, log=True)
    axes.axvline(detection.threshold, color=RED, lw=2, label=f"threshold {detection.threshold:g}")
    axes.set_xlabel("intensity, the sensor's scale")
    axes.set_ylabel("returns")
    axes.legend(fontsize=9)


def _draw_zooms(panel: SubFigure, cloud: PointCloud, detection: Detection) -> None:
    """Draw each of the first poles and rejected clusters as the sensor sees it."""
    poles = detection.poles[:MAX_ZOOMED]
    rejected = detection.rejected[: max(MAX_ZOOMED - len(poles), 0)]
    count = len(poles) + len(rejected)
    if count == 0:
        panel.text(0.5, 0.5, "no retro-reflective returns", ha="center")
        return
    grid = panel.subplots(1, count, squeeze=False)[0]
    drawn = []
    for axes, (k, pole) in zip(grid, enumerate(poles), strict=False):
        words = f"pole {k}: {pole.length:.2f} m, {counted(len(pole.xyz), 'point')}\n"
        words += f"{counted(pole.rings, 'ring')}, rms {1000 * pole.rms:.0f} mm"
        size = max(1.1 * pole.length, 0.6)
        drawn.append(_draw_zoom(axes, cloud, detection, pole.index, size, BLUE, words))
    for axes, cluster in zip(grid[len(poles) :], rejected, strict=True):
        size = float(np.clip(np.ptp(cloud.xyz[cluster.index], axis=0).max(), 0.6, 6.0))
        words = f"{cluster.code}, {counted(len(cluster.index), 'point')}:\n"
        words += textwrap.shorten(cluster.reason, 34, placeholder=" …")
        drawn.append(_draw_zoom(axes, cloud, detection, cluster.index, size, RED, words))
    panel.colorbar(drawn[-1], ax=list(grid), label="intensity", shrink=0.7)


def _draw_zoom(
    axes: Axes,
    cloud: PointCloud,
    detection: Detection,
    index: IntArray,
    size: float,
    color: str,
    words: str,
) -> PathCollection:
    """Draw what is within a square of this size, metres, at right angles to the line of sight."""
    assert cloud.intensity is not None
    centre = cloud.xyz[index].mean(axis=0)
    ray = centre - cloud.origin
    across = np.cross(ray, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across) or 1.0
    up = np.cross(across, ray / (np.linalg.norm(ray) or 1.0))
    near = cloud.xyz[np.abs(cloud.xyz - centre).max(axis=1) < 0.75 * size] - centre
    axes.scatter(near @ across, near @ up, s=4, c=GREY, linewidths=0)
    own = cloud.xyz[index] - centre
    drawn = axes.scatter(
        own @ across,
        own @ up,
        s=16,
        c=cloud.intensity[index],
        cmap="viridis",
        linewidths=0,
        vmin=detection.threshold,
        vmax=float(cloud.intensity.max()),
    )
    axes.set_xlim(-0.7 * size, 0.7 * size)
    axes.set_ylim(-0.7 * size, 0.7 * size)
    axes.set_aspect("equal")
    axes.set_title(words, fontsize=9, color=color)
    axes.set_xlabel("m, as the sensor sees it")
    for spine in axes.spines.values():
        spine.set(color=color, linewidth=1.5)
    return drawn
