"""The glow around tape: false bright returns in beams that pass close beside it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.sensors import Sensor
from .intensity import saturation

BLOOM_NOISE = 0.02
"""1 σ of the range of a false return beside tape, metres (chosen)."""

BLOOM_STRENGTH = 0.5
"""The brightest false return, where 0 is the threshold and 1 saturation (chosen)."""


CELL = 1 / 64
"""Least size of the cells in which beams beside tape are looked for, rad."""


class Echoes(NamedTuple):
    """Range, m, intensity, surface and beam (N,) of each return; beams in ascending order."""

    ranges: Array
    intensity: Array
    surface: IntArray
    beam: IntArray


def bloom(
    rays: Array, on_tape: BoolArray, half_width: float, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw the beams that return falsely because they pass close beside tape.

    The chance falls linearly from 1 at the beam on tape to 0 at the half width of the glow.

    Parameters
    ----------
    rays
        (N, 3) unit directions.
    on_tape
        (N,) whether a beam's own return is of tape.
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
    dark = dark[_in_cells_beside(rays[dark], rays[bright], max(half_width, CELL))]
    apart, nearest = KDTree(rays[bright]).query(rays[dark], distance_upper_bound=half_width)
    glows = np.flatnonzero(rng.uniform(size=len(dark)) < 1 - apart / half_width)
    return dark[glows], bright[nearest[glows]]


def _in_cells_beside(rays: Array, others: Array, size: float) -> IntArray:
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
    """Add false returns beside tape, at the tape's range, in place of what their beams met.

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
    false, beside = bloom(rays, tape, half_width, rng)
    own = np.zeros(len(rays), dtype=np.int64)
    own[echoes.beam] = np.arange(len(echoes.beam))
    ranges = echoes.ranges[own[beside]] + BLOOM_NOISE * rng.normal(size=len(false))
    strength = BLOOM_STRENGTH * rng.uniform(size=len(false))
    bright = sensor.threshold + (saturation(sensor) - sensor.threshold) * strength
    added = Echoes(ranges, np.round(bright), np.full(len(false), nothing), false)
    kept = ~np.isin(echoes.beam, false)
    order = np.argsort(np.concatenate([echoes.beam[kept], false]), kind="stable")
    return Echoes(
        *(np.concatenate([old[kept], new])[order] for old, new in zip(echoes, added, strict=True))
    )
