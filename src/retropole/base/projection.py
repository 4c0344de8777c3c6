"""Projected coordinate systems by their EPSG code, and east-north-up frames on an ellipsoid.

PROJ knows the systems, and what they do to lengths and directions: by pyproj, the extra ``world``.
The ellipsoid is in closed forms in float64, which are exact to some nanometres on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .datatypes import Array
from .errors import MissingExtraError, UsageError

BEYOND_AREA = np.radians(20.0)
"""How far outside its area of use a projected system is taken: Norway uses the zone from 12° to 18°
up to 31°. Swapped east and north of UTM lie farther off."""


class Projected(NamedTuple):
    """A projected system as PROJ has it: the projection, its ellipsoid and its name."""

    proj: Any
    crs: Any
    ellipsoid: Ellipsoid
    name: str
    epsg: int


@dataclass(frozen=True)
class Grid:
    """What a projected system does to lengths and directions at a place.

    Attributes
    ----------
    name
        ``EPSG:25832, ETRS89 / UTM zone 32N``.
    scale
        Length in the grid of one metre on the ellipsoid.
    height_factor
        Length on the ellipsoid of one metre on the ground, at the height of the site.
    convergence
        True azimuth of grid north, rad: positive where it points east of true north.
    distortion
        Most by which the grid bends an angle, rad; zero for conformal systems.
    in_area
        Whether the site is in the registered area of use of the system.
    """

    name: str
    scale: float
    height_factor: float
    convergence: float
    distortion: float
    in_area: bool

    @property
    def combined(self) -> float:
        """Length in the grid of one metre on the ground."""
        return self.scale * self.height_factor

    @property
    def text(self) -> str:
        """Describe the effect on a site, in one line."""
        off = 30.0 * (self.combined - 1)
        side = "east" if self.convergence >= 0 else "west"
        text = (
            f"{self.name}: 30 m on the ground are {30.0 + off:.4f} m in the grid "
            f"({1000 * off:+.1f} mm, scale {self.scale:.7f}, for the height "
            f"{self.height_factor:.7f}), and grid north is "
            f"{np.degrees(abs(self.convergence)):.4f} deg {side} of true north"
        )
        # What rounding makes of angles, rad: 0.3 mm at 30 m.
        if self.distortion > 1e-5:
            # Scales along and across differ by sin(distortion / 2) of their mean either way.
            text += (
                f"; it is not conformal: in some directions 30 m are {15e3 * self.distortion:.1f} "
                f"mm more or less, and angles bend by up to {np.degrees(self.distortion):.3f} deg"
            )
        if not self.in_area:
            text += "; it is not intended for this region: are the coordinates right?"
        return text


@lru_cache(maxsize=8)
def projected(epsg: int) -> Projected:
    """Look up a projected system.

    Parameters
    ----------
    epsg
        Its code. Of a compound one, the horizontal part is taken; heights stay as they are.

    Raises
    ------
    MissingExtraError
        If pyproj is not installed.
    UsageError
        If there is no such code, if it is not projected, if its unit is not the metre,
        its axes are not east and north, or its longitudes not from Greenwich.
    """
    try:
        from pyproj import CRS, Proj
        from pyproj.exceptions import CRSError
    except ImportError:
        raise MissingExtraError("world", f"projected coordinates (EPSG:{epsg})") from None
    try:
        crs = CRS.from_epsg(epsg)
    except (CRSError, OverflowError):
        raise UsageError(f"EPSG:{epsg} is in no database of coordinate systems") from None
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    if not crs.is_projected:
        raise UsageError(
            f"EPSG:{epsg}, {crs.name}, is {crs.type_name}, not a projected system in metres"
        )
    axes = {axis.direction: axis for axis in crs.axis_info}
    units = {axis.unit_name for axis in crs.axis_info if axis.unit_conversion_factor != 1.0}
    if units:
        raise UsageError(f"EPSG:{epsg}, {crs.name}, has the units {', '.join(units)}, not metres")
    if not {"east", "north"} <= set(axes):
        directions = " and ".join(axis.direction for axis in crs.axis_info)
        raise UsageError(f"the axes of EPSG:{epsg}, {crs.name}, are {directions}, not east, north")
    start, body = crs.prime_meridian, crs.ellipsoid
    if start is None or body is None:
        raise UsageError(f"EPSG:{epsg}, {crs.name}, has no meridian or no ellipsoid")
    if start.longitude != 0:
        # PROJ's factors take longitudes from Greenwich for these from there.
        raise UsageError(
            f"EPSG:{epsg}, {crs.name}, has the prime meridian {start.name}, not Greenwich"
        )
    flat = 1 / body.inverse_flattening if body.inverse_flattening else 0.0
    ellipsoid = Ellipsoid(float(body.semi_major_metre), flat)
    return Projected(Proj(crs), crs, ellipsoid, f"EPSG:{epsg}, {crs.name}", epsg)


def grid_at(epsg: int, at: Array) -> Grid:
    """What a projected system does to lengths and directions at a place.

    Parameters
    ----------
    epsg
        Code of the projected system.
    at
        (3,) latitude, longitude, rad, and height, metres, on its datum.

    Raises
    ------
    MissingExtraError, UsageError
        As `projected`.
    """
    system = projected(epsg)
    factors = system.proj.get_factors(at[1], at[0], radians=True)
    radius = mean_radius(float(at[0]), system.ellipsoid)
    return Grid(
        system.name,
        float(np.sqrt(factors.areal_scale)),
        radius / (radius + float(at[2])),
        float(np.radians(factors.meridian_convergence)),
        float(np.radians(factors.angular_distortion)),
        bool(_in_area(system, np.asarray(at)[None], 0.0)[0]),
    )


def unproject(system: Projected, coordinates: Array) -> Array:
    """Latitude, longitude, rad, and height (N, 3) of projected coordinates."""
    east, north, height = coordinates.T
    longitude, latitude = system.proj(east, north, inverse=True, radians=True)
    found = np.column_stack([latitude, longitude, height])
    _check_area(system, found, coordinates)
    return found


def project(system: Projected, at: Array) -> Array:
    """Projected coordinates (N, 3) of latitudes, longitudes and heights."""
    east, north = system.proj(at[:, 1], at[:, 0], radians=True)
    coordinates = np.column_stack([east, north, at[:, 2]])
    _check_area(system, at, coordinates)
    return coordinates


def _in_area(system: Projected, at: Array, beyond: float) -> NDArray[np.bool_]:
    """Which places (N,) are no farther outside of where a system is used, rad."""
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(at).all(axis=1))
    area = system.crs.area_of_use
    if area is None:
        return inside
    at = np.where(inside[:, None], at, 0.0)
    west, south, east, north = np.radians(area.bounds)
    # An area may lie across the meridian of 180°, or all around.
    half = ((east - west) % (2 * np.pi)) / 2 or np.pi
    away = np.abs((at[:, 1] - west - half + np.pi) % (2 * np.pi) - np.pi)
    inside &= away <= half + beyond
    inside &= (at[:, 0] >= south - beyond) & (at[:, 0] <= north + beyond)
    return inside


def _check_area(system: Projected, at: Array, coordinates: Array) -> None:
    """Refuse points far outside of the area of use of a system, or inside it only if swapped."""
    inside = _in_area(system, at, BEYOND_AREA)
    if inside.all() and not _in_area(system, at, 0.0).any():
        longitude, latitude = system.proj(
            coordinates[:, 1], coordinates[:, 0], inverse=True, radians=True
        )
        swapped = np.column_stack([latitude, longitude, at[:, 2]])
        inside &= not _in_area(system, swapped, 0.0).all()
    if not (inside.all() and np.isfinite(coordinates).all()):
        k = int(np.argmin(inside & np.isfinite(coordinates).all(axis=1)))
        degrees = ", ".join(f"{angle:.3f}" for angle in np.degrees(at[k, :2]))
        raise UsageError(
            f"{coordinates[k, 0]:.3f} east, {coordinates[k, 1]:.3f} north lie at {degrees} deg, "
            f"far outside the area of use of {system.name}; are east and north swapped?"
        )


class Ellipsoid(NamedTuple):
    """Semi-major axis, metres, and flattening."""

    semi_major: float
    flattening: float

    @property
    def eccentricity_squared(self) -> float:
        """``e² = f (2 − f)``."""
        return self.flattening * (2 - self.flattening)


WGS84 = Ellipsoid(6_378_137.0, 1 / 298.257223563)
"""Defining parameters of the World Geodetic System 1984 (NGA.STND.0036, table 3.1)."""


def geocentric_of(geodetic: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Earth-centred, earth-fixed coordinates (N, 3), metres.

    Parameters
    ----------
    geodetic
        (N, 3) latitude, longitude, rad, and height above the ellipsoid, metres.
    """
    latitude, longitude, height = np.asarray(geodetic, dtype=float).T
    e2 = ellipsoid.eccentricity_squared
    normal = ellipsoid.semi_major / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    p = (normal + height) * np.cos(latitude)
    return np.column_stack(
        [
            p * np.cos(longitude),
            p * np.sin(longitude),
            (normal * (1 - e2) + height) * np.sin(latitude),
        ]
    )


def geodetic_of(geocentric: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Latitude, longitude, rad, and height above the ellipsoid, metres (N, 3).

    By Bowring's iteration on the reduced latitude. For points near the surface of the earth.

    Parameters
    ----------
    geocentric
        (N, 3) earth-centred, earth-fixed coordinates, metres.
    """
    x, y, z = np.asarray(geocentric, dtype=float).T
    a, e2 = ellipsoid.semi_major, ellipsoid.eccentricity_squared
    ratio = 1 - ellipsoid.flattening
    p = np.hypot(x, y)
    reduced = np.arctan2(z, p * ratio)
    latitude = reduced
    # Of the latitude: each cuts its error by more than a thousand up to 10,000 km of height, from
    # less than 1e-3 rad.
    for _ in range(4):
        latitude = np.arctan2(
            z + e2 / ratio * a * np.sin(reduced) ** 3, p - e2 * a * np.cos(reduced) ** 3
        )
        reduced = np.arctan2(ratio * np.sin(latitude), np.cos(latitude))
    sine = np.sin(latitude)
    height = p * np.cos(latitude) + z * sine - a * np.sqrt(1 - e2 * sine**2)
    return np.column_stack([latitude, np.arctan2(y, x), height])


def enu_axes(latitude: float, longitude: float) -> Array:
    """East, north and up in earth-centred axes: the columns of a rotation (3, 3).

    Up is the normal of the ellipsoid, from which a plumb line differs by some seconds of arc.
    """
    sp, cp, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])


def local_of(geodetic: Array, origin: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """East, north, up (N, 3) of points, metres, in the frame that touches the earth at `origin`.

    Parameters
    ----------
    geodetic
        (N, 3) latitude, longitude, rad, and height, metres.
    origin
        (3,) the same of the origin of the frame.
    """
    away = geocentric_of(geodetic, ellipsoid) - geocentric_of(origin[None], ellipsoid)
    return np.asarray(away @ enu_axes(origin[0], origin[1]))


def geodetic_of_local(local: Array, origin: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Latitude, longitude, rad, and height (N, 3) of points in a frame of `local_of`."""
    away = np.asarray(local, dtype=float) @ enu_axes(origin[0], origin[1]).T
    return geodetic_of(geocentric_of(origin[None], ellipsoid) + away, ellipsoid)


def mean_radius(latitude: float, ellipsoid: Ellipsoid = WGS84) -> float:
    """Radius of the sphere that fits the ellipsoid best at a latitude, metres: ``√(M N)``."""
    e2 = ellipsoid.eccentricity_squared
    b = ellipsoid.semi_major * np.sqrt(1 - e2)
    return float(b / (1 - e2 * np.sin(latitude) ** 2))
