"""Pictures for people: what was detected in a cloud, and two clouds before and after.

Matplotlib (the optional part ``figures``) is imported where it draws, on a canvas of its own.
"""

from __future__ import annotations

import io
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import se3
from ..datatypes import Array, Detection, IntArray, PointCloud, Pole
from ..errors import MissingExtraError
from ..files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GREY, BLUE, ORANGE, RED, GREEN = "#9aa0a6", "#0072b2", "#e69f00", "#d55e00", "#009e73"
"""Okabe and Ito's colours, which colour-blind readers tell apart."""

DRAWN = 40_000
"""Points of a cloud that are drawn."""

NUMBERED = 20
"""Poles that are numbered in the view from above."""

FAR_ORIGIN, SCENE = 100.0, 14.0
"""Farther from its points than the first, metres, an origin is none; half the width of a scene."""

ZOOMED = 6
"""Poles, or failing those rejected clusters, that get a panel of their own."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure, inches, on a canvas of its own: no window, no state of pyplot's.

    Raises
    ------
    MissingExtraError
        Where matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("figures", "drawing pictures") from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix.lstrip(".") or "png")
    write_atomically(path, buffer.getvalue())


def _thin(xyz: Array) -> Array:
    return xyz[:: 1 + (len(xyz) - 1) // DRAWN]


def draw_detection(cloud: PointCloud, detection: Detection, path: Path, *, title: str) -> None:
    """Draw a cloud from above and from the side, its poles, and what was rejected and why.

    Parameters
    ----------
    cloud
        The cloud, with intensity.
    detection
        What `extraction.extract_poles` found in it.
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
        f"{detection.threshold:g} ({detection.threshold_source})"
    )
    middle, reach = _frame(cloud, detection)
    offset = cloud.xyz - middle
    thin = _thin(offset[np.linalg.norm(offset, axis=1) < 1.5 * reach])
    for axes, vertical in ((above, 1), (beside, 2)):
        axes.scatter(thin[:, 0], thin[:, vertical], s=0.4, c=GREY, linewidths=0, rasterized=True)
        _mark(axes, cloud, detection, middle, vertical, reach)
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("x, m")
        axes.set_ylabel("y, m" if vertical == 1 else "z, m")
    above.set_aspect("equal")
    above.set_ylim(-reach, reach)
    low, high = np.quantile(thin[:, 2], [0.005, 0.995]) if len(thin) else (-1.0, 1.0)
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

    The origin of a moved file can be far from its points; then the view is about the poles.
    """
    shown = [pole.xyz for pole in detection.poles] or [
        cloud.xyz[r.index] for r in detection.rejected
    ]
    points = np.concatenate(shown[:ZOOMED]) if shown else cloud.xyz
    middle = cloud.origin
    if np.linalg.norm(np.median(points, axis=0) - middle) > FAR_ORIGIN:
        middle = np.median(points, axis=0)
    reach = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98))
    return middle, float(np.clip(1.5 * reach, 10.0, 60.0))


def _mark(
    axes: Any, cloud: PointCloud, detection: Detection, middle: Array, vertical: int, reach: float
) -> None:
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
        _number(axes, np.array([line.mean(axis=0)[:2] for line in ends]).reshape(-1, 2), reach)


def _number(axes: Any, places: Array, reach: float) -> None:
    """Number the first poles (K, 2) in a column at either side, none on another."""
    shown = [k for k in range(len(places)) if np.abs(places[k]).max() < reach][:NUMBERED]
    for side in (-1, 1):
        column = [k for k in shown if (places[k, 0] >= 0) == (side > 0)]
        column.sort(key=lambda k: places[k, 1])
        heights = [float(places[k, 1]) for k in column]
        for n in range(1, len(heights)):
            heights[n] = max(heights[n], heights[n - 1] + 0.075 * reach)
        overshoot = max(0.0, heights[-1] - 0.95 * reach) if heights else 0.0
        for k, height in zip(column, heights, strict=True):
            at = float(np.clip(places[k, 0] + side * 0.18 * reach, -0.8 * reach, 0.8 * reach))
            outward = side if abs(at - places[k, 0]) > 0.1 * reach else -side
            at = at if outward == side else places[k, 0] - side * 0.18 * reach
            axes.annotate(
                f"pole {k}", places[k], xytext=(at, height - overshoot), color=BLUE, fontsize=10,
                weight="bold", ha="left" if outward > 0 else "right", va="center",
                arrowprops={"arrowstyle": "-", "color": BLUE, "lw": 0.8},
            )  # fmt: skip


def _draw_histogram(axes: Any, cloud: PointCloud, detection: Detection) -> None:
    assert cloud.intensity is not None
    axes.hist(cloud.intensity, bins=64, color=GREY, log=True)
    axes.axvline(detection.threshold, color=RED, lw=2, label=f"threshold {detection.threshold:g}")
    axes.set_xlabel("intensity, the sensor's scale")
    axes.set_ylabel("returns")
    axes.legend(fontsize=9)


def _draw_zooms(panel: Any, cloud: PointCloud, detection: Detection) -> None:
    """Draw each of the first poles and rejected clusters as the sensor sees it."""
    poles = detection.poles[:ZOOMED]
    rejected = detection.rejected[: max(ZOOMED - len(poles), 0)]
    count = len(poles) + len(rejected)
    if count == 0:
        panel.text(0.5, 0.5, "no retro-reflective returns", ha="center")
        return
    grid = panel.subplots(1, count, squeeze=False)[0]
    drawn = None
    for k, pole in enumerate(poles):
        words = f"pole {k}: {pole.length:.2f} m, {len(pole.xyz)} points\n"
        words += f"{pole.rings} rows, rms {1000 * pole.rms:.0f} mm"
        size = max(1.1 * pole.length, 0.6)
        drawn = _draw_zoom(grid[k], cloud, detection, pole.index, size, BLUE, words)
    for axes, cluster in zip(grid[len(poles) :], rejected, strict=True):
        size = float(np.clip(np.ptp(cloud.xyz[cluster.index], axis=0).max(), 0.6, 6.0))
        words = f"{cluster.code}, {len(cluster.index)} points:\n"
        words += textwrap.shorten(cluster.reason, 34, placeholder=" …")
        drawn = _draw_zoom(axes, cloud, detection, cluster.index, size, RED, words)
    panel.colorbar(drawn, ax=list(grid), label="intensity", shrink=0.7)


def _draw_zoom(
    axes: Any,
    cloud: PointCloud,
    detection: Detection,
    index: IntArray,
    size: float,
    color: str,
    words: str,
) -> Any:
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
        own @ across, own @ up, s=16, c=cloud.intensity[index], cmap="viridis", linewidths=0,
        vmin=detection.threshold, vmax=float(cloud.intensity.max()),
    )  # fmt: skip
    axes.set_xlim(-0.7 * size, 0.7 * size)
    axes.set_ylim(-0.7 * size, 0.7 * size)
    axes.set_aspect("equal")
    axes.set_title(words, fontsize=9, color=color)
    axes.set_xlabel("m, as the sensor sees it")
    for spine in axes.spines.values():
        spine.set(color=color, linewidth=1.5)
    return drawn


def draw_result(
    target: PointCloud,
    source: PointCloud,
    T_target_source: Array,
    poles: tuple[Sequence[Pole], Sequence[Pole]],
    path: Path,
) -> None:
    """Draw two clouds from above before and after, and the poles with both LiDARs' points.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    T_target_source
        (4, 4) the answer.
    poles
        Of the target and of the source, paired.
    path
        Of the picture.
    """
    count = len(poles[0])
    figure = new_figure(16, 9)
    shape: Any = figure.add_gridspec(
        2, 2 + max(count, 1), width_ratios=[3, 3] + [1.1] * max(count, 1), height_ratios=(3, 1)
    )
    middle = np.mean([pole.point for pole in poles[0]], axis=0) if count else target.origin
    for column, (T, title) in enumerate(
        (
            (np.eye(4), "before: each in its own frame"),
            (T_target_source, "after: source in the frame of the target"),
        )
    ):
        above = figure.add_subplot(shape[0, column])
        beside = figure.add_subplot(shape[1, column], sharex=above)
        for cloud, color, name in ((target, BLUE, "target"), (source, ORANGE, "source")):
            xyz = cloud.xyz if cloud is target else se3.apply(T, cloud.xyz)
            xyz = _thin(xyz[np.abs(xyz - middle).max(axis=1) < SCENE])
            style: dict[str, Any] = {"s": 0.6, "c": color, "linewidths": 0, "rasterized": True}
            above.scatter(xyz[:, 0], xyz[:, 1], label=name, **style)
            beside.scatter(xyz[:, 0], xyz[:, 2], **style)
        for k, pole in enumerate(poles[0]):
            label = "poles of the target" if k == 0 else None
            above.plot(*pole.point[:2], "o", ms=12, mfc="none", mec=GREEN, mew=2, label=label)
            beside.plot(*pole.point[[0, 2]], "o", ms=12, mfc="none", mec=GREEN, mew=2)
        above.set_xlim(middle[0] - SCENE, middle[0] + SCENE)
        above.set_ylim(middle[1] - SCENE, middle[1] + SCENE)
        above.set_aspect("equal")
        above.set_title(f"{title}\nfrom above")
        beside.set_title("from the side, heights stretched", fontsize=10)
        beside.set_xlabel("x of the target, m")
        if column == 0:
            above.set_ylabel("y of the target, m")
            beside.set_ylabel("z of the target, m")
            legend: Any = above.legend(loc="upper right", fontsize=9)
            for handle in legend.legend_handles[:2]:
                handle.set_sizes([60.0])
    for k, (ours, theirs) in enumerate(zip(*poles, strict=True)):
        axes = figure.add_subplot(shape[:, 2 + k])
        across = np.cross(ours.direction, ours.point - target.origin)
        across /= np.linalg.norm(across) or 1.0
        up = ours.direction * np.sign(ours.direction[np.argmax(np.abs(ours.direction))])
        moved = se3.apply(T_target_source, theirs.xyz)
        for xyz, color in ((ours.xyz, BLUE), (moved, ORANGE)):
            offset = xyz - ours.point
            axes.scatter(100 * offset @ across, offset @ up, s=8, c=color, linewidths=0)
        axes.set_xlim(-12, 12)
        axes.set_title(f"pole {k}, both LiDARs\n{len(ours.xyz)} + {len(moved)} points", fontsize=10)
        axes.set_xlabel("across, cm")
        axes.set_ylabel("along, m")
    save_figure(figure, path)
