"""What a site is: LiDARs with their recordings, placements of the poles, and what was surveyed.

A LiDAR does not move between the placements of the poles. A pole does not move during one
placement, for all LiDARs. Everything is in metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np

from .bounded import Count, Direction, Number, Size, Text, Vector
from .datatypes import DEFAULT_RADIUS, Array, PointCloud
from .sensors import Sensor
from .uncertainty.purpose import Need


class Up(msgspec.Struct, frozen=True, eq=False, rename={"sigma": "sigma_rad"}):
    """Up direction, by an inertial sensor fixed to a LiDAR.

    Attributes
    ----------
    direction
        (3,) unit vector in the LiDAR's frame.
    sigma
        1 σ of it about each level axis, rad.
    """

    direction: Direction
    sigma: Size


@dataclass(frozen=True, eq=False)
class SiteLidar:
    """One LiDAR of a site and what it recorded.

    Attributes
    ----------
    name
        Its name, which is also that of its frame.
    clouds
        One for each placement of the poles; None if it recorded none.
    sensor, threshold
        What it is, and the intensity from which a return is treated as retro-reflective; None if
        not known.
    serial
        Serial number; empty if not given.
    up
        Up direction in its frame; None if it was not measured.
    mast_sway
        1 σ of the stated angle of sway of its mast, rad; None takes what its sweeps show.
    """

    name: str
    clouds: tuple[PointCloud | None, ...]
    sensor: Sensor | None = None
    threshold: float | None = None
    serial: str = ""
    up: Up | None = None
    mast_sway: float | None = None


class SurveyedPole(
    msgspec.Struct,
    frozen=True,
    eq=False,
    omit_defaults=True,
    rename={
        **{"foot": "foot_m", "top": "top_m", "sigma": "sigma_m"},
        **{"foot_sigma": "foot_sigma_m", "top_sigma": "top_sigma_m"},
    },
):
    """A taped pole of which points on the axis, or on its surface, were surveyed.

    Attributes
    ----------
    name, placement
        What it is called, and the index of the placement that it is in.
    foot, top
        (3,) its lower and upper end, in the frame of the site; None if not surveyed.
    sigma
        1 σ of each coordinate, metres.
    foot_sigma, top_sigma
        (3,) where the coordinates of an end have separate ones; `sigma` is then the largest of all.
    on
        Whether the ends are points of the axis, or of the surface on a side that nobody knows.
    """

    name: Text
    placement: Count
    foot: Vector | None
    top: Vector | None
    sigma: Size
    foot_sigma: Vector | None = None
    top_sigma: Vector | None = None
    on: Literal["axis", "surface"] = "axis"

    @property
    def ends(self) -> list[tuple[str, Array, Array]]:
        """Which end was surveyed, where (3,), and 1 σ of each coordinate (3,), metres."""
        both = (("foot", self.foot, self.foot_sigma), ("top", self.top, self.top_sigma))
        return [
            (name, at, np.full(3, self.sigma) if sigma is None else sigma)
            for name, at, sigma in both
            if at is not None
        ]


class Sighting(msgspec.Struct, frozen=True, eq=False, rename={"at": "at_m", "sigma": "sigma_m"}):
    """Where a LiDAR sees a control point: index of the LiDAR, (3,) in its frame, 1 σ, metres."""

    lidar: Count
    at: Vector
    sigma: Size


class ControlPoint(
    msgspec.Struct,
    frozen=True,
    eq=False,
    omit_defaults=True,
    rename={"at": "at_m", "sigma": "sigma_m", "sigmas": "sigmas_m"},
):
    """A surveyed point that LiDARs see as a target: (3,) in the frame of the site, 1 σ, metres.

    If its coordinates have a separate σ, `sigmas` (3,) has them, `sigma` the largest.
    """

    name: Text
    at: Vector
    sigma: Size
    seen: tuple[Sighting, ...]
    sigmas: Vector | None = None


class Geodetic(msgspec.Struct, frozen=True):
    """A place on an ellipsoid: latitude, longitude, rad, and height above it, metres."""

    latitude_rad: Number
    longitude_rad: Number
    height_m: Number

    @property
    def array(self) -> Array:
        """(3,) all three."""
        return np.array(msgspec.structs.astuple(self))


class Frame(msgspec.Struct, frozen=True, eq=False, rename={"offset": "offset_m"}):
    """The frame that a site is given in.

    Attributes
    ----------
    name
        For a person: ``LiDAR mast-a``, ``EPSG:25832``, ``ENU at 52.1, 4.2``.
    surveyed
        Whether surveyed coordinates fix it; otherwise the reference LiDAR does.
    offset
        (3,) coordinates of the origin that computations count from, metres: what is surveyed lies
        near it. A point of the site in the coordinates of the frame is its place plus this.
    epsg
        Code of a projected frame, or None.
    geodetic
        Origin of a local east-north-up frame; None if not known.
    """

    name: Text
    surveyed: bool = False
    offset: Vector = msgspec.field(default_factory=lambda: np.zeros(3))
    epsg: Count | None = None
    geodetic: Geodetic | None = None


@dataclass(frozen=True, eq=False)
class Site:
    """All that a site's calibration starts from.

    Attributes
    ----------
    name
        What the site is called.
    lidars
        At least two.
    placements
        Names of the placements of the poles; each LiDAR has one cloud, or None, for each.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    reference
        Index of the LiDAR whose frame is the site's where nothing is surveyed.
    frame
        The frame of all coordinates that are given.
    poles, points
        What was surveyed, in that frame, less `Frame.offset`.
    need
        How accurate every pose must be; None only requires usable.
    carried
        Whether a person carried one pole through the view of all LiDARs, in the one placement.
    """

    name: str
    lidars: tuple[SiteLidar, ...]
    placements: tuple[str, ...]
    radius: float = DEFAULT_RADIUS
    radius_sigma: float = 0.0
    reference: int = 0
    frame: Frame = field(default_factory=lambda: Frame("reference LiDAR"))
    poles: tuple[SurveyedPole, ...] = ()
    points: tuple[ControlPoint, ...] = ()
    need: Need | None = None
    carried: bool = False


def is_pair(site: Site) -> bool:
    """Whether a site is two LiDARs that nothing but each other ties."""
    tied = site.poles or site.points or any(lidar.up is not None for lidar in site.lidars)
    return len(site.lidars) == 2 and not tied
