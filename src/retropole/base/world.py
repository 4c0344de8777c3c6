"""From the frame of a site to the world: projected coordinates, latitude and longitude, headings.

An adjustment uses metres on the ground; the coordinates of a projected system do not. At the
central meridian of a UTM zone 30 m on the ground are 29.988 m in the grid, and everywhere else in
the zone its north is not true north. So a survey in a projected system is taken to an
east-north-up frame that touches the earth in the middle of it (`in_metres`), the adjustment runs
there, and what it found is taken back (`to_frame`, `pose_in_frame`).

What the coordinates of a site are follows from its `Frame`:

===============  ==============  ===================================================================
``Frame.epsg``   ``.geodetic``   coordinates of the site, plus ``Frame.offset``
===============  ==============  ===================================================================
None             None            those of the frame; where that is on the earth is not known
None             given           east, north, up on WGS 84 at that origin
a code           given           east, north, up at that origin, on the ellipsoid of the code's
                                 datum; the coordinates of the frame are projected
a code           None            projected coordinates themselves
===============  ==============  ===================================================================

Projected coordinates are always given east, north, height, whatever order the register has. A
height is taken for one above the ellipsoid. One above sea level, some 50 m less or more, goes
through as it came: it shifts distances by 8 mm in a kilometre, and says another height to who
takes it for ellipsoidal.

Projected systems need PROJ, by the extra ``world``; all else is in closed form.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec import structs

from . import se3
from .datatypes import Array
from .description import Frame, Geodetic, Site
from .errors import UsageError
from .projection import (
    enu_axes,
    geodetic_of_local,
    grid_at,
    local_of,
    project,
    projected,
    unproject,
)

LEVEL = np.sin(np.radians(1.0))
"""Sine of the least angle to the vertical at which an axis has a heading."""


class OnWgs84(NamedTuple):
    """Places on WGS 84, and how they came there.

    Attributes
    ----------
    geodetic
        (N, 3) latitude, longitude, rad, and the height as it was, metres.
    datum
        The step from the site's datum to WGS 84, in words; empty if there is none.
    accuracy
        Of that step, metres, as the register states it; None if it does not.
    """

    geodetic: Array
    datum: str
    accuracy: float | None


def tangent_frame(epsg: int, coordinates: Array) -> Frame:
    """Choose the metric frame for the adjustment of a survey in a projected system.

    Parameters
    ----------
    epsg
        Code of the projected system.
    coordinates
        (N, 3) east, north, height of surveyed points, metres.

    Returns
    -------
    Frame
        East, north, up at the middle of the points, rounded to whole metres; `Frame.epsg` says
        where it came from, and its offset is zero. Surveyed coordinates get there by `to_site`.

    Raises
    ------
    MissingExtraError, UsageError
        As `projected`; or if the points are outside of the area of use of the system.
    """
    system = projected(epsg)
    middle = np.asarray(coordinates, dtype=float).mean(axis=0, keepdims=True)
    (origin,) = unproject(system, np.round(middle))
    at = ", ".join(f"{np.degrees(angle):.6f}" for angle in origin[:2])
    return Frame(
        f"ENU at {at} ({system.name})",
        surveyed=True,
        epsg=epsg,
        geodetic=Geodetic(*origin.tolist()),
    )


def to_site(frame: Frame, coordinates: Array) -> Array:
    """Convert coordinates of the frame, as surveyed, to those of the site (N, 3), metres.

    Raises
    ------
    MissingExtraError, UsageError
        As `tangent_frame`.
    """
    full = np.asarray(coordinates, dtype=float)
    if frame.epsg is not None and frame.geodetic is not None:
        system = projected(frame.epsg)
        full = local_of(unproject(system, full), _origin(frame), system.ellipsoid)
    return np.asarray(full - frame.offset)


def in_metres(site: Site) -> Site:
    """Convert a site that was surveyed in a projected system to its metric frame (`tangent_frame`).

    What LiDARs measure is as it was. A site in any other frame is metric already, and stays.

    Raises
    ------
    MissingExtraError, UsageError
        As `tangent_frame`.
    """
    frame = site.frame
    ends = [end for pole in site.poles for end in (pole.foot, pole.top) if end is not None]
    places = [*ends, *(point.at for point in site.points)]
    if frame.epsg is None or frame.geodetic is not None or not places:
        return site
    metric = tangent_frame(frame.epsg, np.array(places) + frame.offset)

    def moved(place: Array) -> Array:
        return np.asarray(to_site(metric, (place + frame.offset)[None])[0])

    return replace(
        site,
        frame=metric,
        poles=tuple(
            structs.replace(
                pole,
                foot=None if pole.foot is None else moved(pole.foot),
                top=None if pole.top is None else moved(pole.top),
            )
            for pole in site.poles
        ),
        points=tuple(structs.replace(point, at=moved(point.at)) for point in site.points),
    )


def to_frame(frame: Frame, xyz: Array) -> Array:
    """Convert places of the site (N, 3) to the coordinates of the frame, metres: the inverse of
    `to_site`."""
    full = np.asarray(xyz, dtype=float) + frame.offset
    if frame.epsg is None or frame.geodetic is None:
        return np.asarray(full)
    system = projected(frame.epsg)
    return project(system, geodetic_of_local(full, _origin(frame), system.ellipsoid))


def geodetic(frame: Frame, xyz: Array) -> Array:
    """Latitude, longitude, rad, and height, metres (N, 3) of places of the site.

    On the datum of the frame's projected system, else on WGS 84.

    Raises
    ------
    UsageError
        If nothing ties the frame to the earth.
    MissingExtraError
        If a projected system needs pyproj.
    """
    if frame.epsg is None and frame.geodetic is None:
        raise UsageError(
            f"the frame of the site ({frame.name}) has no known position on the earth: give its "
            "EPSG code, or latitude, longitude and height of its origin"
        )
    full = np.asarray(xyz, dtype=float) + frame.offset
    if frame.epsg is None:
        return geodetic_of_local(full, _origin(frame))
    system = projected(frame.epsg)
    if frame.geodetic is None:
        return unproject(system, full)
    return geodetic_of_local(full, _origin(frame), system.ellipsoid)


def on_wgs84(frame: Frame, xyz: Array) -> OnWgs84:
    """Latitude, longitude and height of places of the site (N, 3), on WGS 84.

    From another datum by the best operation that PROJ has the data for. None are fetched, unless
    PROJ itself is set up to (``PROJ_NETWORK``).

    Raises
    ------
    MissingExtraError, UsageError
        As `geodetic`.
    """
    if frame.epsg is None:
        return OnWgs84(geodetic(frame, xyz), "", None)
    system = projected(frame.epsg)
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    full = to_frame(frame, xyz)
    step = Transformer.from_crs(system.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = step.transform(full[:, 0], full[:, 1])
    if not np.isfinite([longitude, latitude]).all():
        raise UsageError(f"PROJ has no transformation from {system.name} to WGS 84 there")
    moved = np.column_stack([np.radians(latitude), np.radians(longitude), full[:, 2]])
    with suppress(ProjError):
        # Of several operations, the one for this place.
        step = step.get_last_used_operation()
    accuracy = float(step.accuracy)
    return OnWgs84(moved, str(step.description), accuracy if accuracy >= 0 else None)


def in_projected(frame: Frame, xyz: Array, epsg: int) -> Array:
    """Convert places of the site (N, 3) to another projected system: east, north, unchanged height.

    By the best operation from datum to datum that PROJ has the data for, as `on_wgs84`.

    Raises
    ------
    MissingExtraError, UsageError
        As `geodetic`, and where PROJ has no way.
    """
    start, to = frame.epsg, projected(epsg)
    if start is None:
        at, crs = np.degrees(geodetic(frame, xyz)), "EPSG:4326"
        east, north, height = at[:, 1], at[:, 0], at[:, 2]
    else:
        (east, north, height), crs = to_frame(frame, xyz).T, projected(start).crs
    from pyproj import Transformer

    moved = Transformer.from_crs(crs, to.crs, always_xy=True).transform(east, north)
    if not np.isfinite(moved).all():
        raise UsageError(f"PROJ has no transformation from {frame.name} to {to.name} there")
    return np.column_stack([*moved, height])


def pose_in_frame(frame: Frame, T_site_lidar: Array) -> Array:
    """Pose of a LiDAR (4, 4) in the coordinates of the frame, its axes east, north, up there.

    In a projected system the position is exact, and headings are from grid north. A point that the
    LiDAR sees is then off by the scale of the grid: 12 mm at 30 m where it is 0.9996.
    """
    place = T_site_lidar[:3, 3]
    (full,) = to_frame(frame, place[None])
    return se3.from_rt(_axes_at(frame, place) @ T_site_lidar[:3, :3], full)


def site_in_frame(frame: Frame) -> Array:
    """Pose of the axes of the site (4, 4) in the frame's coordinates: rigid, with its true lengths.

    At the origin of the site's coordinates it agrees with `pose_in_frame`. Away from it, it differs
    by the scale of the grid.
    """
    return pose_in_frame(frame, np.eye(4))


def heading(frame: Frame, T_site_lidar: Array, *, of_grid: bool = False) -> float | None:
    """Azimuth of a LiDAR's x axis, rad, clockwise from true north, or from grid north.

    None if the axis is within 1° of the vertical, and where the frame's north is not known.
    """
    if frame.epsg is None and frame.geodetic is None:
        return None
    axes = _axes_at(frame, T_site_lidar[:3, 3])
    east, north, _ = axes @ T_site_lidar[:3, 0]
    if np.hypot(east, north) < LEVEL:
        return None
    azimuth = np.arctan2(east, north)
    if frame.epsg is not None and not of_grid:
        (at,) = geodetic(frame, T_site_lidar[None, :3, 3])
        azimuth += grid_at(frame.epsg, at).convergence
    return float(azimuth % (2 * np.pi))


def _origin(frame: Frame) -> Array:
    """Latitude, longitude and height of the origin, compared with what they can be."""
    assert frame.geodetic is not None
    at = frame.geodetic.array
    if not (np.isfinite(at).all() and abs(at[0]) <= np.pi / 2 and abs(at[1]) <= 2 * np.pi):
        raise UsageError(
            f"latitude and longitude {np.degrees(at[:2])} deg are outside the valid range"
        )
    return at


def _axes_at(frame: Frame, place: Array) -> Array:
    """Rotation from the site's axes to those of its frame's coordinates at a place."""
    if frame.epsg is None or frame.geodetic is None:
        return np.eye(3)
    (at,) = geodetic(frame, place[None])
    origin = _origin(frame)
    here = enu_axes(at[0], at[1]).T @ enu_axes(origin[0], origin[1])
    turn = grid_at(frame.epsg, at).convergence
    return np.asarray(se3.exp_so3(np.array([0.0, 0.0, turn])) @ here)
