"""Figure two_matlab: the beams of a tilted LiDAR drawn to the pole."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ... import se3
from ...datatypes import Array
from ...sensors import find_sensor
from .arc_walk import cast_cone
from .exhibit import Cell, Exhibit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_POSE = np.array([0.306, 0.177, 0.306, 0.884])
"""Orientation of the LiDAR in the figure, quaternion x y z w, normalised where it is used."""

DISTANCE, RADIUS = 2.0, 0.3
"""Of LiDAR and pole, metres: the paper gives none; near and thick, so that beams stand apart."""

DRAWN_STEP = 4
"""Steps of 0.2° between the beams drawn: all of them would cover each other."""


def two_matlab() -> Exhibit:
    """Draw the beams of each ring to the pole, in perspective and from above."""
    sensor = find_sensor("VLP-16")
    rotation = se3.from_quaternion_xyzw(PAPER_POSE, np.zeros(3))[:3, :3]
    rings = [
        cast_cone(DISTANCE, RADIUS, rotation, elevation, sensor.azimuth_step)
        for elevation in sensor.elevations
    ]
    rows: list[tuple[Cell, ...]] = []
    for elevation, points in zip(np.degrees(sensor.elevations), rings, strict=True):
        ends: list[Cell] = [None] * 4
        if len(points):
            theta = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
            z = points[:, 2]
            ends = [float(f) for f in (theta.min(), theta.max(), z.min(), z.max())]
        rows.append((round(float(elevation)), len(points), *ends))
    return Exhibit(
        "two_matlab",
        "Figure two_matlab: beams of a VLP-16 with q = (0.884, 0.306, 0.177, 0.306) on the pole",
        ("ring deg", "points", "least θ deg", "most", "least z m", "most"),
        tuple(rows),
        f"x_p = {DISTANCE:g} m and r = {RADIUS:g} m, which the paper does not state; q is w first. "
        "Beams are cast on their cones. Each colour is a ring; every fourth beam is drawn, and "
        f"every point. The pole is visible for θ within ± {_widest():.2f}°, ± arccos(r/x_p).",
        lambda figure: _draw(figure, rings),
        (13.0, 6.0),
    )


def _widest() -> float:
    return float(np.degrees(np.arccos(RADIUS / DISTANCE)))


def _draw(figure: Figure, rings: list[Array]) -> None:
    """Draw both views."""
    from matplotlib import colormaps

    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(rings)))
    sensor = np.array([DISTANCE, 0.0, 0.0])
    grid = figure.add_gridspec(1, 2, width_ratios=(1.1, 1))
    space: Any = figure.add_subplot(grid[0], projection="3d", computed_zorder=False)
    above = figure.add_subplot(grid[1])
    seen = np.concatenate([points for points in rings if len(points)])
    heights = np.array([min(seen[:, 2].min(), 0.0) - 0.1, max(seen[:, 2].max(), 0.0) + 0.1])
    angle = np.linspace(0, 2 * np.pi, 73)
    x, y = (np.tile(RADIUS * f(angle), (2, 1)) for f in (np.cos, np.sin))
    z = np.repeat(heights[:, None], len(angle), axis=1)
    space.plot_surface(x, y, z, color="#c8ccd0", alpha=0.6, linewidth=0, zorder=1)
    above.fill(x[0], y[0], color="#e3e6e8", ec="#9aa0a6")
    for points, color in zip(rings, colors, strict=True):
        if not len(points):
            continue
        middle = int(np.argmin(np.abs(points[:, 1])))
        for end in points[middle % DRAWN_STEP :: DRAWN_STEP]:
            line = np.stack([sensor, end])
            space.plot(*line.T, color=color, lw=0.5, alpha=0.7, zorder=2)
            above.plot(line[:, 0], line[:, 1], color=color, lw=0.4, alpha=0.6)
        space.plot(*points.T, ".", color=color, ms=3, zorder=3)
        above.plot(points[:, 0], points[:, 1], ".", color=color, ms=4)
    space.plot(*sensor[:, None], "k^", ms=8, zorder=4)
    space.text(DISTANCE, 0.0, 0.12, "LiDAR", ha="center")
    space.set(xlabel="x, m", ylabel="y, m", zlabel="z, m", title="perspective")
    space.set_aspect("equal")
    space.view_init(elev=18, azim=-55)
    above.plot(*sensor[:2], "k^", ms=8)
    above.annotate("LiDAR", (DISTANCE, 0.0), (0, 9), textcoords="offset points", ha="center")
    above.set(title="from above", xlabel="x, m", ylabel="y, m", ylim=(-0.6, 0.6))
    above.set_aspect("equal")
