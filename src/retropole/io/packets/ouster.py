"""Packets of Ousters, decoded by the manufacturer's SDK (the extra ``ouster``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import MissingExtraError, ReadError, naming, reported
from ...base.sensors import SENSORS
from ..fields import Columns
from .sweeps import Sweep


def find_metadata(path: Path, sizes: str) -> Path:
    """Find the metadata of an Ouster next to its packets: with the same name, or the only ones."""
    same = path.with_suffix(".json")
    if same.is_file():
        return same
    files = sorted(path.parent.glob("*.json"))
    if len(files) == 1:
        return files[0]
    have = f"{len(files)} files .json, none of them {same.name}" if files else "no .json"
    raise ReadError(
        f"{path}: its packets are not of a known LiDAR ({sizes}); those of an Ouster need the "
        f"sensor's metadata next to them as {same.name}, found {have}"
    )


def model_named(metadata: Path) -> str:
    """Name the model that metadata are of, as ``sensors.toml`` does; else the maker."""
    found = PRODUCT.search(metadata.read_text(encoding="utf-8", errors="replace"))
    if found is None:
        return OUSTER
    name = f"OS{found[1]}"
    return name if name in SENSORS else f"{OUSTER} {name}"


OUSTER = "Ouster"

PRODUCT = re.compile(r'"prod_line"\s*:\s*"OS-?(\w)')
"""Where metadata name the product: ``OS-1-64``."""


def sweeps_of_capture(path: Path, metadata: Path) -> Iterator[Sweep]:
    """Decode a capture, by the metadata of its sensor."""
    try:
        from ouster.sdk import open_source
    except ImportError:
        raise MissingExtraError("ouster", "reading Ouster packets") from None

    with (
        naming(path),
        reported("capture"),
        closing(open_source(str(path), meta=[str(metadata)])) as source,
    ):
        sweep = ouster_sweeps(source.sensor_info[0])
        yield from (sweep(scan) for scans in source for scan in scans if scan is not None)


def ouster_sweeps(info: Any) -> Callable[[Any], Sweep]:
    """Return a function that makes sweeps from an Ouster's scans, from the `SensorInfo` of its
    metadata."""
    from ouster.sdk.core import ChanField, XYZLut

    # In the sensor's frame z = 0 is its base; the beams start above it.
    rays = XYZLut(info, use_extrinsics=False)
    origin = info.lidar_to_sensor_transform[:3, 3] / 1000

    def sweep(scan: Any) -> Sweep:
        start = float(scan.timestamp[scan.get_first_valid_column()]) / 1e9
        return Sweep(start, partial(_ouster_columns, scan, rays, ChanField), origin)

    return sweep


def _ouster_columns(scan: Any, rays: Any, names: Any) -> Columns:
    """Name the values of a sweep, ring by ring; without a return there is no coordinate."""
    returned = scan.field(names.RANGE) > 0
    xyz = np.where(returned[..., None], rays(scan), np.nan).reshape(-1, 3)
    own = {names.SIGNAL: "signal", names.REFLECTIVITY: "reflectivity", names.NEAR_IR: "near_ir"}
    columns = {
        name: scan.field(field).reshape(-1) for field, name in own.items() if field in scan.fields
    }
    rings, columns_of_sweep = returned.shape
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        **columns,
        "ring": np.repeat(np.arange(rings), columns_of_sweep),
        "time": np.tile(scan.timestamp / 1e9, rings),
    }
