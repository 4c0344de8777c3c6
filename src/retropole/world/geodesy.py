"""Latitude, longitude and height on an ellipsoid, and east-north-up frames that touch it.

Closed forms in float64, which are exact to some nanometres on the ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array


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

ITERATIONS = 4
"""Of the latitude: each cuts its error by more than a thousand up to 10,000 km of height, from
less than 1e-3 rad."""


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
    for _ in range(ITERATIONS):
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
