"""What a beam returns: at edges, where pixels mix near and far, and with which intensity.

Diffuse surfaces are on the scale of a sensor, tape above its threshold. The glow around tape is
false bright returns in beams that pass close next to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.sensors import Sensor
from .devices import Footprint, NoiseModel
from .raycast import Hits, Surface, cast

SUB_RAYS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Where a beam's parts lie in its footprint, in units of `SUB_OFFSET`: the centre and a cross."""

SUB_OFFSET = 0.3
"""Distance of the outer parts from the centre, in units of the divergence: as they are 0.4 of it
wide, they reach to its edge."""

EDGE = 0.1
"""Difference of range to a neighbouring beam on another surface from which a beam is looked at in
parts, metres (chosen: less leaves no mixed pixel that noise does not hide)."""


class Materials(NamedTuple):
    """Whether each surface (S,) is retro-reflective, and its diffuse reflectance."""

    retro: BoolArray
    reflectance: Array

    @classmethod
    def of(cls, surfaces: Sequence[Surface]) -> Materials:
        """Collect them."""
        return cls(
            np.array([s.material.retro for s in surfaces], dtype=bool),
            np.array([s.material.reflectance for s in surfaces], dtype=float),
        )


def sideways(rays: Array) -> tuple[Array, Array]:
    """Two unit vectors (N, 3) perpendicular to each ray (N, 3) and to each other."""
    flat = np.abs(rays[:, 2]) < 0.9
    first = np.cross(rays, np.where(flat[:, None], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(rays, first)


def turned(rays: Array, right: Array, up: Array) -> Array:
    """Turn unit rays (N, 3) by small angles (N,), rad, along both of `sideways`."""
    first, second = sideways(rays)
    moved = rays + right[:, None] * first + up[:, None] * second
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def at_edges(hits: Hits, rays: Array, sensor: Sensor) -> IntArray:
    """Index of the beams next to which another surface begins, nearer or farther by `EDGE`."""

    def differ(a: tuple[Array, IntArray], b: tuple[Array, IntArray]) -> BoolArray:
        with np.errstate(invalid="ignore"):
            return np.asarray((a[1] != b[1]) & (np.abs(a[0] - b[0]) > EDGE))

    if sensor.pattern == "spinning":
        grid = (-1, len(sensor.elevations))
        ranges, surface = hits.ranges.reshape(grid), hits.surface.reshape(grid)
        edges = differ((ranges, surface), (np.roll(ranges, 1, 0), np.roll(surface, 1, 0)))
        edge = edges | np.roll(edges, -1, 0)
        above = differ((ranges[:, 1:], surface[:, 1:]), (ranges[:, :-1], surface[:, :-1]))
        edge[:, 1:] |= above
        edge[:, :-1] |= above
        return np.flatnonzero(edge)
    near = KDTree(rays).query(rays, 5)[1]
    own = hits.ranges[:, None], hits.surface[:, None]
    return np.flatnonzero(differ(own, (hits.ranges[near], hits.surface[near])).any(axis=1))


def report(
    hits: Hits,
    origin: Array,
    rays: Array,
    surfaces: Sequence[Surface],
    sensor: Sensor,
    footprint: Footprint,
) -> tuple[Hits, Array]:
    """Replace hits at edges by what the parts of the beam hit.

    Surfaces that a pulse does not separate return one range, the mean of theirs weighted with the
    power that returns. Of those it does, the first is reported or the strongest.

    Parameters
    ----------
    hits
        Of the beams' centres.
    origin
        (3,) of the beams, metres.
    rays
        (N, 3) unit directions of their centres.
    surfaces
        What they can hit.
    sensor
        Has the divergence.
    footprint
        ``first`` or ``strongest``.

    Returns
    -------
    hits : Hits
    share : ndarray
        (N,) part of each beam that hits what it reports.
    """
    share = np.ones(len(rays))
    edge = at_edges(hits, rays, sensor)
    if len(edge) == 0:
        return hits, share
    materials = Materials.of(surfaces)
    offsets = SUB_OFFSET * sensor.divergence * np.tile(SUB_RAYS, (len(edge), 1))
    parts = turned(np.repeat(rays[edge], len(SUB_RAYS), axis=0), *offsets.T)
    seen_patches = cast(origin, parts, surfaces, 0.4 * sensor.divergence)
    shape = (len(edge), len(SUB_RAYS))
    order = np.argsort(seen_patches.ranges.reshape(shape), axis=1)
    ranges, surface, cosine = (
        np.take_along_axis(each.reshape(shape), order, 1) for each in seen_patches
    )
    there = np.isfinite(ranges)
    depth = np.where(there, ranges, 0.0)
    # A white diffuse surface at normal incidence returns 1; sheeting in a beam's middle returns
    # more, and saturates.
    gain = np.where(materials.retro[surface], 30.0, materials.reflectance[surface] * cosine)
    power = np.where(there, np.maximum(gain, 0.02) / np.maximum(depth, 1e-3) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        # Pulses last 3 to 6 ns, which is 0.45 to 0.9 m of range.
        begins = np.diff(ranges, axis=1) > 0.5
    pulse = np.concatenate([np.zeros((len(edge), 1), int), np.cumsum(begins, axis=1)], axis=1)
    chosen = np.zeros(len(edge), dtype=np.int64)
    if footprint == "strongest":
        total = [np.where(pulse == k, power, 0).sum(axis=1) for k in range(len(SUB_RAYS))]
        chosen = np.argmax(total, axis=0)
    of_pulse = np.where(pulse == chosen[:, None], power, 0.0)
    returned = of_pulse.sum(axis=1)
    brightest = np.arange(len(edge)), np.argmax(of_pulse, axis=1)
    answered = returned > 0
    mean = (of_pulse * depth).sum(axis=1) / np.where(answered, returned, 1.0)
    reported = Hits(hits.ranges.copy(), hits.surface.copy(), hits.cosine.copy())
    reported.ranges[edge] = np.where(answered, mean, np.inf)
    reported.surface[edge] = np.where(answered, surface[brightest], -1)
    reported.cosine[edge] = cosine[brightest]
    share[edge] = (of_pulse > 0).mean(axis=1)
    return reported, share


RETRO_GRAZING, RETRO_INCIDENCE = 0.55, 0.45
"""Strength of tape at grazing incidence, and what its cosine adds up to normal incidence: 1 is
saturation (chosen: tape is bright from most angles)."""

FALLOFF_FROM = 5.0
"""Range at which a diffuse surface has the intensity that it has without falloff, metres: the
thresholds of `sensors` are for about 5 m."""

RAW_FALLOFF, CALIBRATED_FALLOFF = 2.0, 0.5
"""Power of the range by which intensity falls: the inverse square where a sensor states raw signal,
and what remains where it states a reflectivity that it has compensated (chosen)."""

TAPE_REACH = 12.0
"""Range to which tape at normal incidence saturates a sensor, metres. Chosen so that tape at 3 to
8 m normally stays above the threshold, and far or grazing tape may not."""

TAPE_ANGLES = float(np.cos(np.radians(45.0))), float(np.cos(np.radians(80.0)))
"""Cosine of incidence to which tape keeps its strength, and that at which next to nothing is left:
retro-reflective sheeting is specified to entrance angles of 30° to 40° and is dark at grazing
incidence (the angles are chosen)."""


def saturation(sensor: Sensor) -> float:
    """Intensity of the brightest tape on a sensor's scale."""
    # An Ouster with a threshold of 1000 records up to 6,268 and not the 65,535 of its full scale.
    return min(sensor.intensity_max, 6.0 * sensor.threshold)


def tape_strength(cosine: Array) -> Array:
    """Strength of tape (N,) under falloff, from the cosine of incidence (N,): 1 at normal."""
    full, dark = TAPE_ANGLES
    return np.clip((cosine - dark) / (full - dark), 0.03, 1.0)


def intensities(
    sensor: Sensor,
    retro: BoolArray,
    reflectance: Array,
    cosine: Array,
    ranges: Array,
    share: Array,
    rng: np.random.Generator,
    noise: NoiseModel,
) -> Array:
    """Intensities (N,) on the sensor's scale: diffuse below its threshold, tape above it.

    Diffuse returns follow the cosine of incidence. Tape lies between the threshold and saturation,
    lower where only the edge of a beam hit it. With falloff, both fall with the range and nothing
    keeps them on their side of the threshold.

    Parameters
    ----------
    sensor
        The LiDAR.
    retro, reflectance
        (N,) of the surface of each return.
    cosine
        (N,) of the angle of incidence.
    ranges
        (N,) metres.
    share
        (N,) part of the beam that hits the surface.
    rng, noise
        Relative noise, and whether there is falloff.
    """
    gain = 1 + noise.intensity_noise * rng.normal(size=len(cosine))
    # No return without intensity, and none brighter than white.
    brightness = np.clip(reflectance * cosine * share * gain, 0.005, 1.0)
    # Intensity of a white diffuse surface at normal incidence, as a share of the sensor's
    # threshold. Chosen; on Velodyne's scale diffuse returns end at 100 and the threshold is 230,
    # which is 0.43.
    diffuse = 0.45 * sensor.threshold * brightness
    full = saturation(sensor)
    loss = noise.intensity_noise * np.abs(rng.normal(size=len(cosine)))
    if noise.intensity_falloff:
        # Wider scales than a byte are raw signal.
        power = CALIBRATED_FALLOFF if sensor.intensity_max <= 255.0 else RAW_FALLOFF
        # At short range the optics lose light.
        diffuse *= np.minimum((FALLOFF_FROM / ranges) ** power, 2.0)
        strength = tape_strength(cosine) * share * (1 - loss) * (TAPE_REACH / ranges) ** 2
        bright = full * np.clip(strength, 0.0, 1.0)
    else:
        strength = (RETRO_GRAZING + RETRO_INCIDENCE * cosine) * share * (1 - loss)
        # Always above the threshold.
        bright = sensor.threshold + (full - sensor.threshold) * np.clip(strength, 0.05, 1.0)
    return np.asarray(np.round(np.where(retro, bright, diffuse)))


BLOOM_NOISE = 0.02
"""1 σ of the range of a false return next to tape, metres (chosen)."""


class Echoes(NamedTuple):
    """Range, m, intensity, surface and beam (N,) of each return; beams in ascending order."""

    ranges: Array
    intensity: Array
    surface: IntArray
    beam: IntArray


def bloom(
    rays: Array, on_tape: BoolArray, half_width: float, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw the beams that return falsely because they pass close next to tape.

    The chance falls linearly from 1 at the beam on tape to 0 at the half width of the glow.

    Parameters
    ----------
    rays
        (N, 3) unit directions.
    on_tape
        (N,) whether the return of a beam is of tape.
    half_width
        Of the glow, rad.
    rng
        Source of the draws.

    Returns
    -------
    false, beside : ndarray
        (M,) index of the beams with a false return, and of the beam on tape next to each.
    """
    bright, dark = np.flatnonzero(on_tape), np.flatnonzero(~on_tape)
    if len(bright) == 0:
        return bright, bright
    dark = dark[_in_neighbour_cells(rays[dark], rays[bright], max(half_width, 1 / 64))]
    distance, nearest = KDTree(rays[bright]).query(rays[dark], distance_upper_bound=half_width)
    glows = np.flatnonzero(rng.uniform(size=len(dark)) < 1 - distance / half_width)
    return dark[glows], bright[nearest[glows]]


def _in_neighbour_cells(rays: Array, others: Array, size: float) -> IntArray:
    """Index of rays (N, 3) in the same cubic cell as one of others (M, 3), or in one next to it.

    It leaves out most beams before distances are computed.
    """
    count = int(np.ceil(2 / size)) + 3
    steps = np.array([count * count, count, 1])
    shift = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ steps
    occupied = np.zeros(count**3, dtype=bool)
    cells = np.unique(((others + 1) / size + 1).astype(np.int64) @ steps)
    occupied[(cells[:, None] + shift).ravel()] = True
    return np.flatnonzero(occupied[((rays + 1) / size + 1).astype(np.int64) @ steps])


def with_glow(
    echoes: Echoes,
    on_tape: BoolArray,
    rays: Array,
    half_width: float,
    sensor: Sensor,
    nothing: int,
    rng: np.random.Generator,
) -> Echoes:
    """Add false returns next to tape, at the tape's range, in place of what their beams hit.

    Parameters
    ----------
    echoes
        True returns.
    on_tape
        (N,) whether each is of tape.
    rays
        (B, 3) unit directions of all beams.
    half_width
        Of the glow, rad.
    sensor
        Its scale of intensity.
    nothing
        Label of the false returns.
    rng
        Source of the draws.
    """
    tape = np.zeros(len(rays), dtype=bool)
    tape[echoes.beam[on_tape]] = True
    false, edges = bloom(rays, tape, half_width, rng)
    own = np.zeros(len(rays), dtype=np.int64)
    own[echoes.beam] = np.arange(len(echoes.beam))
    ranges = echoes.ranges[own[edges]] + BLOOM_NOISE * rng.normal(size=len(false))
    strength = 0.5 * rng.uniform(size=len(false))
    bright = sensor.threshold + (saturation(sensor) - sensor.threshold) * strength
    added = Echoes(ranges, np.round(bright), np.full(len(false), nothing), false)
    kept = ~np.isin(echoes.beam, false)
    order = np.argsort(np.concatenate([echoes.beam[kept], false]), kind="stable")
    return Echoes(
        *(np.concatenate([old[kept], new])[order] for old, new in zip(echoes, added, strict=True))
    )
