"""A picture of a result: two clouds before and after, and the poles with both LiDARs' points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...base import se3
from ...base.datatypes import Array, PointCloud, Pole
from .canvas import BLUE, ORANGE, RED, new_figure, save_figure
from .clouds import Drawn, View, draw_clouds, draw_legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCENE_HALF_WIDTH = 14.0
"""Half the width of the picture of a result, metres."""


def draw_result(
    target: PointCloud,
    source: PointCloud,
    T_target_source: Array,
    poles: tuple[Sequence[Pole], Sequence[Pole]],
    path: Path,
    *,
    contradicting: tuple[Array, Array] | None = None,
) -> None:
    """Write `result_figure`'s picture to a file; its suffix (``.png``, ``.svg``) is its format."""
    figure = result_figure(target, source, T_target_source, poles, contradicting=contradicting)
    save_figure(figure, path)


def result_figure(
    target: PointCloud,
    source: PointCloud,
    T_target_source: Array,
    poles: tuple[Sequence[Pole], Sequence[Pole]],
    *,
    contradicting: tuple[Array, Array] | None = None,
) -> Figure:
    """Draw two clouds from above before and after, and the poles with both LiDARs' points.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    T_target_source
        (4, 4) the answer.
    poles
        Of the target and of the source, paired.
    contradicting
        (N, 3) of the target and (M, 3) of the source, what `surfaces.consistency` finds to
        contradict the answer; drawn in red.

    Raises
    ------
    MissingExtraError
        Where matplotlib is not installed.
    """
    count = max(len(poles[0]), 1)
    figure = new_figure(16, 9)
    grid: Any = figure.add_gridspec(
        2, 2 + count, width_ratios=[3, 3] + [1.1] * count, height_ratios=(3, 1)
    )
    views = (
        (np.eye(4), "before: each in its own frame"),
        (T_target_source, "after: source in the frame of the target"),
    )
    view = View(_middle(target, poles[0]), SCENE_HALF_WIDTH)
    for column, (T, title) in enumerate(views):
        above = figure.add_subplot(grid[0, column])
        beside = figure.add_subplot(grid[1, column], sharex=above)
        clouds = (
            Drawn(target.xyz, "target", BLUE),
            Drawn(source.transformed(T).xyz, "source", ORANGE),
        )
        at = [pole.point for pole in poles[0]]
        draw_clouds(above, beside, clouds, at, "poles of the target", view)
        above.set_title(f"{title}\nfrom above")
        beside.set_xlabel("x of the target, m")
        if column == 0:
            above.set_ylabel("y of the target, m")
            beside.set_ylabel("z of the target, m")
            draw_legend(above, len(clouds))
        elif contradicting is not None:
            of_target, of_source = contradicting
            together = np.concatenate([of_target, se3.apply(T, of_source)])
            _draw_contradicting(above, beside, view.near(together))
    for k, (ours, theirs) in enumerate(zip(*poles, strict=True)):
        axes = figure.add_subplot(grid[:, 2 + k])
        across = np.cross(ours.direction, ours.point - target.origin)
        across /= np.linalg.norm(across) or 1.0
        up = ours.direction * np.sign(ours.direction[np.argmax(np.abs(ours.direction))])
        for xyz, color in ((ours.xyz, BLUE), (se3.apply(T_target_source, theirs.xyz), ORANGE)):
            offset = xyz - ours.point
            axes.scatter(100 * offset @ across, offset @ up, s=8, c=color, linewidths=0)
        points = f"{len(ours.xyz)} + {len(theirs.xyz)} points"
        axes.set_xlim(-12, 12)
        axes.set_title(f"pole {k}, both LiDARs\n{points}", fontsize=10)
        axes.set_xlabel("across, cm")
        axes.set_ylabel("along, m")
    return figure


def _middle(target: PointCloud, poles: Sequence[Pole]) -> Array:
    """Where the picture looks: (3,) between the poles, target frame."""
    return np.mean([pole.point for pole in poles], axis=0) if poles else target.origin


def _draw_contradicting(above: Axes, beside: Axes, xyz: Array) -> None:
    """Mark points (N, 3) that contradict the answer, target frame; a legend where there are any."""
    if not len(xyz):
        return
    style: dict[str, Any] = {"s": 9, "c": RED, "marker": "s", "linewidths": 0, "zorder": 3}
    above.scatter(xyz[:, 0], xyz[:, 1], label="contradicts the answer", **style)
    beside.scatter(xyz[:, 0], xyz[:, 2], **style)
    handles, labels = above.get_legend_handles_labels()
    above.legend(handles[-1:], labels[-1:], loc="upper right", fontsize=9)
