"""The recordings of a stored result, of a pair or a site: found, read and searched for poles again.

They are read as in the run, from their present paths: paths in a document are relative to its
folder, so that both may be moved together.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePath
from typing import NamedTuple, TypeVar

import numpy as np
from msgspec import structs

from ..base.datatypes import Scan
from ..base.errors import ReadError, UsageError, naming, printable, readable
from ..base.files import path_in_text, path_of_text, read_document
from ..base.quantities import counted, step_of
from ..base.sensors import is_sensor_file
from ..export import Transform
from ..export.documents import is_result, result_in
from ..export.recording import frames_of, write_mcap
from ..io import ARRAY_SOURCE
from ..result import (
    DEFAULT_CONFIG,
    SITE_REPORT_FILE,
    InputDoc,
    PoleDoc,
    ResultDoc,
    RunConfig,
    any_result_file,
    refusal_of,
)
from ..result.decoding import decode
from ..result.site import LIDARS, SITE_SCHEMA, LidarDoc, RecordingDoc, SiteDoc, as_site
from .inputs import SILENT, Listener, read_input, recording_hash

Loaded = TypeVar("Loaded")
AnyDoc = TypeVar("AnyDoc", ResultDoc, SiteDoc)
Struct = TypeVar("Struct", InputDoc, LidarDoc, RunConfig)

SENSOR_KEYS, ANGLES_KEYS = ("sensor", "sensor_target", "sensor_source"), ("angles", "angles_source")
"""Fields of documents that may name a file about a LiDAR, and those that do."""

SAME_POLE_DISTANCE = 1e-3
"""Poles found again are those of the result if none is farther from it than this, metres."""

MOST_NOTES = 3
"""At most this many recordings that a page does not show are named with the reason; others are
counted."""

MAY_DIFFER = "the picture may not belong to these figures"
"""Note on a page if a recording is not the one of the run."""


@dataclass(frozen=True, eq=False)
class StoredScans:
    """The recordings of a stored run, and the poles found in them.

    Attributes
    ----------
    scans
        For each LiDAR, target and source of a pair, that of each placement; None if there is
        none to show. If the poles found again are not those that the result lists, the detection
        is None.
    notes
        One sentence on each recording that is missing, or has changed; empty if there is none.
    """

    scans: Sequence[Sequence[Scan | None]]
    notes: tuple[str, ...]


class Recording(NamedTuple):
    """A recording of a stored run and its present path, None if there is none to show.

    `fault` is the reason.
    """

    item: RecordingDoc
    path: Path | None
    fault: str


def scans_of(
    document: ResultDoc | SiteDoc,
    relative_to: Path,
    given: Sequence[Path] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> StoredScans:
    """Read the recordings that a result names, and find the poles in them again.

    Those of a pair must all exist. For a site, missing or changed files are left out: the
    others show the site as well.

    Parameters
    ----------
    document, relative_to, given
        As `find_recordings` takes them.
    progress
        Called with the number of the recording that is read, and the number of all.

    Raises
    ------
    ReadError, MissingExtraError
        If a recording of the run cannot be read, and as `find_recordings`.
    UsageError
        As `find_recordings`.
    """
    site, is_site = as_site(document), isinstance(document, SiteDoc)
    rows: list[list[Scan | None]] = [[None] * len(site.placements) for _ in site.lidars]
    recordings = find_recordings(document, relative_to, given)
    for k, (item, path, _) in enumerate(recordings, 1):
        progress(step_of("read", k, len(recordings)))
        if path is not None:
            how = item.reading(site.config.max_points)
            scan = read_input(path, how).search(site.radius_m, for_poles=not site.config.carried)
            listed = site.found[item.lidar][item.placement]
            rows[item.lidar][item.placement] = agreeing(scan, listed.poles) if listed else scan
    faults = dict.fromkeys(each.fault for each in recordings if each.fault)
    notes = [
        f"{fault}; {'the page does not show it' if is_site else MAY_DIFFER}" for fault in faults
    ]
    if is_site and (rest := len(notes[MOST_NOTES:])):
        notes[MOST_NOTES:] = [f"likewise not shown: {counted(rest, 'more recording')}"]
    return StoredScans(rows, tuple(notes))


def find_recordings(
    document: ResultDoc | SiteDoc, relative_to: Path, given: Sequence[Path] = ()
) -> list[Recording]:
    """Use the given recordings, or search for those of a result, as its run read them.

    Parameters
    ----------
    document
        The result document.
    relative_to
        Folder of the result: recordings are looked for by their path from there and from here, and
        by their name there; of several that are found, the one of the run is used.
    given
        Where recordings are now: of a pair, target and source of each placement; of a site, in any
        order: each is identified by its hash.

    Raises
    ------
    ReadError
        Of a pair, where the result does not name a target and a source for each placement, or a
        recording is not found.
    UsageError
        Where not as many recordings are given as the result of a pair has, or one that is none of
        the site's.
    """
    hash_of, found = cache(recording_hash), list[Recording]()
    count, is_site = len(document.inputs), isinstance(document, SiteDoc)
    if not is_site and (not count or count % 2):
        raise ReadError(
            f"the result names {count} inputs, expected a target and a source for each placement"
        )
    if not is_site and given and len(given) != count:
        raise UsageError(
            f"{len(given)} clouds are given, the result has {count}: give TARGET and SOURCE of "
            "each placement, or none to have them looked up"
        )
    known = {hash_of(path): path for path in given} if is_site else {}
    for sha256 in known.keys() - {item.sha256 for item in document.inputs}:
        raise UsageError(
            f"{known[sha256]}: is no recording of this result: none has the SHA-256 {sha256[:12]}…"
        )
    site = with_sensors_from(as_site(document), relative_to)
    for k, item in enumerate(site.inputs):
        if is_site and not (site.found and site.found[item.lidar][item.placement]):
            # The run could not use it, and its page does not show it.
            continue
        try:
            there = known.get(item.sha256) if is_site or not given else given[k]
            path = there or find_recording(item, relative_to)
            fault = difference(item, path, hash_of(path))
            found.append(Recording(item, None if is_site and fault else path, fault))
        except ReadError as error:
            if not is_site:
                raise ReadError(f"{error}; give TARGET and SOURCE") from None
            found.append(Recording(item, None, str(error)))
    return found


def find_recording(item: InputDoc, relative_to: Path) -> Path:
    """Look for one recording of a result; see `find_recordings`."""
    if item.path in ("", ARRAY_SOURCE):
        raise ReadError("a cloud of the run was an array, not a file")
    path = Path(item.path)
    names = dict.fromkeys([relative_to / path, path, relative_to / path.name])
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


def hashes_of(
    document: ResultDoc | SiteDoc, lidars: tuple[str, str] = LIDARS
) -> tuple[tuple[str, str], ...]:
    """Give SHA-256 of two LiDARs, target and source, in each placement that both recorded."""
    site = as_site(document)
    names = [lidar.name for lidar in site.lidars]
    target, source = (names.index(name) for name in lidars)
    hashes = {(each.lidar, each.placement): each.sha256 for each in site.inputs}
    return tuple(
        (sha256, hashes[source, placement])
        for (lidar, placement), sha256 in hashes.items()
        if lidar == target and (source, placement) in hashes
    )


def are_swapped(hashes: Sequence[tuple[str, str]], target: str | Path, source: str | Path) -> bool:
    """Return whether two recordings are those of a run swapped; none is read as one.

    One bag may contain both LiDARs: then nothing is reported.

    Parameters
    ----------
    hashes
        As `hashes_of` gives them.
    target, source
        What is given.

    Raises
    ------
    ReadError
        If one cannot be read.
    """
    if all(first == second for first, second in hashes):
        return False
    given = recording_hash(Path(target)), recording_hash(Path(source))
    return given[::-1] in hashes and given not in hashes


def difference(item: InputDoc, path: Path, sha256: str) -> str:
    """Report that a file with this hash is not the one that the run read; empty if it is."""
    if sha256 == item.sha256:
        return ""
    return (
        f"{printable(str(path))} is not the file that the run read ({item.path}): its SHA-256 "
        f"begins with {sha256[:12]}, that of the run with {item.sha256[:12]}"
    )


def loaded(file: Path, decode: Callable[[bytes], Loaded]) -> Loaded:
    """Read a result document.

    Raises
    ------
    ReadError
        If there is no such file, or it is of another kind; names the file.
    """
    with readable(file):
        data = read_document(file)
    with naming(file):
        return decode(data)


def decode_any(data: bytes) -> ResultDoc | SiteDoc:
    """Read a result document, of two LiDARs or of a site."""
    return result_in(data) or decode(data)


def with_poses(result: str | Path) -> tuple[Path, ResultDoc | SiteDoc]:
    """Find and load a result document that has poses.

    Raises
    ------
    Refusal
        If it was refused.
    ReadError
        As `loaded`.
    """
    file = any_result_file(Path(result))
    document = loaded(file, decode_any)
    if document.status == "refused":
        raise refusal_of(document.reasons, "the calibration was refused, there are no poses: ")
    return file, document


def decode_pair(file: Path, data: bytes) -> ResultDoc:
    """Return a result document of two LiDARs; refuse one of a site."""
    try:
        return decode(data)
    except ReadError:
        if not is_result(data, SITE_SCHEMA):
            raise
        raise ReadError(
            f"is the result of a site, not of two LiDARs; its report is "
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
        A result document, its folder, or another file of a transform.
    given
        Paths of the clouds, target and source of each placement; without, they are searched for as
        by `find_recordings`.
    note
        Called with notes on the output.
    listener
        Receives each cloud once it is read.

    Returns
    -------
    bytes
        An MCAP file.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        If a cloud is not found or cannot be read, or too few or too many are given.
    """
    file = any_result_file(result)
    document = result_in(read_document(file))
    clouds = [(path, DEFAULT_CONFIG.of_target) for path in given]
    if isinstance(document, ResultDoc):
        clouds = []
        for item, path, fault in find_recordings(document, file.parent, given):
            assert path is not None
            clouds.append((path, item.reading(document.config.max_points)))
            if fault:
                note(f"{fault}; {MAY_DIFFER}")
        if len(clouds) > 2:
            note(f"of {len(clouds) // 2} placements, the first is written")
    elif len(clouds) != 2:
        raise UsageError(f"{file} names no clouds; give TARGET and SOURCE")
    frames = []
    for path, how in clouds[:2]:
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


def named_from(document: AnyDoc, folder: Path, relative_to: Path) -> AnyDoc:
    """Name the files of a document by their paths from the folder that it is written to.

    Parameters
    ----------
    document
        Of a pair or of a site.
    folder
        Its future folder.
    relative_to
        Folder to which its paths are relative now; else the working folder.

    Returns
    -------
    AnyDoc
        Names that are not existing files, such as arrays, and files on another drive are kept.
    """

    def name(text: str) -> str:
        return _name(text, folder, relative_to)

    return renamed(document, name, name)


def renamed(
    document: AnyDoc, name: Callable[[str], str], of_lidar: Callable[[str], str] = str
) -> AnyDoc:
    """Rename the files of a document, and those with data of its LiDARs.

    These are files of sensors and of angles.
    """

    def known(of: Struct) -> Struct:
        given = {key: getattr(of, key, None) for key in (*SENSOR_KEYS, *ANGLES_KEYS)}
        files = {k: t for k, t in given.items() if t and (k in ANGLES_KEYS or is_sensor_file(t))}
        return structs.replace(of, **{key: of_lidar(text) for key, text in files.items()})

    inputs = [structs.replace(known(each), path=name(each.path)) for each in document.inputs]
    document = structs.replace(document, inputs=inputs)
    if isinstance(document, SiteDoc):
        config = structs.replace(document.config, site_file=name(document.config.site_file))
        return structs.replace(document, config=config, lidars=[*map(known, document.lidars)])
    return structs.replace(document, config=known(document.config))


def with_sensors_from(document: AnyDoc, folder: Path) -> AnyDoc:
    """Give the files of sensors and of angles of a document by paths that are valid from
    anywhere.

    Parameters
    ----------
    document
        Of a pair or of a site.
    folder
        That contains it.
    """
    return renamed(document, str, lambda text: str((folder / text).resolve()))


def _name(text: str, folder: Path, relative_to: Path) -> str:
    given = path_of_text(text) if text else None
    place = next((p for p in (given and relative_to / given, given) if p and p.exists()), None)
    if place is None:
        return text
    # Links to folders are followed, as the system does when it goes up from one; a link to the
    # file is not: it is the file next to the document.
    real = Path(os.path.realpath(place.parent), place.name)
    try:
        relative = os.path.relpath(real, os.path.realpath(folder))
    except ValueError:
        return path_in_text(real)
    return path_in_text(PurePath(relative).as_posix())
