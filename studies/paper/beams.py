"""Fig. 5: the beams of a tilted LiDAR drawn to the pole."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import find_sensor
from studies.paper.arc_walk import cast_cone
from studies.paper.exhibit import Cell, Exhibit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_POSE = np.array([0.306, 0.177, 0.306, 0.884])
"""Orientation of the LiDAR in the figure, quaternion x y z w, normalised where it is used."""

DISTANCE, RADIUS = 2.0, 0.3
"""Of LiDAR and pole, metres: the paper gives none; near and thick, so that beams stand apart."""

DRAWN_STEP = 12
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
        "Fig. 5: beams of a VLP-16 with q = (0.884, 0.306, 0.177, 0.306) on the pole",
        ("ring deg", "points", "least θ deg", "most", "least z m", "most"),
        tuple(rows),
        f"x_p = {DISTANCE:g} m and r = {RADIUS:g} m, which the paper does not state; q is w first. "
        "Beams are cast on their cones. Each colour is a ring; every twelfth beam is drawn, and in "
        "perspective every point. The LiDAR sees the pole for θ within ± arccos(r/x_p), "
        f"± {_widest():.2f}°.",
        lambda figure: _draw(figure, rings),
        (11.0, 6.2),
    )


def _widest() -> float:
    return float(np.degrees(np.arccos(RADIUS / DISTANCE)))


def _draw(figure: Figure, rings: list[Array]) -> None:
    """Draw the beams in perspective, from above, and from above near the pole."""
    from matplotlib import colormaps

    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(rings)))
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.25), height_ratios=(1, 1.6))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d", computed_zorder=False)
    views = [figure.add_subplot(grid[row, 1]) for row in (0, 1)]
    heights = np.array([-0.1, max(points[:, 2].max() for points in rings if len(points)) + 0.1])
    angle = np.linspace(0, 2 * np.pi, 73)
    x, y = (np.tile(RADIUS * f(angle), (2, 1)) for f in (np.cos, np.sin))
    z = np.repeat(heights[:, None], len(angle), axis=1)
    space.plot_surface(x, y, z, color="#d5d9dc", alpha=0.5, linewidth=0, zorder=1)
    for above in views:
        above.fill(x[0], y[0], color="#e3e6e8", ec="#9aa0a6")
    for k, (points, color) in enumerate(zip(rings, colors, strict=True)):
        # Rings lie above each other: each draws other beams than its neighbours, so that all
        # colours are seen from above.
        for end in points[(5 * k) % DRAWN_STEP :: DRAWN_STEP]:
            line = np.stack([[DISTANCE, 0.0, 0.0], end])
            space.plot(*line.T, color=color, lw=0.6, alpha=0.8, zorder=2)
            for above in views:
                above.plot(line[:, 0], line[:, 1], color=color, lw=0.7, alpha=0.8)
                above.plot(*end[:2], ".", color=color, ms=5)
        space.plot(*points.T, ".", color=color, ms=2.5, zorder=3)
    _label(space, views)


def _label(space: Any, views: list[Any]) -> None:
    """Name the LiDAR and the axes, and choose what is seen."""
    space.plot([DISTANCE], [0.0], [0.0], "k^", ms=8, zorder=4)
    space.text(DISTANCE, 0.0, -0.3, "LiDAR", ha="center")
    space.set(xlabel="x, m", ylabel="y, m", zlabel="z, m", title="perspective")
    space.set(yticks=[-RADIUS, RADIUS], xticks=[0, 1, 2], zticks=[0, 1, 2])
    space.set_aspect("equal")
    space.view_init(elev=14, azim=-38)
    whole, near = views
    whole.plot(DISTANCE, 0.0, "k^", ms=8)
    whole.annotate("LiDAR", (DISTANCE, 0.0), (0, 9), textcoords="offset points", ha="center")
    whole.set(title="from above", ylabel="y, m", xlim=(-0.35, 2.15), ylim=(-0.36, 0.36))
    near.set(xlabel="x, m", ylabel="y, m", xlim=(-0.32, 0.75), ylim=(-0.33, 0.33))
    for view in views:
        view.set_aspect("equal")
