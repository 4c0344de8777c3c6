"""Datasets of answers whose truth is known, without any calibration."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from retropole.base.datatypes import Array
from retropole.fleet.dataset import LidarEntry, Row, partition_of, write_partition

SIGMA = 1e-3


def answered_pair(name: str, T: Array, covariance: Array | None = None) -> Row:
    """The row of a pair with an answer."""
    C = np.eye(6) * SIGMA**2 if covariance is None else covariance
    source = LidarEntry(
        name="source",
        sensor="VLP-16",
        T=T.ravel().tolist(),
        covariance=C.ravel().tolist(),
        predicted_error=[],
        budget=[],
    )
    return Row(
        id=name,
        kind="pair",
        status="ok",
        frame="target",
        lidars=[source],
        version="1",
        libraries="numpy 2",
    )


def refused_pair(name: str) -> Row:
    """The row of a pair without an answer."""
    return Row(
        id=name,
        kind="pair",
        status="refused",
        codes=["few_poles"],
        messages=["one"],
        version="1",
        libraries="numpy 2",
    )


def write_answers(folder: Path, rows: Iterable[Row]) -> str:
    """Write rows as the dataset of a fleet."""
    parts: dict[str, list[Row]] = {}
    for row in rows:
        parts.setdefault(partition_of(row.id), []).append(row)
    for part, of_part in parts.items():
        write_partition(str(folder), part, of_part, [])
    return str(folder)
