"""The recordings of a stored result: found, read and searched for poles again, as its run did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..base.datatypes import Placement, PointCloud, Scan
from ..base.errors import ReadError, UsageError, printable
from ..base.files import path_of_text
from ..base.sensors import sensor_or_auto
from ..io import ARRAY_SOURCE, read_cloud, sha256_of
from ..io.units import Unit
from ..pipeline import find_poles
from ..result import InputDoc, PoleDoc, ResultDoc, RunConfig

SAME_POLE_DISTANCE = 1e-3
"""Poles found again are those of the result where none lies further from it than this, metres."""


@dataclass(frozen=True, eq=False)
class StoredInputs:
    """What was recorded and found in each placement of a stored result.

    Attributes
    ----------
    placements
        The first placement first. Where the poles found again in the first are not those that the
        result lists, the detection is None.
    notes
        One sentence on each recording that is not the one of the run; empty where all are.
    """

    placements: tuple[Placement, ...]
    notes: tuple[str, ...]


def placements_of(
    result: ResultDoc,
    beside: Path,
    given: Sequence[Path] = (),
    *,
    progress: Callable[[str], None] = lambda step: None,
) -> StoredInputs:
    """Read the recordings that a result names, and find the poles in them again.

    Parameters
    ----------
    result
        The result document.
    beside
        Folder of the result: recordings are looked for by their path from here and from there, and
        by their name there.
    given
        Recordings to take instead: target and source of each placement.
    progress
        Called with the name of each step as it starts.

    Raises
    ------
    ReadError
        Where the result does not name a target and a source for each placement, or where a
        recording is not found or cannot be read.
    UsageError
        Where not as many recordings are given as the result has.
    """
    if not result.inputs or len(result.inputs) % 2:
        raise ReadError(
            f"the result names {len(result.inputs)} inputs, expected a target and a source for "
            "each placement"
        )
    paths, config = find_inputs(result, beside, given), result.config
    progress("read")
    notes = differing(result, paths)
    target = [_read(path, config.target_topic, config.unit, config) for path in paths[::2]]
    of_source = config.source_topic, config.source_unit
    source = [_read(path, *of_source, config) for path in paths[1::2]]
    progress("extract")
    placements = [
        Placement(_search(*of_target, config), _search(*of_source, config))
        for of_target, of_source in zip(
            zip(target, result.inputs[::2], strict=True),
            zip(source, result.inputs[1::2], strict=True),
            strict=True,
        )
    ]
    first = Placement(
        _agreeing(placements[0].target, result.poles.target),
        _agreeing(placements[0].source, result.poles.source),
    )
    return StoredInputs((first, *placements[1:]), notes)


def find_inputs(result: ResultDoc, beside: Path, given: Sequence[Path] = ()) -> list[Path]:
    """Take the recordings given, or look for those of the result; see `placements_of`."""
    needed = len(result.inputs)
    if given and len(given) != needed:
        raise UsageError(
            f"{len(given)} clouds are given, the result has {needed}: TARGET and SOURCE of each "
            "placement, or none to look for them"
        )
    return list(given) or [_find(item, beside) for item in result.inputs]


def _find(item: InputDoc, beside: Path) -> Path:
    if item.path in ("", ARRAY_SOURCE):
        raise ReadError(
            "a cloud of the run was an array, which is in no file; give TARGET and SOURCE"
        )
    path = Path(item.path)
    names = dict.fromkeys([path, beside / path, beside / path.name])
    places = [path_of_text(str(name)) for name in names]
    for place in places:
        if place.exists():
            return place
    looked = ", ".join(str(place) for place in places)
    raise ReadError(f"{item.path}: not found (looked for {looked}); give TARGET and SOURCE")


def differing(result: ResultDoc, paths: Sequence[Path]) -> tuple[str, ...]:
    """Say which of all its recordings are not those that a run read; each is hashed once."""
    hashes = {path: sha256_of(path) for path in dict.fromkeys(paths)}
    return tuple(
        f"{printable(str(path))} is not the file that the run read ({item.path}): its SHA-256 "
        f"begins {hashes[path][:12]}, that of the run {item.sha256[:12]}; the picture may not be "
        "that of the figures"
        for path, item in zip(paths, result.inputs, strict=True)
        if hashes[path] != item.sha256
    )


def _read(path: Path, topic: str | None, unit: Unit, config: RunConfig) -> PointCloud:
    """Read a recording in its unit, of a bag the topic and frames of the run."""
    frames = None if config.frames is None else slice(*config.frames)
    most = config.max_points
    return read_cloud(path, topic=topic, frames=frames, max_points=most, unit=unit)


def _search(cloud: PointCloud, item: InputDoc, config: RunConfig) -> Scan:
    """Find the poles of a cloud with the sensor and the threshold that the run used."""
    sensor = sensor_or_auto(item.sensor)
    return find_poles(cloud, sensor=sensor, threshold=item.threshold, radius=config.radius_m)


def _agreeing(scan: Scan, listed: Sequence[PoleDoc]) -> Scan:
    """Leave out a detection whose poles are not those of the result, in its order."""
    same = len(scan.poles) == len(listed) and all(
        np.linalg.norm(pole.point - np.array(document.point_m)) < SAME_POLE_DISTANCE
        for pole, document in zip(scan.poles, listed, strict=True)
    )
    return scan if same else replace(scan, detection=None)
