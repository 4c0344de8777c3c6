"""The recordings of a stored result, of a pair or a site: found, read and searched for poles again.

They are read as the run did, wherever they lie now.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..base.datatypes import Placement, Scan
from ..base.errors import ReadError, UsageError, naming, printable, readable
from ..base.files import path_of_text, read_document
from ..base.quantities import counted, step_of
from ..base.sensors import name_from, sensor_or_auto
from ..export import Transform
from ..export.documents import is_result, result_in
from ..export.recording import frames_of, write_mcap
from ..io import ARRAY_SOURCE, sha256_of
from ..result import DEFAULT_CONFIG, SITE_REPORT_FILE, InputDoc, PoleDoc, ResultDoc, any_result_file
from ..result.decoding import decode
from ..result.site import SITE_SCHEMA, SiteDoc
from .inputs import SILENT, Listener, read_input, recording_hash
from .travelling import with_sensors_from

Loaded = TypeVar("Loaded")

SAME_POLE_DISTANCE = 1e-3
"""Poles found again are those of the result where none lies further from it than this, metres."""

MOST_NOTES = 3
"""So many recordings that a page does not show are named with the reason; others are counted."""


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
    progress: Callable[[str], None] = lambda step: None,
) -> StoredInputs:
    """Read the recordings that a result names, and find the poles in them again.

    Parameters
    ----------
    result
        The result document.
    beside
        Folder of the result: recordings are looked for by their path from there and from here, and
        by their name there; of several that are found, the one of the run is taken.
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
    result = with_sensors_from(result, beside)
    paths, config = find_inputs(result, beside, given), result.config
    progress("read")
    notes = differing(result, paths)
    reads = (config.of_target, config.of_source)
    inputs = [read_input(path, reads[k % 2]) for k, path in enumerate(paths)]
    progress("extract")
    # With the sensor and the threshold that the run used.
    used = [
        replace(each, sensor=sensor_or_auto(item.sensor), threshold=item.threshold)
        for each, item in zip(inputs, result.inputs, strict=True)
    ]
    scans = [each.search(config.radius_m) for each in used]
    scans[:2] = agreeing(scans[0], result.poles.target), agreeing(scans[1], result.poles.source)
    placements = (Placement(*pair) for pair in zip(scans[::2], scans[1::2], strict=True))
    return StoredInputs(tuple(placements), notes)


def find_inputs(result: ResultDoc, beside: Path, given: Sequence[Path] = ()) -> list[Path]:
    """Take the recordings given, or look for those of the result; see `placements_of`."""
    needed = len(result.inputs)
    if given and len(given) != needed:
        raise UsageError(
            f"{len(given)} clouds are given, the result has {needed}: TARGET and SOURCE of each "
            "placement, or none to look for them"
        )
    try:
        return list(given) or [find_recording(item, beside) for item in result.inputs]
    except ReadError as error:
        raise ReadError(f"{error}; give TARGET and SOURCE") from None


def find_recording(item: InputDoc, beside: Path) -> Path:
    """Look for one recording of a result in this folder; see `placements_of`."""
    if item.path in ("", ARRAY_SOURCE):
        raise ReadError("a cloud of the run was an array, which is in no file")
    path = Path(item.path)
    names = dict.fromkeys([beside / path, path, beside / path.name])
    places = [path_of_text(str(name)) for name in names]
    there = [place for place in places if place.exists()]
    if there:
        # From here another file may have the path that counts from the result, or its name.
        same = (place for place in there if len(there) > 1 and _has_hash(place, item.sha256))
        return next(same, there[0])
    looked = ", ".join(str(place) for place in places)
    raise ReadError(f"{item.path}: not found (looked for {looked})")


def _has_hash(place: Path, sha256: str) -> bool:
    with suppress(ReadError):
        return recording_hash(place) == sha256
    return False


def hashes_of(result: ResultDoc) -> tuple[tuple[str, str], ...]:
    """Give SHA-256 of target and source of each placement."""
    hashes = [item.sha256 for item in result.inputs]
    return tuple(zip(hashes[::2], hashes[1::2], strict=False))


def are_swapped(hashes: Sequence[tuple[str, str]], target: str | Path, source: str | Path) -> bool:
    """Tell whether two recordings are those of a run the other way round; none is read as one.

    One bag may hold both LiDARs: then nothing is told.

    Parameters
    ----------
    hashes
        As `hashes_of` gives them.
    target, source
        What is given.

    Raises
    ------
    ReadError
        Where one cannot be read.
    """
    if all(first == second for first, second in hashes):
        return False
    given = recording_hash(Path(target)), recording_hash(Path(source))
    return given[::-1] in hashes and given not in hashes


def differing(result: ResultDoc, paths: Sequence[Path]) -> tuple[str, ...]:
    """Say which of all its recordings are not those that a run read; each is hashed once."""
    hashes = {path: sha256_of(path) for path in dict.fromkeys(paths)}
    faults = (
        difference(item, path, hashes[path])
        for path, item in zip(paths, result.inputs, strict=True)
    )
    return tuple(
        f"{fault}; the picture may not be that of the figures" for fault in faults if fault
    )


def difference(item: InputDoc, path: Path, sha256: str) -> str:
    """Say that a file of this hash is not the one that the run read; empty where it is."""
    if sha256 == item.sha256:
        return ""
    return (
        f"{printable(str(path))} is not the file that the run read ({item.path}): its SHA-256 "
        f"begins {sha256[:12]}, that of the run {item.sha256[:12]}"
    )


def loaded(file: Path, decode: Callable[[bytes], Loaded]) -> Loaded:
    """Read a result document.

    Raises
    ------
    ReadError
        Where there is no such file, or it is none; names the file.
    """
    with readable(file):
        data = read_document(file)
    with naming(file):
        return decode(data)


def decode_any(data: bytes) -> ResultDoc | SiteDoc:
    """Take a result document, of two LiDARs or of a site."""
    return result_in(data) or decode(data)


def decode_pair(file: Path, data: bytes) -> ResultDoc:
    """Take a result document of two LiDARs; says so of one of a site."""
    try:
        return decode(data)
    except ReadError:
        if not is_result(data, SITE_SCHEMA):
            raise
        raise ReadError(
            f"the result of a site, not of two LiDARs; its report is "
            f"{file.with_name(SITE_REPORT_FILE)}, and rp.load_site_result loads it"
        ) from None


def recording_of(
    transform: Transform,
    result: Path,
    given: Sequence[Path] = (),
    note: Callable[[str], None] = lambda note: None,
    listener: Listener = SILENT,
) -> bytes:
    """Read the clouds of the first placement as their run did, and write them with a transform.

    Parameters
    ----------
    transform
        Of the result.
    result
        A result document, the folder that holds it, or another file of a transform.
    given
        Where the clouds are, target and source of each placement; without, they are looked for as
        `find_inputs` does.
    note
        Called with what is to be known of what is written.
    listener
        Told of each cloud once it is read.

    Returns
    -------
    bytes
        An MCAP file.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        Where a cloud is not found or cannot be read, or too few or too many are given.
    """
    file = any_result_file(result)
    document = result_in(read_document(file))
    paths, config = list(given), DEFAULT_CONFIG
    if isinstance(document, ResultDoc):
        document = with_sensors_from(document, file.parent)
        config, paths = document.config, find_inputs(document, file.parent, given)
        for each in differing(document, paths):
            note(each)
        if len(paths) > 2:
            note(f"of {len(paths) // 2} placements, the first is written")
    elif len(paths) != 2:
        raise UsageError(f"{file} names no clouds; give TARGET and SOURCE")
    frames = []
    for path, how in zip(paths[:2], (config.of_target, config.of_source), strict=True):
        read = read_input(path, how, listener).read
        assert read is not None
        frames.append(frames_of(read))
    return write_mcap(transform, *frames)


def agreeing(scan: Scan, listed: Sequence[PoleDoc]) -> Scan:
    """Leave out a detection whose poles are not those of the result, in its order."""
    same = len(scan.poles) == len(listed) and all(
        np.linalg.norm(pole.point - document.point_m) < SAME_POLE_DISTANCE
        for pole, document in zip(scan.poles, listed, strict=True)
    )
    return scan if same else replace(scan, detection=None)


@dataclass(frozen=True, eq=False)
class StoredScans:
    """What was recorded at a stored site, and found in it.

    Attributes
    ----------
    scans
        For each LiDAR, that of each placement; None where there is none to show. Where the poles
        found again are not those that the result lists, the detection is None.
    notes
        One sentence on each recording that is not there, or is another; empty where all are.
    """

    scans: tuple[tuple[Scan | None, ...], ...]
    notes: tuple[str, ...]


def scans_of(
    site: SiteDoc,
    beside: Path,
    given: Sequence[Path] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> StoredScans:
    """Read the recordings that the result of a site names, and find the poles in them again.

    What is not there, or is another file, is left out: the others show the site as well.

    Parameters
    ----------
    site
        The result document.
    beside
        Folder of the result: recordings are looked for as `placements_of` looks for those of two.
    given
        Where recordings are now, in any order: each is told by its hash.
    progress
        Called with which recording of how many is read.

    Raises
    ------
    ReadError, MissingExtraError
        Where a recording of the run cannot be read.
    UsageError
        Where one that is given is not of the run.
    """
    known = {recording_hash(path): path for path in given}
    for sha256 in known.keys() - {item.sha256 for item in site.inputs}:
        raise UsageError(
            f"{known[sha256]}: is no recording of this result: none has its SHA-256, {sha256[:12]}…"
        )
    rows: list[list[Scan | None]] = [[None] * len(site.placements) for _ in site.lidars]
    faults: list[str] = []
    for count, item in enumerate(site.inputs, 1):
        progress(step_of("read", count, len(site.inputs)))
        found = site.found[item.lidar][item.placement] if site.found else None
        if found is None:
            # The run could not use it, and its page does not show it.
            continue
        try:
            path = known.get(item.sha256) or find_recording(item, beside)
            fault = difference(item, path, recording_hash(path))
        except ReadError as error:
            fault = str(error)
        if fault:
            faults.append(fault)
            continue
        how = item.reading(site.config.max_points)._replace(sensor=name_from(beside, item.sensor))
        scan = read_input(path, how).search(site.radius_m)
        rows[item.lidar][item.placement] = agreeing(scan, found.poles)
    notes = [f"{fault}; the page does not show it" for fault in dict.fromkeys(faults)]
    if rest := len(notes[MOST_NOTES:]):
        notes[MOST_NOTES:] = [f"likewise not shown: {counted(rest, 'more recording')}"]
    return StoredScans(tuple(map(tuple, rows)), tuple(notes))
