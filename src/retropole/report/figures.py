"""Pictures for notebooks: the clouds of a pair before and after, and those of a site in one frame.

They are matplotlib's (the extra ``figures``), which is imported where a figure is made, on a canvas
that are separate: no window, no state of pyplot's. All other pictures are SVG.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, PointCloud, Pole, every_nth
from ..base.errors import MissingExtraError
from ..base.palette import BLUE as BLUE
from ..base.palette import COLORS as COLORS
from ..base.palette import GREEN as GREEN
from ..base.palette import GREY as GREY
from ..base.palette import ORANGE as ORANGE
from ..base.palette import RED as RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_FIGURE_POINTS = 40_000
"""Points of a cloud that are drawn."""

SCENE_HALF_WIDTH = 14.0
"""Half the width of the picture of a pair, metres."""

AROUND = 12.0
"""The picture of a site shows this much around LiDARs and poles, metres: the ground and walls."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure, inches, that a notebook can draw even if pyplot was not imported.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("figures", "drawing pictures") from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)

    def png() -> bytes:
        written = io.BytesIO()
        figure.savefig(written, format="png")
        return written.getvalue()

    setattr(figure, "_repr_png_", png)  # noqa: B010
    return figure


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
        Clouds, each in the frame of its LiDAR.
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
        If matplotlib is not installed.
    """
    count = max(len(poles[0]), 1)
    figure = new_figure(16, 9)
    grid: Any = figure.add_gridspec(
        2, 2 + count, width_ratios=[3, 3] + [1.1] * count, height_ratios=(3, 1)
    )
    views = (
        (np.eye(4), "before: each in its frame"),
        (T_target_source, "after: source in the frame of the target"),
    )
    at = [pole.point for pole in poles[0]]
    middle = np.mean(at, axis=0) if at else target.origin
    for column, (T, title) in enumerate(views):
        above = figure.add_subplot(grid[0, column])
        lower = figure.add_subplot(grid[1, column], sharex=above)
        clouds = [
            _Drawn(target.xyz, "target", BLUE),
            _Drawn(source.transformed(T).xyz, "source", ORANGE),
        ]
        if column == 1 and contradicting is not None:
            joined = np.concatenate([contradicting[0], se3.apply(T, contradicting[1])])
            clouds.append(_Drawn(joined, "contradicts the answer", RED, 9.0, "s"))
        _draw(above, lower, clouds, at, "poles of the target", middle, SCENE_HALF_WIDTH)
        above.set_title(f"{title}\nfrom above")
        lower.set_xlabel("x of the target, m")
        if column == 0:
            above.set_ylabel("y of the target, m")
            lower.set_ylabel("z of the target, m")
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


def site_figure(
    names: Sequence[str],
    poses: Sequence[Array],
    clouds: Sequence[Array],
    poles: Sequence[Array],
    frame: str,
) -> Figure:
    """Draw a site from above and from the side, in its frame.

    Parameters
    ----------
    names, poses
        Of each LiDAR; (4, 4) maps its points into the frame of the site.
    clouds
        Of each LiDAR (N, 3), what it recorded, in its frame; of no point where that is not at
        hand.
    poles
        (3,) each, in the frame of the site.
    frame
        What that is called.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    figure = new_figure(11, 11)
    grid: Any = figure.add_gridspec(2, 1, height_ratios=(4, 1))
    above = figure.add_subplot(grid[0, 0])
    lower = figure.add_subplot(grid[1, 0], sharex=above)
    places = np.array([T[:3, 3] for T in poses])
    corners = np.concatenate([places, np.reshape(poles, (-1, 3))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    drawn = [
        _Drawn(se3.apply(T, xyz), name, COLORS[k % len(COLORS)])
        for k, (name, T, xyz) in enumerate(zip(names, poses, clouds, strict=True))
    ]
    half_width = float((high - low)[:2].max()) / 2 + AROUND
    _draw(above, lower, drawn, poles, "poles", (low + high) / 2, half_width)
    for cloud, at in zip(drawn, places, strict=True):
        for axes, vertical in ((above, 1), (lower, 2)):
            axes.plot(at[0], at[vertical], "^", ms=11, mfc=cloud.color, mec="white", mew=1.5)
        above.annotate(
            cloud.name,
            (float(at[0]), float(at[1])),
            xytext=(9, 6),
            textcoords="offset points",
            weight="bold",
            bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.0},
            # A name with dollar signs is not a formula.
            parse_math=False,
        )
    above.set_title(f"all LiDARs in one frame: {frame}\nfrom above", parse_math=False)
    above.set_ylabel("y, m")
    lower.set_ylabel("z, m")
    lower.set_xlabel("x, m")
    return figure


class _Drawn(NamedTuple):
    """Points (N, 3) to draw in the frame of the picture, and how."""

    xyz: Array
    name: str
    color: str
    size: float = 0.6
    marker: str = "o"


def _draw(
    above: Axes,
    beside: Axes,
    clouds: Sequence[_Drawn],
    poles: Sequence[Array],
    label: str,
    middle: Array,
    half_width: float,
) -> None:
    """Draw what is in a square about a middle (3,) from above and from the side, and poles (3,)."""
    for cloud in clouds:
        near = cloud.xyz[np.abs(cloud.xyz - middle).max(axis=1) < half_width]
        xyz = every_nth(near, MAX_FIGURE_POINTS)
        style: dict[str, Any] = {"s": cloud.size, "c": cloud.color, "marker": cloud.marker}
        style |= {"linewidths": 0, "rasterized": True}
        # Of what is often not there, the legend gives no information then.
        name = cloud.name if len(xyz) or cloud.size < 1 else None
        above.scatter(xyz[:, 0], xyz[:, 1], label=name, **style)
        beside.scatter(xyz[:, 0], xyz[:, 2], **style)
    for k, at in enumerate(poles):
        mark: dict[str, Any] = {"ms": 12, "mfc": "none", "mec": GREEN, "mew": 2}
        above.plot(*at[:2], "o", label=label if k == 0 else None, **mark)
        beside.plot(*at[[0, 2]], "o", **mark)
    (x, y), half = middle[:2], half_width
    above.set_xlim(x - half, x + half)
    above.set_ylim(y - half, y + half)
    above.set_aspect("equal")
    beside.set_title("from the side, heights stretched", fontsize=10)
    legend: Any = above.legend(loc="upper right", fontsize=9)
    for handle in legend.legend_handles[: len(clouds)]:
        if hasattr(handle, "set_sizes"):
            # Large enough to distinguish the colours.
            handle.set_sizes([60.0])
