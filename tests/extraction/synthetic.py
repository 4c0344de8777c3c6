"""Lines and points made by hand, to stand just within a limit or just beyond it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from retropole.base.datatypes import Array, IntArray, PointCloud
from retropole.extraction.acceptance_shape import Failure
from retropole.extraction.lines import Line, fit_line

FOOT: Array = np.array([4.0, 0.0, 0.0])
"""Middle of the pole of `scene`, which stands upright."""

UP: Array = np.array([0.0, 0.0, 1.0])
BRIGHT, SEEN_BADLY, DIM = 200.0, 120.0, 10.0
"""Intensity of tape, of tape seen badly, and of other things."""


def line_with(
    count: int = 24,
    length: float = 1.2,
    rms: float = 0.01,
    rings: int = 8,
    along: Array | None = None,
) -> Line:
    """A line whose figures are given and not computed."""
    if along is None:
        along = np.linspace(-length / 2, length / 2, count)
    return Line(np.arange(count), along, FOOT, UP, length, rms, rings, 0.12)


def offset(x: Array | float, y: Array | float, z: Array | float) -> Array:
    """Point (3,), or points (N, 3), so far from the middle of the pole, metres."""
    return np.asarray(FOOT + np.stack(np.broadcast_arrays(x, y, z), axis=-1))


def upright_places(places: Array) -> Array:
    """Points (N, 3) of the pole's axis, so far above its middle."""
    return offset(0.0, 0.0, places)


def on_pole(length: float = 1.6, rings: int = 16, each: int = 2, width: float = 0.02) -> Array:
    """Points (rings × each, 3) of an upright pole, spread across by ``width``."""
    up = np.repeat(np.linspace(-length / 2, length / 2, rings), each)
    aside = np.tile(np.linspace(-width / 2, width / 2, each) if each > 1 else np.zeros(1), rings)
    return offset(np.zeros(len(up)), aside, up)


def scene(
    pole: Array, *others: tuple[Array, float], rings: IntArray | None = None
) -> tuple[PointCloud, Line]:
    """A cloud of a pole's points and of others, each with their intensity, and the pole's line.

    ``rings`` are those of the pole; other points have rings of their own. None leaves rings out.
    """
    xyz = np.concatenate([pole, *[points for points, _ in others]])
    intensity = np.concatenate(
        [np.full(len(pole), BRIGHT), *[np.full(len(points), value) for points, value in others]]
    )
    cloud = PointCloud(xyz, intensity)
    if rings is not None:
        rest = np.arange(len(xyz) - len(pole)) + int(rings.max()) + 1
        cloud = replace(cloud, ring=np.concatenate([rings, rest]))
    return cloud, fit_line(cloud, np.arange(len(pole)), FOOT, UP, 0.02)


def around(count: int, height: float, distance: float, seed: int = 0) -> Array:
    """Points (count, 3) all about the pole at one height."""
    bearing = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    return offset(distance * np.cos(bearing), distance * np.sin(bearing), height)


def code_of(failure: Failure | None) -> str:
    return "" if failure is None else failure.code
