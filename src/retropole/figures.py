"""Pictures for people: what was detected in a cloud, and two clouds before and after.

Matplotlib (the optional part ``figures``) is imported where it draws, on a canvas of its own.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import se3
from .datatypes import Array, Detection, PointCloud, Pole
from .errors import MissingExtraError
from .files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GREY, BLUE, ORANGE, RED, GREEN = "#9aa0a6", "#0072b2", "#e69f00", "#d55e00", "#009e73"
"""Okabe and Ito's colours, which colour-blind readers tell apart."""

DRAWN = 40_000
"""Points of a cloud that are drawn."""

ZOOMED = 6
"""Poles, or failing those rejected clusters, that get a panel of their own."""


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("figures", "drawing pictures") from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
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
    figure = _figure(16, 11)
    panels: Any = figure.subfigures(2, 1, height_ratios=(3, 2), squeeze=False)[:, 0]
    above, beside, histogram = panels[0].subplots(1, 3, width_ratios=(3, 3, 2))
    figure.suptitle(
        f"{title}: poles {len(detection.poles)}, rejected clusters {len(detection.rejected)}, "
        f"{detection.retro_points:,} of {len(cloud):,} returns at or above "
        f"{detection.threshold:g} ({detection.threshold_source})"
    )
    rays = cloud.xyz - cloud.origin
    shown = [pole.xyz for pole in detection.poles]
    shown += [cloud.xyz[r.index] for r in detection.rejected[:ZOOMED]]
    reach = 15.0
    if shown:
        reach = float(np.linalg.norm(np.concatenate(shown) - cloud.origin, axis=1).max())
    reach = float(np.clip(1.2 * reach, 5.0, 60.0))
    thin = _thin(rays[np.linalg.norm(rays, axis=1) < 1.5 * reach])
    for axes, vertical in ((above, 1), (beside, 2)):
        axes.scatter(thin[:, 0], thin[:, vertical], s=0.3, c=GREY, linewidths=0, rasterized=True)
        _mark(axes, cloud, detection, vertical, reach)
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("x from the sensor, m")
        axes.set_ylabel("y, m" if vertical == 1 else "z, m")
        axes.set_aspect("equal")
    above.set_ylim(-reach, reach)
    low, high = np.quantile(thin[:, 2], [0.005, 0.995]) if len(thin) else (-1.0, 1.0)
    beside.set_ylim(low - 1.0, high + 1.0)
    above.set_title("from above")
    beside.set_title("from the side")
    beside.legend(loc="upper right", fontsize=8)
    _draw_histogram(histogram, cloud, detection)
    _draw_zooms(panels[1], cloud, detection)
    _save(figure, path)


def _mark(axes: Any, cloud: PointCloud, detection: Detection, vertical: int, reach: float) -> None:
    label: str | None = "rejected"
    for rejected in detection.rejected:
        points = cloud.xyz[rejected.index] - cloud.origin
        axes.scatter(points[:, 0], points[:, vertical], s=5, c=ORANGE, linewidths=0, label=label)
        label = None
    label = "pole"
    for k, pole in enumerate(detection.poles):
        ends = pole.point + np.outer([-0.5, 0.5], pole.length * pole.direction) - cloud.origin
        axes.plot(ends[:, 0], ends[:, vertical], c=BLUE, lw=3, label=label)
        place = ends[np.argmax(ends[:, 2])]
        if vertical == 1 and np.abs(place[:2]).max() < reach and k < 30:
            # Labels on a ring about the pole, so that close poles do not hide each other's number.
            turn = 2.4 * k
            shift = (14 * np.cos(turn), 14 * np.sin(turn))
            axes.annotate(
                str(k), place[:2], xytext=shift, textcoords="offset points",
                color=BLUE, weight="bold", ha="center", va="center",
                arrowprops={"arrowstyle": "-", "color": BLUE, "lw": 0.6},
            )  # fmt: skip
        label = None


def _draw_histogram(axes: Any, cloud: PointCloud, detection: Detection) -> None:
    assert cloud.intensity is not None
    axes.hist(cloud.intensity, bins=64, color=GREY, log=True)
    axes.axvline(detection.threshold, color=RED, lw=2, label=f"threshold {detection.threshold:g}")
    axes.set_title("intensity")
    axes.set_xlabel("intensity, the sensor's scale")
    axes.set_ylabel("returns")
    axes.legend(fontsize=8)


def _draw_zooms(panel: Any, cloud: PointCloud, detection: Detection) -> None:
    """Draw each of the first poles and rejected clusters as the sensor sees it."""
    poles = detection.poles[:ZOOMED]
    rejected = detection.rejected[: max(ZOOMED - len(poles), 1 if len(poles) < ZOOMED else 0)]
    count = len(poles) + len(rejected)
    if count == 0:
        panel.text(0.5, 0.5, "no retro-reflective returns", ha="center")
        return
    grid = panel.subplots(1, count, squeeze=False)[0]
    for k, pole in enumerate(poles):
        words = f"pole {k}: {pole.length:.2f} m, {len(pole.xyz)} points\n"
        words += f"{pole.rings} rows, rms {1000 * pole.rms:.0f} mm"
        _draw_zoom(grid[k], cloud, pole.point, max(pole.length, 0.6), pole.xyz, BLUE, words)
    for axes, cluster in zip(grid[len(poles) :], rejected, strict=True):
        points = cloud.xyz[cluster.index]
        size = float(np.clip(np.ptp(points, axis=0).max(), 0.6, 6.0))
        words = f"rejected: {cluster.code},\n{len(points)} points"
        _draw_zoom(axes, cloud, cluster.centre, size, points, ORANGE, words)


def _draw_zoom(
    axes: Any, cloud: PointCloud, centre: Array, size: float, points: Array, color: str, words: str
) -> None:
    ray = centre - cloud.origin
    across = np.cross(ray, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across) or 1.0
    up = np.cross(across, ray / np.linalg.norm(ray))
    near = cloud.xyz[np.abs(cloud.xyz - centre).max(axis=1) < 0.75 * size]
    for xyz, c, s in ((near, GREY, 4.0), (points, color, 12.0)):
        offset = xyz - centre
        axes.scatter(offset @ across, offset @ up, s=s, c=c, linewidths=0)
    axes.set_xlim(-0.7 * size, 0.7 * size)
    axes.set_ylim(-0.7 * size, 0.7 * size)
    axes.set_aspect("equal")
    axes.set_title(words, fontsize=9, color=color)
    axes.set_xlabel("m, as the sensor sees it")


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
    figure = _figure(14, 6.2)
    grid: Any = figure.subplots(1, 2 + len(poles[0]), width_ratios=[3, 3] + [1.1] * len(poles[0]))
    reach = 14.0
    centre = np.mean([pole.point for pole in poles[0]], axis=0)
    for axes, T, title in (
        (grid[0], np.eye(4), "before: both in their own frame"),
        (grid[1], T_target_source, "after: source in the frame of the target"),
    ):
        for cloud, color, name in ((target, BLUE, "target"), (source, ORANGE, "source")):
            xyz = cloud.xyz if cloud is target else se3.apply(T, cloud.xyz)
            xyz = _thin(xyz[np.abs(xyz[:, :2] - centre[:2]).max(axis=1) < reach])
            axes.scatter(xyz[:, 0], xyz[:, 1], s=0.6, c=color, linewidths=0, label=name)
        for pole in poles[0]:
            axes.plot(*pole.point[:2], "o", ms=11, mfc="none", mec=GREEN, mew=2)
        axes.set_xlim(centre[0] - reach, centre[0] + reach)
        axes.set_ylim(centre[1] - reach, centre[1] + reach)
        axes.set_aspect("equal")
        axes.set_title(title)
        axes.set_xlabel("x of the target, m")
    grid[0].set_ylabel("y of the target, m")
    grid[0].legend(loc="upper right", markerscale=12)
    for k, (axes, ours, theirs) in enumerate(zip(grid[2:], *poles, strict=True)):
        across = np.cross(ours.direction, ours.point - target.origin)
        across /= np.linalg.norm(across)
        up = ours.direction * np.sign(ours.direction[np.argmax(np.abs(ours.direction))])
        moved = se3.apply(T_target_source, theirs.xyz)
        for xyz, color in ((ours.xyz, BLUE), (moved, ORANGE)):
            offset = xyz - ours.point
            axes.scatter(100 * offset @ across, offset @ up, s=8, c=color, linewidths=0)
        axes.set_xlim(-12, 12)
        axes.set_title(f"pole {k}: both on it", fontsize=10)
        axes.set_xlabel("across, cm")
        axes.set_ylabel("along, m")
    _save(figure, path)
