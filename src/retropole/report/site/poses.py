"""The pose of every LiDAR: to read, to copy, how certain it is, and what its error is made of."""

from __future__ import annotations

from html import escape

import numpy as np

from ...base import se3
from ...base.errors import RetropoleError
from ...base.quantities import error
from ...export import export_lines
from ...result.site import LidarDoc, SiteDoc
from ..markup import MISSING, number, table
from ..sections import pose_parts, to_copy, transform_matrix
from ..uncertainty import BUDGET_NOTE, budget_table
from .svg import colour_class
from .verdict import far_error

COPIED = ("matrix", "quaternion", "ros2")
"""Formats of each pose that can be copied."""

STATES = tuple(
    f"{kind} {axis}" for kind in ("rotation about", "translation along") for axis in "xyz"
)
"""The six directions of a covariance, in its order."""


def poses(document: SiteDoc) -> str:
    """Show the poses of all LiDARs: a summary, and each unfolded."""
    if document.status == "refused":
        return ""
    rows: list[tuple[object, ...]] = []
    asked = any(lidar.fitness is not None for lidar in document.lidars)
    for lidar in document.lidars:
        T = np.array(lidar.T_site_lidar)
        angles = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
        rows.append(
            (
                lidar.name,
                *(number(round(float(v), 4) + 0.0, 4) for v in T[:3, 3]),
                *(number(round(float(v), 3) + 0.0, 3) for v in angles),
                error(far_error(lidar)),
                *([MISSING if lidar.fitness is None else lidar.fitness.answer] if asked else []),
            )
        )
    header = (
        *("LiDAR", "x, m", "y, m", "z, m", "roll, deg", "pitch, deg", "yaw, deg"),
        *("1 σ at 30 m", *(["good enough"] if asked else [])),
    )
    unfolded = "".join(_lidar(document, k) for k in range(len(document.lidars)))
    return (
        '<section aria-labelledby="poses"><h2 id="poses">Poses</h2>'
        "<p><code>T_site_lidar</code> maps points of a LiDAR into the frame of the site: "
        "<i>p</i><sub>site</sub> = <i>T</i> <i>p</i><sub>lidar</sub>. Roll, pitch and yaw are "
        f"rotations about the fixed axes x, then y, then z. Frame: {escape(document.frame.name)}. "
        f"{_offset(document)}</p>"
        + table("Poses of all LiDARs", header, rows)
        + f'<div class="lidars">{unfolded}</div>'
        + (BUDGET_NOTE if any(lidar.budget for lidar in document.lidars) else "")
        + "</section>"
    )


def _offset(document: SiteDoc) -> str:
    """Say what to add to get the frame's own coordinates."""
    if not any(document.frame.offset):
        return ""
    x, y, z = (f"{value:.3f}" for value in document.frame.offset)
    return f"Add ({x}, {y}, {z}) m for the frame's own coordinates."


def _lidar(document: SiteDoc, k: int) -> str:
    lidar = document.lidars[k]
    T = np.array(lidar.T_site_lidar)
    said = ", ".join(
        each
        for each in (
            "" if lidar.sensor == "auto" else lidar.sensor,
            f"serial number {lidar.serial}" if lidar.serial else "",
            "" if lidar.fitness is None else lidar.fitness.words,
        )
        if each
    )
    return (
        f'<details class="lidar"><summary><i class="dot {colour_class(k)}" aria-hidden="true"></i>'
        f"{escape(lidar.name)}</summary>"
        + (f"<p>{escape(said)}</p>" if said else "")
        + f'<div class="columns">{transform_matrix(T, f"T_site_lidar of {lidar.name}")}'
        f"{pose_parts(T)}{_certainty(lidar)}</div>"
        f'<div class="to-copy">{_copies(document, k)}</div>'
        + (budget_table(lidar.budget, whose=False) if lidar.budget else "")
        + "</details>"
    )


def _certainty(lidar: LidarDoc) -> str:
    """Say how certain the pose is, by state and by range."""
    sigma = np.sqrt(np.maximum(np.diag(np.array(lidar.covariance)), 0.0)).tolist()
    if not any(sigma):
        return "<p>Its frame is that of the site: its pose has no error.</p>"
    states = [
        (name, error(value, "rad" if i < 3 else "m"))
        for i, (name, value) in enumerate(zip(STATES, sigma, strict=True))
    ]
    ranges = [(f"{e.range_m:g} m", error(e.sigma_m)) for e in lidar.predicted_error or []]
    at_range = f"A point of {lidar.name} in the site"
    return table(f"Pose of {lidar.name}, axes of the site", ("state", "1 σ"), states) + (
        table(at_range, ("at range", "1 σ"), ranges) if ranges else ""
    )


def _copies(document: SiteDoc, k: int) -> str:
    T = np.array(document.lidars[k].T_site_lidar)
    names = [lidar.name for lidar in document.lidars]
    parent = "site" if "site" not in names else "site_frame"
    try:
        lines = export_lines(T, parent, names[k])
    except RetropoleError:
        # A name that no frame can have: another program reads the pose all the same.
        lines = export_lines(T, parent, f"lidar_{k}")
    return "".join(to_copy(key, lines[key], f" of {names[k]}") for key in COPIED)
