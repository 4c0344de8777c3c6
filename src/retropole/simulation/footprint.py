"""What a beam reports that is wider than a line: edges, and pixels that mix near and far."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.sensors import Sensor
from .devices import Footprint
from .raycast import Hits, Surface, cast

SUB_RAYS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Where a beam's parts lie in its footprint, in units of `SUB_OFFSET`: the centre and a cross."""

SUB_OFFSET, SUB_WIDTH = 0.3, 0.4
"""Distance of the outer parts from the centre, and width of a part, in units of the divergence:
they reach to its edge."""

EDGE = 0.1
"""Difference of range to a neighbouring beam on another surface from which a beam is looked at in
parts, metres (chosen: less leaves no mixed pixel that noise does not hide)."""

NEIGHBOURS = 4
"""Of a beam of a rosette."""

PULSE = 0.5
"""Surfaces closer than this along a beam return one pulse, at a range between theirs, metres.
Chosen: pulses last 3 to 6 ns, which is 0.45 to 0.9 m of range."""

TAPE_POWER, LEAST_POWER = 30.0, 0.02
"""Power that tape returns where a white diffuse surface at normal incidence returns 1, and the
least of any surface (chosen; sheeting in a beam's middle returns more, and saturates)."""


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
    """Index of the beams beside which another surface begins, nearer or farther by `EDGE`."""

    def differ(a: tuple[Array, IntArray], b: tuple[Array, IntArray]) -> BoolArray:
        with np.errstate(invalid="ignore"):
            return np.asarray((a[1] != b[1]) & (np.abs(a[0] - b[0]) > EDGE))

    if sensor.pattern == "spinning":
        grid = (-1, len(sensor.elevations))
        ranges, surface = hits.ranges.reshape(grid), hits.surface.reshape(grid)
        beside = differ((ranges, surface), (np.roll(ranges, 1, 0), np.roll(surface, 1, 0)))
        edge = beside | np.roll(beside, -1, 0)
        above = differ((ranges[:, 1:], surface[:, 1:]), (ranges[:, :-1], surface[:, :-1]))
        edge[:, 1:] |= above
        edge[:, :-1] |= above
        return np.flatnonzero(edge)
    near = KDTree(rays).query(rays, NEIGHBOURS + 1)[1]
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
    """Replace hits at edges by what the parts of the beam meet.

    Surfaces that a pulse does not tell apart return one range, the mean of theirs weighted with the
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
        (N,) part of each beam that meets what it reports.
    """
    share = np.ones(len(rays))
    edge = at_edges(hits, rays, sensor)
    if len(edge) == 0:
        return hits, share
    materials = Materials.of(surfaces)
    offsets = SUB_OFFSET * sensor.divergence * np.tile(SUB_RAYS, (len(edge), 1))
    parts = turned(np.repeat(rays[edge], len(SUB_RAYS), axis=0), *offsets.T)
    met = cast(origin, parts, surfaces, SUB_WIDTH * sensor.divergence)
    shape = (len(edge), len(SUB_RAYS))
    order = np.argsort(met.ranges.reshape(shape), axis=1)
    ranges, surface, cosine = (np.take_along_axis(each.reshape(shape), order, 1) for each in met)
    there = np.isfinite(ranges)
    depth = np.where(there, ranges, 0.0)
    gain = np.where(materials.retro[surface], TAPE_POWER, materials.reflectance[surface] * cosine)
    power = np.where(there, np.maximum(gain, LEAST_POWER) / np.maximum(depth, 1e-3) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        begins = np.diff(ranges, axis=1) > PULSE
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
