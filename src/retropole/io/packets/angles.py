"""Directions of the channels of a unit, by its file or its packets."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ...base.errors import ReadError, naming, readable
from . import interpolated
from .mirrors import read_corrections
from .models import Angles, Interpolated, Mirrors, Model

MAX_BYTES = 2**20
"""Of a file of angles; one of 128 channels has at most 50 kB."""


def read_angles(path: Path, model: Model) -> Angles:
    """Read the angles of a unit: of each channel, from 1 on, elevation and azimuth, degrees.

    Parameters
    ----------
    path
        A table with commas, as Hesai's LiDARs have it (``Channel,Elevation,Azimuth``); of an AT128
        its correction file, .dat.
    model
        Of the unit.

    Raises
    ------
    ReadError
        If there is no such file, or it is not one of this many channels.
    """
    with readable(path), naming(path):
        if isinstance(model.layout, Mirrors):
            return read_corrections(path)
        text = path.read_bytes()[:MAX_BYTES].decode("utf-8-sig", errors="replace")
        found: dict[int, tuple[float, float]] = {}
        for row in csv.reader(text.splitlines()):
            try:
                channel, elevation, azimuth = int(row[0]), float(row[1]), float(row[2])
            except (ValueError, IndexError):
                continue  # a heading, or a checksum
            found[channel] = elevation, azimuth
        channels = len(model.elevation_deg) or len(found)
        if not found or sorted(found) != list(range(1, channels + 1)):
            raise ReadError(
                f"has angles of {len(found)} channels, expected lines with channel (from 1), "
                f"elevation and azimuth of all {channels or ''} of a {model.title}"
            )
        table = np.radians([found[k] for k in sorted(found)])
        if not (np.abs(table[:, 0]) <= np.pi / 2).all() or not np.isfinite(table).all():
            raise ReadError("has elevations beyond 90°")
        return Angles(table[:, 0], table[:, 1], path.name)


def reported_angles(model: Model, payload: bytes) -> Angles | None:
    """Read the angles of a unit from a packet that contains them; None for any other."""
    if isinstance(model.layout, Interpolated):
        return interpolated.reported_angles(model, payload)
    return None
