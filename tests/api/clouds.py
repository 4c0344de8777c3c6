"""Clouds for the tests of the Python interface: small, and with poles that both LiDARs see."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

import retropole as rp
from retropole.simulation import SimulatedPair

Table = NDArray[np.float64]


POLES_ALONE = rp.RunConfig(refine=False)
"""Of the answers this is the quickest."""


@cache
def pair() -> SimulatedPair:
    return rp.simulate("harbor", 1, sensor_target="VLP-16", sensor_source="VLP-16")


@dataclass(frozen=True, eq=False)
class Tables:
    """Target and source as arrays (N, 4): x, y, z, intensity."""

    target: Table
    source: Table


@cache
def tables() -> Tables:
    return Tables(table_of(pair().target), table_of(pair().source))


def table_of(cloud: rp.PointCloud) -> Table:
    assert cloud.intensity is not None
    return np.column_stack([cloud.xyz, cloud.intensity])


def cloud_of(table: NDArray[np.floating]) -> rp.PointCloud:
    """Make a cloud of an array as it is, its type included."""
    columns: Table = table.copy()  # type: ignore[assignment]
    return rp.PointCloud(columns[:, :3], columns[:, 3])


@cache
def calibrated() -> rp.CalibrationResult:
    return rp.calibrate(tables().target, tables().source, options=POLES_ALONE)


@cache
def refused() -> rp.CalibrationResult:
    return rp.calibrate(tables().target, tables().source, options=POLES_ALONE, poles=5)
