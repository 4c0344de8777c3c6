"""Equations 3 and 4 and section IV-A, each as written beside the exact ray casting."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import find_sensor
from retropole.simulation.raycast import Cylinder, Material, cast
from studies.paper.arc_walk import (
    ENDLESS_POLE,
    MiddleBeam,
    cast_cone,
    cast_plane,
    middle_beam,
    walk_arc,
)
from studies.paper.exhibit import Cell, Exhibit
from studies.paper.line_bias import PAPER_ORIENTATIONS, PAPER_TABLE_II
from studies.paper.pole_frame import in_pole_frame, turn_onto_x, turn_upright

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LISTED = (10.0, 0.1)
"""Distance and radius, metres, of the points that are listed: few of each ring hit the pole."""

LISTED_ELEVATIONS = (0.0, 15.0)
"""Degrees: the middle, where beam plane and cone coincide, and the edge of a VLP-16."""

DRAWN = (4.0, 0.3)
"""Distance and radius, metres, of the drawing: many points and the widest view of the pole."""

FRAMES = {
    "leaning": ((0.3, -0.2, 0.93), (1.0, 2.0, 0.3), (-2.0, 0.5, 0.8)),
    "n = e_z": ((0.0, 0.0, 1.0), (1.0, 2.0, 0.3), (-2.0, 0.5, 0.8)),
    "n near e_z": ((1e-9, -2e-9, 1.0), (1.0, 2.0, 0.3), (-2.0, 0.5, 0.8)),
    "n = −e_z": ((0.0, 0.0, -1.0), (1.0, 2.0, 0.3), (-2.0, 0.5, 0.8)),
    "v on −x": ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (-3.0, 0.0, 0.5)),
    "v near −x": ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (-3.0, 1e-9, 0.5)),
    "v on +x": ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (3.0, 0.0, 0.5)),
}
"""Direction and point of a pole and position of the LiDAR, metres: general, and at and near the
places where a or b of section IV-A is 0/0."""

FRAME_RADIUS = 0.1
"""Of the pole, metres."""


def arc_points() -> Exhibit:
    """List the points of two rings by the walk and by both castings."""
    distance, radius = LISTED
    step = find_sensor("VLP-16").azimuth_step
    rows: list[tuple[Cell, ...]] = []
    for elevation in np.radians(LISTED_ELEVATIONS):
        middle = _middle(np.eye(3), elevation)
        walked = walk_arc(distance, radius, middle, step)
        plane = cast_plane(distance, radius, middle, step)
        cone = cast_cone(distance, radius, np.eye(3), elevation, step)
        for at, same, exact in zip(walked, plane, cone, strict=True):
            rows.append(
                (
                    round(float(np.degrees(elevation))),
                    f"{np.degrees(np.arctan2(at[1], at[0])):.4f}",
                    *(f"{value:.6f}" for value in (*at, *exact)),
                    float(np.linalg.norm(at - same)),
                    float(np.linalg.norm(at - exact)),
                )
            )
    return Exhibit(
        "eq3_4_points",
        "Equations 3 and 4: points of two rings walked along the arc, and cast",
        (
            *("ring deg", "θ deg", "walked x m", "y m", "z m", "cast x m", "y m", "z m"),
            *("walk to its own plane cast m", "walk to cone m"),
        ),
        tuple(rows),
        f"VLP-16, x_p = {distance:g} m, r = {radius:g} m, q2 = identity, a beam at θ = 0. The "
        "walk takes the beams of a ring for a plane; they lie on a cone, except at elevation 0.",
    )


def arc_walk() -> Exhibit:
    """Walk along every arc of Table II and compare its points with those cast."""
    sensor = find_sensor("VLP-16")
    rows: list[tuple[Cell, ...]] = []
    for distance, radius in PAPER_TABLE_II:
        for name, quaternion in PAPER_ORIENTATIONS.items():
            rotation = se3.from_quaternion_xyzw(quaternion, np.zeros(3))[:3, :3]
            level = _compared(distance, radius, rotation, 0.0)
            rings = [_compared(distance, radius, rotation, e) for e in sensor.elevations]
            counts = np.sum([ring[:2] for ring in rings], axis=0)
            own, cone = np.max([ring[2:] for ring in rings], axis=0)
            rows.append(
                (
                    *(distance, radius, name),
                    *(int(counts[0]), int(counts[1]), float(own), float(cone), float(level[3])),
                )
            )
    return Exhibit(
        "eq3_4_arc_walk",
        "Equations 3 and 4: largest difference of the walk from exact casting, VLP-16",
        (
            *("x_p m", "r m", "orientation", "points walked", "points on the cone"),
            *("walk to its own plane cast m", "walk to cone m", "to cone at elevation 0 m"),
        ),
        tuple(rows),
        "dθ of eq. 4 by a trust-region (dogleg) solver, from θ = 0 to both ends of the arc. The "
        "plane of eq. 3 is taken through the beam at θ = 0 along the direction in which the ring "
        "turns there. Points are compared with their partners in the order from θ = 0; those "
        "without a partner drop out. The angle c "
        "between neighbours is an angle in the plane, but a step of azimuth on the cone, so a ring "
        "off the middle has no more points on its plane than on its cone, and none but the one at "
        "θ = 0 is the same.",
        _draw_arcs,
        (12.0, 4.4),
    )


def transforms() -> Exhibit:
    """Move poles to the LiDAR–pole model and back, and compare with casting where they stand."""
    rows: list[tuple[Cell, ...]] = []
    for name, (direction, point, position) in FRAMES.items():
        n = np.array(direction) / np.linalg.norm(direction)
        pose = se3.from_rt(np.eye(3), np.array(position))
        frame = in_pole_frame(pose, np.array(point), n)
        upright, onto_x = turn_upright(n), turn_onto_x(frame.L_star[:3, 3])
        there, back = both_casts(pose, np.array(point), n, FRAME_RADIUS)
        v = frame.L_star[:3, 3]
        rows.append(
            (
                name,
                *(float(np.linalg.det(turn)) for turn in (upright, onto_x)),
                float(np.linalg.norm(upright @ n + [0, 0, 1])),
                float(np.linalg.norm(onto_x @ v - [np.linalg.norm(v), 0, 0])),
                len(there),
                float(np.abs(there - back).max()),
            )
        )
    return Exhibit(
        "sec4a_transforms",
        "Section IV-A: the transforms A, R, L* and L̂, VLP-16",
        (
            *("case", "det A", "det R", "‖A n + e_z‖", "‖R v − ‖v‖ e_x‖ m", "points"),
            "largest difference m",
        ),
        tuple(rows),
        "Points cast in the frame of the model from L̂ and moved back, against points cast where "
        "pole and LiDAR stand. A is a half-turn that maps n to −e_z, which stands a pole upright "
        "too; R turns it back. At n = e_z any level a serves and e_x is taken; for v on −x the "
        "limit of b is e_y.",
    )


def both_casts(pose: Array, point: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    """Points (N, 3) of a VLP-16 on a pole, cast where it stands, and by section IV-A."""
    sensor = find_sensor("VLP-16")
    azimuth = np.arange(round(2 * np.pi / sensor.azimuth_step)) * sensor.azimuth_step
    azimuth, elevation = (a.ravel() for a in np.meshgrid(azimuth, sensor.elevations))
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    frame = in_pole_frame(pose, point, direction)
    found = []
    for at, centre, axis in (
        (pose, point, direction),
        (frame.L_hat, np.zeros(3), np.array([0.0, 0.0, 1.0])),
    ):
        pole = Cylinder(centre, axis, radius, ENDLESS_POLE, Material())
        turned = rays @ at[:3, :3].T
        ranges = cast(at[:3, 3], turned, [pole]).ranges
        hit = np.isfinite(ranges)
        found.append(at[:3, 3] + ranges[hit, None] * turned[hit])
    return found[0], se3.apply(se3.inverse(frame.T_pole_world), found[1])


def _middle(rotation: Array, elevation: float) -> MiddleBeam:
    middle = middle_beam(rotation, elevation)
    if middle is None:
        raise ValueError(f"no beam of elevation {elevation:.3f} rad reaches the axis of the pole")
    return middle


def _compared(
    distance: float, radius: float, rotation: Array, elevation: float
) -> tuple[int, int, float, float]:
    """Count the points walked and on the cone; distances of the walk to plane and cone, metres."""
    step = find_sensor("VLP-16").azimuth_step
    middle = _middle(rotation, elevation)
    walked = walk_arc(distance, radius, middle, step)
    plane = cast_plane(distance, radius, middle, step)
    cone = cast_cone(distance, radius, rotation, elevation, step)
    own, exact = (float(_apart(walked, other).max()) for other in (plane, cone))
    return len(walked), len(cone), own, exact


def _apart(some: Array, others: Array) -> Array:
    """Distances of points (N, 3) and (M, 3) of a ring, paired outwards from θ = 0."""
    start = [int(np.argmin(np.abs(points[:, 1]))) for points in (some, others)]
    before = min(start)
    after = min(len(some) - start[0], len(others) - start[1])
    pair = [p[k - before : k + after] for p, k in zip((some, others), start, strict=True)]
    return np.asarray(np.linalg.norm(pair[0] - pair[1], axis=1))


def _draw_arcs(figure: Figure) -> None:
    """Draw a ring's arc in its plane and on its cone, and their distance over the elevation."""
    side, apart = figure.subplots(1, 2)
    distance, radius = DRAWN
    step = find_sensor("VLP-16").azimuth_step
    elevation = float(find_sensor("VLP-16").elevations.max())
    middle = _middle(np.eye(3), elevation)
    walked = walk_arc(distance, radius, middle, step)
    cone = cast_cone(distance, radius, np.eye(3), elevation, step)
    side.plot(walked[:, 1], walked[:, 2], "o", ms=5, mfc="none", color="#d55e00", label="walk")
    side.plot(cone[:, 1], cone[:, 2], ".", color="#0072b2", ms=5, label="cast on the cone")
    side.set(xlabel="y, m", ylabel="z, m", title=_title("the ring at 15°", distance, radius))
    side.legend(fontsize=9)
    _draw_apart(apart)


def _draw_apart(axes: Any) -> None:
    elevations = np.radians(np.linspace(-15, 15, 31))
    colors = {10: "#d55e00", 6: "#0072b2", 4: "#009e73"}
    for distance, color in colors.items():
        most = [_compared(distance, 0.3, np.eye(3), e)[3] for e in elevations]
        millimetres = 1e3 * np.array(most)
        axes.plot(np.degrees(elevations), millimetres, ".-", color=color, label=f"{distance} m")
    axes.set(xlabel="elevation of the ring, deg", ylabel="largest distance, mm")
    axes.set_title("walk to cone, r = 0.3 m, q2", fontsize=11)
    axes.legend(title="x_p", fontsize=9)


def _title(what: str, distance: float, radius: float) -> str:
    return f"{what}\nx_p = {distance:g} m, r = {radius:g} m, q2"
