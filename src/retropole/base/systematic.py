"""Systematic errors of LiDARs: their kinds, their sizes, and the effect of each on a return.

An error that one LiDAR repeats at every return leaves no scatter, and much of it no residual: the
pose absorbs it. Its size must then be known from the instrument (type B of the GUM,
JCGM 100:2008). Each kind is a random effect ``b ~ N(0, σ²)``, the same wherever that LiDAR's
returns are used, on poles and on surfaces. With measured range ρ, azimuth α and elevation ε, the
true return lies at::

    range      ρ − zero − scale·ρ − slant·ρ·tan(incidence) − [tape] − ring_range(ring)
    azimuth    α + encoder_c cos α + encoder_s sin α + ring_azimuth(ring)
    elevation  ε + wobble_c cos α + wobble_s sin α + Σ_k (bend_kc cos kα + bend_ks sin kα)
               + elevation + ring_elevation(ring),    k = 2, 3,

and its beam is e^width times as wide as assumed, which only the edges of poles show.
A constant error of the azimuth is a rotation of the LiDAR's frame, which no scan can show. The
common part of the azimuth errors of the rings is such a rotation too: it is kept, since with σ/√n
for n rings it is as small as unmodelled errors.

If a mast sways while its LiDAR records, the mean pose may differ from that at rest (`Sway`): an
error of that recording, and of all results that use it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from .bounded import Covariance, Number, Size
from .se3 import Array
from .sensors import Sensor

IntArray = NDArray[np.int64]


BAND = np.radians(1.0)
"""Returns within a band of elevation of this width, rad, share the errors of one ring. Sensors of
64 rings and more have several in a band, which then are treated as one."""

RANGE_TO_OFFSET = 3.0
"""A manufacturer's ± figure for the range is treated as this many σ of the offset that all returns
share: a bound that hardly any device exceeds."""

USUAL_WIDTH, STATED_WIDTH = 0.5, 0.2
"""1 σ of the logarithm of the width of a beam: for an unknown LiDAR, since manufacturers' figures
range from 1.5 to 8 mrad, and for a known one, since some state the width at half of the power
and others that at an eighth, 1.7 times as much."""

SPINNING_BEND = float(np.radians(0.003))
"""1 σ of the bend of scan lines of a LiDAR that rotates about one axis, rad: then only its bearing
bends them, by less than the wobble of the axis. Mirrors that rotate about two axes, and lenses,
distort a whole field of view. With 0.002, 0.003 and 0.006° the region contains 79, 86 and 95 % of
truths if lines are bent by 0.02° (benchmarks/coverage.py, 58 runs from seed 1000), and errors if
they are not are 5, 7 and 14 % larger than without (tuning families, seeds 0 to 23)."""

SPINNING_ELEVATION = float(np.radians(0.01))
"""1 σ of the common error of the elevations of all beams if each laser is adjusted separately, rad.
With 0.003, 0.01 and 0.02° the region contains 75, 96 and 100 % of truths if they are off by 0.03°,
and 100 % in all other tuning families, whose errors are the same (benchmarks/coverage.py, 24 runs
each)."""

HARMONICS = (2, 3)
"""Periods per turn of the bend of scan lines: a parabola and a cubic over the field of view of a
LiDAR with a limited field of view."""

MIN_ZERO = 0.005
"""Least 1 σ of the range offset, metres, whatever the manufacturer says."""

MIN_ERROR_SIGMA = 1e-9
"""Least 1 σ of an error, in its unit: one that does not occur."""

MAX_TANGENT = 5.0
"""Tangent of the incidence up to which the pulse is treated as stretched, about 79°."""


@dataclass(frozen=True)
class Sizes:
    """1 σ of each kind of systematic error of a LiDAR.

    The defaults are cautious assumptions, of the order that LiDARs' manuals allow; no instrument
    was measured for them.

    Attributes
    ----------
    zero
        Range offset that all returns share, metres.
    scale
        Relative error of the range.
    slant
        Range error by range and tangent of the incidence, rad: a wide beam on a slanted surface.
    encoder, wobble
        Of each of the cosine and the sine over the azimuth: error of the azimuth of an eccentric
        encoder, and of the elevation under a tilted axis of rotation, rad.
    bend
        Of each of the cosines and sines of `HARMONICS`: error of the elevation by bent scan
        lines, rad. Manuals state 0.01 to 0.1° as angular accuracy: the value assumed for an unknown
        LiDAR is the middle of that, on a logarithmic scale.
    elevation
        Error of the elevation that all beams share, rad.
    tape
        Range offset of retro-reflective returns relative to all others, metres.
    ring_range, ring_elevation, ring_azimuth
        Of each ring, metres and rad: of the azimuth if each laser has an offset to the encoder
        or a separate delay.
    width
        Of the beam, relative: of its logarithm.
    """

    zero: float = 0.010
    scale: float = 2e-4
    slant: float = 3e-4
    encoder: float = float(np.radians(0.02))
    wobble: float = float(np.radians(0.006))
    bend: float = float(np.radians(0.03))
    elevation: float = float(np.radians(0.02))
    tape: float = 0.010
    ring_range: float = 0.004
    ring_elevation: float = float(np.radians(0.02))
    ring_azimuth: float = float(np.radians(0.02))
    width: float = USUAL_WIDTH


MAP_SIGMA = 0.005
"""1 σ of the distortion of a map about a LiDAR, m: clouds of several LiDARs, or of a walk, do not
coincide exactly. Chosen, by the 24 answers of benchmarks/mapped.py, seeds 0 to 31: without it 3
were outside of the 95 % region."""

MAP_LEVER = 30.0
"""Distance between the surfaces that determine a pose in a map, m: a map that is distorted by its
1 σ over this distance is rotated by the quotient."""


def map_distortion(sigma: float = MAP_SIGMA) -> Array:
    """(6, 6) covariance of a pose in a map whose positions err by a 1 σ, m: rad and m."""
    return np.diag(np.repeat([sigma / MAP_LEVER, sigma], 3) ** 2)


def spinning(sizes: Sizes) -> Sizes:
    """Give the same sizes with those of the elevation of a LiDAR that turns about one axis."""
    return replace(sizes, bend=SPINNING_BEND, elevation=SPINNING_ELEVATION)


def sizes_of(sensor: Sensor | None) -> Sizes:
    """Give the sizes of the errors of a sensor: those measured, else as its manufacturer states.

    The defaults are for what neither states.
    """
    if sensor is None:
        return Sizes()
    turns = sensor.pattern == "spinning" and sensor.sees_all_around
    sizes = replace(spinning(Sizes()) if turns else Sizes(), width=STATED_WIDTH)
    if sensor.range_accuracy is not None:
        retro = sensor.retro_accuracy
        zero = max(sensor.range_accuracy / RANGE_TO_OFFSET, MIN_ZERO)
        # For a maker that states nothing about retro-reflectors: an assumption.
        tape = 0.007 if retro is None else retro / RANGE_TO_OFFSET
        sizes = replace(sizes, zero=zero, tape=tape)
    return replace(sizes, **sensor.errors)


class Kind(NamedTuple):
    """A kind of systematic error: its name for people, its field in `Sizes`, and its unit."""

    name: str
    field: str
    unit: Literal["m", "rad", "1"]


DEVICE_KINDS = (
    Kind("range offset", "zero", "m"),
    Kind("range scale", "scale", "1"),
    Kind("slanted surfaces", "slant", "rad"),
    Kind("encoder", "encoder", "rad"),
    Kind("encoder", "encoder", "rad"),
    Kind("wobble of the axis", "wobble", "rad"),
    Kind("wobble of the axis", "wobble", "rad"),
    *(2 * len(HARMONICS) * (Kind("bent scan lines", "bend", "rad"),)),
    Kind("elevation of all beams", "elevation", "rad"),
    Kind("range offset on tape", "tape", "m"),
    Kind("width of the beam", "width", "1"),
)
"""Of the parameters of a whole LiDAR, in their order."""

RING_KINDS = (
    Kind("range of single rings", "ring_range", "m"),
    Kind("elevation of single rings", "ring_elevation", "rad"),
    Kind("azimuth of single rings", "ring_azimuth", "rad"),
)
"""Of the parameters of each ring, in their order."""

RING = len(RING_KINDS)
DEVICE = len(DEVICE_KINDS)
TAPE, WIDTH = DEVICE - 2, DEVICE - 1
"""Parameters of a whole LiDAR, and which of them apply to tape only, and are shown by edges
only."""

RADIUS = 2 * DEVICE
"""Index of the error of the poles' radius, after those of the target and of the source."""

SHARED_ERRORS = RADIUS + 1
"""Parameters that do not belong to a single ring."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Order of all errors: target's, source's, the radius, then each kind of error of each ring.

    Attributes
    ----------
    bands
        The bands of elevation that the target has returns in, and the source, sorted.
    """

    bands: tuple[IntArray, IntArray]

    @property
    def size(self) -> int:
        """Number of errors."""
        return SHARED_ERRORS + RING * (len(self.bands[0]) + len(self.bands[1]))

    def device(self, lidar: int) -> slice:
        """Indices of the errors of the whole target (0) or source (1)."""
        return slice(DEVICE * lidar, DEVICE * (lidar + 1))

    def rings(self, lidar: int, kind: int) -> slice:
        """Indices of the errors of one of `RING_KINDS` of the bands of a LiDAR."""
        first = SHARED_ERRORS + RING * len(self.bands[0]) * lidar + kind * len(self.bands[lidar])
        return slice(first, first + len(self.bands[lidar]))


@dataclass(frozen=True, eq=False)
class Groups:
    """Groups of errors with a common 1 σ.

    Attributes
    ----------
    label
        (B,) the group of each error.
    kinds, sensors
        Of each group: what it is, and which LiDAR's; None for the radius.
    """

    label: IntArray
    kinds: tuple[Kind, ...]
    sensors: tuple[int | None, ...]


RADIUS_KIND = Kind("radius of the poles", "radius", "m")


def band_of(rays: Array, axis: Array) -> IntArray:
    """(N,) band of elevation above the plane across an axis (3,) of each unit vector (N, 3)."""
    elevation = np.arcsin(np.clip(rays @ axis, -1.0, 1.0))
    return np.asarray(np.floor(elevation / BAND), dtype=np.int64)


def by_error(
    by_range: Array,
    by_azimuth: Array,
    by_elevation: Array,
    rays: Array,
    axis: Array,
    ranges: Array,
    tangent: Array,
    tape: bool,
) -> tuple[Array, Array]:
    """Derivative of some quantity of each return with respect to the errors of its LiDAR.

    Parameters
    ----------
    by_range, by_azimuth, by_elevation
        (N, …) its derivative with respect to the true range, metres, azimuth and elevation, rad.
    rays, ranges
        (N, 3) and (N,) unit vectors and ranges of the returns.
    axis
        (3,) that the LiDAR turns about.
    tangent
        (N,) of the angle of incidence.
    tape
        Whether these are returns from tape.

    Returns
    -------
    device, ring
        (N, …, 14) by the errors of the whole LiDAR, (N, …, 3) by those of the return's ring.
    """
    # The origin of azimuths makes no difference: their cosine and sine have the same size.
    start = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [0.0, 0.0, 1.0], axis)
    level = np.stack([rays @ start, rays @ np.cross(axis, start)], axis=1)
    cosine, sine = (level / np.maximum(np.linalg.norm(level, axis=1), 1e-9)[:, None]).T
    turned = [(cosine + 1j * sine) ** k for k in HARMONICS]
    one = np.ones_like(ranges)
    stretch = ranges * np.minimum(tangent, MAX_TANGENT)

    def times(derivative: Array, *factors: Array) -> list[Array]:
        shape = (-1,) + (1,) * (derivative.ndim - 1)
        return [derivative * factor.reshape(shape) for factor in factors]

    device = [
        *times(by_range, -one, -ranges, -stretch),
        *times(by_azimuth, cosine, sine),
        *times(by_elevation, cosine, sine, *(x for z in turned for x in (z.real, z.imag)), one),
        *times(by_range, -one if tape else 0.0 * one, 0.0 * one),
    ]
    return np.stack(device, axis=-1), np.stack([-by_range, by_elevation, by_azimuth], axis=-1)


@dataclass(frozen=True)
class ErrorModel:
    """Prior knowledge of the errors.

    Attributes
    ----------
    sizes
        For each LiDAR.
    radius_sigma
        1 σ of the radius, metres.
    left
        (6, 6) for each LiDAR, the covariance of its recordings relative to rest (`Sway`); none if
        no LiDAR sways.
    """

    sizes: tuple[Sizes, ...] = (Sizes(), Sizes())
    radius_sigma: float = 0.0004
    left: tuple[Array, ...] = ()

    def sigmas(self, groups: Groups) -> Array:
        """(G,) 1 σ of each group of errors, in its unit."""
        known = np.array(
            [
                self.radius_sigma if lidar is None else getattr(self.sizes[lidar], kind.field)
                for kind, lidar in zip(groups.kinds, groups.sensors, strict=True)
            ]
        )
        return np.asarray(np.maximum(known, MIN_ERROR_SIGMA))


ENOUGH = 2.0
"""Number of periods required; after three, rest is known to less than a tenth of the sway
(tests/surfaces/test_sway.py)."""

LEVER = 6.0
"""A mast that turns shifts its LiDAR by this many metres per radian: the height of a lamppost,
whose top bends by less. Used if the shift is not measured."""


class Sway(msgspec.Struct, frozen=True, eq=False, rename={"frequency": "frequency_hz"}):
    """Motion of one LiDAR about its rest while it recorded, axes of its frame.

    Attributes
    ----------
    angle_rad
        Root mean square of the angle from rest that was seen; the stated value if the sway was
        stated and not seen.
    frequency
        Of the oscillation, Hz; None if it was stated.
    seconds
        How long the recording took.
    covariance
        (6, 6) of the remaining difference between rest and the pose to which all points were
        corrected, over rotation and translation, rad and m.
    times_s, angles_rad
        The motion as it was seen, from the first sweep on: the angle in its main direction.
    is_shared
        Whether other LiDARs sway with it, as on one mast.
    """

    angle_rad: Size
    frequency: Size | None
    seconds: Size
    covariance: Covariance
    times_s: tuple[Number, ...] = ()
    angles_rad: tuple[Number, ...] = ()
    is_shared: bool = False

    @property
    def left_rad(self) -> float:
        """1 σ of the angle between the recording and rest, about the axis where it is largest."""
        return float(np.sqrt(np.linalg.eigvalsh(np.asarray(self.covariance)[:3, :3])[-1]))

    @property
    def seconds_more(self) -> float:
        """How much longer to record for `ENOUGH` periods, s; 0 if they were recorded."""
        if self.frequency is None or self.is_shared:
            return 0.0
        return max(ENOUGH / self.frequency - self.seconds, 0.0)

    @property
    def text(self) -> str:
        """Its size, how well the position at rest is known, and how long to record."""
        angle = f"± {math.degrees(self.angle_rad):.2g}°"
        if self.frequency is None:
            return (
                f"{angle} as stated; the recording does not show its position at rest, so the "
                "stated error includes the whole sway: record 10 s or more"
            )
        if self.is_shared:
            return (
                f"{angle} at {self.frequency:.2g} Hz together with another LiDAR, as on one mast: "
                "the transform between them does not move"
            )
        more = f": record {math.ceil(self.seconds_more)} s more" if self.seconds_more else ""
        return (
            f"{angle} at {self.frequency:.2g} Hz, {self.periods:.1f} periods; its position at "
            f"rest is known to ± {math.degrees(self.left_rad):.1g}°{more}"
        )

    @property
    def periods(self) -> float:
        """Number of periods that were recorded; 0 for a stated sway."""
        return self.seconds * (self.frequency or 0.0)


def stated_sway(sigma: float) -> Sway:
    """Give the stated sway of a mast, if a recording does not show it.

    `sigma` is the root mean square of its angle from rest, rad. A mast turns about level axes, half
    of the variance about each; which axes of the LiDAR are level is not known: any may be.
    """
    covariance = np.diag(np.repeat([sigma, LEVER * sigma], 3) ** 2) / 2
    return Sway(sigma, None, 0.0, covariance)


def remaining_sway(sways: Sequence[Sway | None]) -> Array:
    """(6, 6) covariance of the remaining sway of one LiDAR in the mean of its recordings."""
    left = sum((each.covariance for each in sways if each is not None), np.zeros((6, 6)))
    return np.asarray(left / max(len(sways), 1) ** 2)


def remaining_sway_of_each(rows: Sequence[Sequence[Sway | None]]) -> tuple[Array, ...]:
    """`remaining_sway` each LiDAR's recordings; none if none moved."""
    if not any(each for row in rows for each in row):
        return ()
    return tuple(remaining_sway(row) for row in rows)
