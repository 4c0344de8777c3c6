"""The part of a map about a place: points seen from anywhere, without origins of beams."""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array, BoolArray, PointCloud
from ..base.errors import ReadError
from ..base.quantities import counted
from .fields import MapPlace

REACH = 80.0
"""Points of a map farther from the rough place, along x and y, are left out, metres: surfaces of
another LiDAR coincide with those of its map within less, and the search needs 64
(`hypotheses.one_pole`)."""

FEWEST = 1000
"""A map with fewer points there shows no place."""


def is_near(x: Array, y: Array, place: MapPlace) -> BoolArray:
    """Which points are within `REACH` of a place, along either axis; all where it is not known."""
    if place.at is None:
        return np.ones(len(x), dtype=bool)
    return (np.abs(x - place.at[0]) <= REACH) & (np.abs(y - place.at[1]) <= REACH)


def as_map(cloud: PointCloud, place: MapPlace) -> PointCloud:
    """Treat a cloud as a map about a place; without one, about the middle of its points.

    Raises
    ------
    ReadError
        If hardly any point lies near that place, and if a map without one is too large.
    """
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    if place.at is None and (high - low)[:2].max() > 2 * REACH:
        raise ReadError(
            f"the map spans {_spans(low, high)}: give the rough position of the LiDAR in it with "
            "--prior-xyz"
        )
    rows = np.flatnonzero(is_near(cloud.xyz[:, 0], cloud.xyz[:, 1], place))
    if place.at is not None and len(rows) < FEWEST:
        raise nothing_near(place, len(rows), low, high)
    return PointCloud(
        cloud.xyz[rows],
        origin=np.median(cloud.xyz, axis=0) if place.at is None else np.array(place.at),
        source=cloud.source,
        fields=cloud.fields,
        dropped=cloud.dropped,
        thinned=cloud.thinned,
        notes=cloud.notes,
        is_map=True,
        map_sigma=place.sigma,
    )


def nothing_near(place: MapPlace, count: int, low: Array, high: Array) -> ReadError:
    """Report that a map has too few points near a place, and the extent of its points."""
    where = ", ".join(f"{value:,.1f}" for value in place.at or ())
    return ReadError(
        f"{counted(count, 'point')} of the map within {REACH:g} m of ({where}), {FEWEST:,} are "
        f"needed; it spans {_spans(low, high)}: is --prior-xyz in its coordinates?"
    )


def _spans(low: Array, high: Array) -> str:
    spans = (f"{axis} {a:,.1f} to {b:,.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
    return f"{', '.join(spans)} m"
