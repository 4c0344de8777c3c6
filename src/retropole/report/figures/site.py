"""A picture of a site: every LiDAR where it stands, what each recorded, and the poles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...base import se3
from ...base.datatypes import Array
from .canvas import BLUE, ORANGE, RED, new_figure
from .clouds import Drawn, View, draw_clouds, draw_legend

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = (BLUE, ORANGE, "#cc79a7", RED, "#56b4e9", "#000000", "#b8a800", "#666666")
"""Of the LiDARs; more begin again. Green is that of the poles."""

AROUND = 12.0
"""The picture shows so much around LiDARs and poles, metres: the ground and walls of a pair."""


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
        Of each LiDAR (N, 3), what it recorded, in its own frame; of no point where that is not at
        hand.
    poles
        (3,) each, in the frame of the site.
    frame
        What that is called.

    Raises
    ------
    MissingExtraError
        Where matplotlib is not installed.
    """
    figure = new_figure(11, 11)
    grid: Any = figure.add_gridspec(2, 1, height_ratios=(4, 1))
    above = figure.add_subplot(grid[0, 0])
    beside = figure.add_subplot(grid[1, 0], sharex=above)
    places = np.array([T[:3, 3] for T in poses])
    corners = np.concatenate([places, np.reshape(poles, (-1, 3))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    view = View((low + high) / 2, float((high - low)[:2].max()) / 2 + AROUND)
    drawn = [
        Drawn(se3.apply(T, xyz), name, COLORS[k % len(COLORS)])
        for k, (name, T, xyz) in enumerate(zip(names, poses, clouds, strict=True))
    ]
    draw_clouds(above, beside, drawn, poles, "poles", view)
    for cloud, at in zip(drawn, places, strict=True):
        for axes, vertical in ((above, 1), (beside, 2)):
            axes.plot(at[0], at[vertical], "^", ms=11, mfc=cloud.color, mec="white", mew=1.5)
        above.annotate(
            cloud.name,
            (float(at[0]), float(at[1])),
            xytext=(9, 6),
            textcoords="offset points",
            weight="bold",
            bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.0},
            # A name with dollar signs is no formula.
            parse_math=False,
        )
    draw_legend(above, len(drawn))
    above.set_title(f"all LiDARs in one frame: {frame}\nfrom above", parse_math=False)
    above.set_ylabel("y, m")
    beside.set_ylabel("z, m")
    beside.set_xlabel("x, m")
    return figure
