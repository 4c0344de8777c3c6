"""Clouds of one frame from above and from the side, each of a colour, with the poles among them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...base.datatypes import Array, every_nth
from .canvas import GREEN, MAX_FIGURE_POINTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Drawn(NamedTuple):
    """A cloud to draw: its points (N, 3) in the frame of the picture, its name and its colour."""

    xyz: Array
    name: str
    color: str


class View(NamedTuple):
    """What a picture shows: a square about a middle (3,), its half width in metres."""

    middle: Array
    half_width: float

    def near(self, xyz: Array) -> Array:
        """Keep of points (N, 3) those that are in the picture."""
        return np.asarray(xyz[np.abs(xyz - self.middle).max(axis=1) < self.half_width])


def draw_clouds(
    above: Axes,
    beside: Axes,
    clouds: Sequence[Drawn],
    poles: Sequence[Array],
    label: str,
    view: View,
) -> None:
    """Draw clouds from above and from the side, and where poles are, (3,) each, under a label."""
    for cloud in clouds:
        xyz = every_nth(view.near(cloud.xyz), MAX_FIGURE_POINTS)
        style: dict[str, Any] = {"s": 0.6, "c": cloud.color, "linewidths": 0, "rasterized": True}
        above.scatter(xyz[:, 0], xyz[:, 1], label=cloud.name, **style)
        beside.scatter(xyz[:, 0], xyz[:, 2], **style)
    for k, at in enumerate(poles):
        mark: dict[str, Any] = {"ms": 12, "mfc": "none", "mec": GREEN, "mew": 2}
        above.plot(*at[:2], "o", label=label if k == 0 else None, **mark)
        beside.plot(*at[[0, 2]], "o", **mark)
    (x, y), half = view.middle[:2], view.half_width
    above.set_xlim(x - half, x + half)
    above.set_ylim(y - half, y + half)
    above.set_aspect("equal")
    beside.set_title("from the side, heights stretched", fontsize=10)


def draw_legend(axes: Axes, clouds: int) -> None:
    """Add a legend in which the points of so many clouds are large enough to tell their colours."""
    legend: Any = axes.legend(loc="upper right", fontsize=9)
    for handle in legend.legend_handles[:clouds]:
        handle.set_sizes([60.0])
