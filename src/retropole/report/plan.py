"""The site laid level, so that it can be seen from above, whatever frame it is given in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.datatypes import Array
from ..result.site import SiteDoc


@dataclass(frozen=True, eq=False)
class Plan:
    """How the site is turned for its pictures.

    Attributes
    ----------
    R_plan_site
        (3, 3) turns the site's axes so that z points up.
    up
        What was taken for up.
    north
        What the y axis points to, ``north`` or ``grid north``; None if nobody knows.
    """

    R_plan_site: Array
    up: str
    north: str | None


def plan_of(document: SiteDoc) -> Plan:
    """Lay a site level: by its surveyed frame, by an inertial sensor, or its poles or walk."""
    frame = document.frame
    if frame.surveyed or frame.epsg is not None or frame.geodetic is not None:
        north = "north" if frame.geodetic is not None else None
        north = "grid north" if frame.epsg is not None else north
        return Plan(np.eye(3), "the z axis of the surveyed frame", north)
    for lidar in document.lidars:
        if lidar.up is not None and lidar.T_site_lidar is not None:
            up = np.array(lidar.T_site_lidar)[:3, :3] @ lidar.up.direction
            return Plan(
                turning(up), f"the direction from the inertial sensor of {lidar.name}", None
            )
    if document.walk is not None:
        return Plan(turning(document.walk.up), "the mean direction of the pole", None)
    if not document.poles:
        return Plan(np.eye(3), "the z axis of the site's frame", None)
    return Plan(turning(_along_poles(document)), "the mean direction of the poles", None)


def _along_poles(document: SiteDoc) -> Array:
    """Mean direction of the poles, upwards as most LiDARs have their z axis."""
    axes = np.array([pole.direction for pole in document.poles])
    # The sign of a direction means nothing: the longest axis of them all has none to begin with.
    along = np.linalg.eigh(axes.T @ axes)[1][:, -1]
    upright = [np.array(each.T_site_lidar)[:3, 2] @ along for each in document.lidars]
    return np.asarray(along if np.sum(np.sign(upright)) >= 0 else -along)


def turning(up: Array) -> Array:
    """Turn a direction (3,) into z, on the shortest way."""
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    cosine = float(up[2])
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
