"""A site file from a folder of recordings, by the names of its folders and files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from importlib.resources import files
from itertools import islice
from pathlib import Path, PurePath
from typing import NamedTuple

from ..base.errors import ReadError, UsageError, printable, readable, said, shortened
from ..base.quantities import counted
from ..io import BAGS, PACKETS, READERS
from ..io.bags import is_rosbag2
from .site_file import decode_site_file

SUFFIXES = frozenset((*READERS, *BAGS, *PACKETS)) - {".txt"}
"""Of recordings. In a folder of recordings a text is somebody's notes; one of points can be written
into the file by hand."""

MOST_ENTRIES = 10_000
"""Of one folder that is looked through: a site has at most a hundred LiDARs."""

NUMBERED = re.compile(r"(?:(?:p|pos|pl|place|placement|position|setup|station)[-_ ]?)?\d+", re.I)
"""What a placement is called: a number, or a word and a number."""

OF_BOTH = re.compile(rf"(.+?)[-_]({NUMBERED.pattern})", re.I)
"""LiDAR and placement in one name."""

TIMED = re.compile(
    r"(?P<date>(?:19|20)\d\d[-_.]?[01]\d[-_.]?[0-3]\d)[-_.T ]?"
    r"(?P<time>[0-2]\d[-_.:]?[0-5]\d(?:[-_.:]?[0-5]\d)?)(?:\.\d+)?Z?(?!\d)"
)
"""When a recording was made, in its name: a date and a time of day."""

SHOWN = 6
"""Number of names that are quoted of what was seen."""


class Draft(NamedTuple):
    """A site file that was drafted.

    Attributes
    ----------
    text
        TOML.
    summary
        What was found, in a line.
    notes
        What was left out, and which recordings are missing.
    """

    text: str
    summary: str
    notes: tuple[str, ...]


Recordings = dict[tuple[str, str], Path]
"""Recordings by LiDAR and placement."""


def draft_site(folder: Path, path: Path) -> Draft:
    """Draft a site file from a folder; nothing is written, and no recording is opened.

    Parameters
    ----------
    folder
        Holds ``LIDAR/PLACEMENT.pcd``, ``PLACEMENT/LIDAR.pcd``, ``LIDAR_PLACEMENT.pcd``,
        ``2026-11-23-06-01-LIDAR.pcd`` with the time of the placement or, of one placement,
        ``LIDAR.pcd``, also if all have one name and a number each (``lidar_1.pcd``); a recording
        may have any format that is read.
    path
        Where the file is going to be: paths in it count from its folder.

    Raises
    ------
    ReadError
        If the folder cannot be read.
    UsageError
        If its names do not show which recording is whose; the message lists what was seen.
    """
    recordings, others = _look_through(folder)
    lidars = _ordered({lidar for lidar, _ in recordings})
    placements = _ordered({placement for _, placement in recordings})
    if len(lidars) < 2:
        raise UsageError(
            f"{folder}: recordings of one LiDAR, {lidars[0]}, in {_list(placements, 'placement')}; "
            "a site has at least two LiDARs"
        )
    text = _written(folder, path, lidars, placements, recordings)
    try:
        decode_site_file(text.encode())
    except (ReadError, UnicodeEncodeError) as error:
        # Names that no site file can hold: too long, not printable, too many.
        raise UsageError(
            f"{folder}: its file names cannot be turned into a site file: {said(error)}"
        ) from None
    missing = [
        f"{lidar} has no recording of placement {placement}"
        for lidar in lidars
        for placement in placements
        if (lidar, placement) not in recordings
    ]
    left_out = [f"{folder}: left out {_quoted(others)}"] if others else []
    summary = f"{_list(lidars, 'LiDAR')}; {_list(placements, 'placement')}"
    return Draft(text, summary, (*left_out, *missing))


def _look_through(folder: Path) -> tuple[Recordings, tuple[str, ...]]:
    """Find recordings, and whose they are; and the names of what is none."""
    files, folders, others = _entries(folder)
    if files and folders:
        raise UsageError(
            f"{folder}: has recordings ({_quoted([f.name for f in files])}) and folders "
            f"({_quoted([f.name for f in folders])}); expected one or the other"
        )
    if files:
        return _by_names(_flat(folder, files)), others
    inner: dict[str, list[Path]] = {}
    for each in folders:
        here, deeper, left = _entries(each)
        # A folder in a folder may be a recording: frames, one a file.
        frames = [d for d in deeper if _entries(d)[0]]
        others += tuple(f"{each.name}/{name}" for name in left)
        if here or frames:
            inner[each.name] = [*here, *frames]
        else:
            others += (each.name,)
    if not inner:
        raise UsageError(
            f"{folder}: has no recordings; expected LIDAR/PLACEMENT.pcd, PLACEMENT/LIDAR.pcd or "
            f"LIDAR_PLACEMENT.pcd, or another of {', '.join(sorted(SUFFIXES))}"
        )
    return _by_names(_nested(folder, inner)), others


def _entries(folder: Path) -> tuple[list[Path], list[Path], tuple[str, ...]]:
    """List recordings, folders, and names of neither; what is hidden, and site files, are not."""
    with readable(folder), os.scandir(folder) as entries:
        names = [entry.name for entry in islice(entries, MOST_ENTRIES + 1)]
    if len(names) > MOST_ENTRIES:
        raise UsageError(f"{folder}: has more than {MOST_ENTRIES} entries, too many for a site")
    files, folders, others = list[Path](), list[Path](), list[str]()
    for name in _ordered(names):
        path = folder / name
        if name.startswith(".") or path.suffix == ".toml":
            continue
        if is_rosbag2(path) or (path.suffix.lower() in SUFFIXES and path.is_file()):
            files.append(path)
        elif path.is_dir():
            folders.append(path)
        else:
            others.append(name)
    return files, folders, tuple(others)


def _flat(folder: Path, files: Sequence[Path]) -> list[tuple[str, str, Path]]:
    """Read LiDAR and placement from the name of each file, or the placement from its time."""
    if all(TIMED.search(_name(path)) for path in files):
        return _by_times(files)
    both = {path: OF_BOTH.fullmatch(_name(path)) for path in files}
    named = [path.name for path, match in both.items() if match]
    others = [path.name for path, match in both.items() if not match]
    if named and others:
        raise UsageError(
            f"{folder}: {_quoted(named)} may be LIDAR_PLACEMENT, {others[0]} is not; name all in "
            "the same way"
        )
    if len({match[1] for match in both.values() if match}) == 1:
        # lidar-1.pcd and lidar-2.pcd: of one LiDAR there is no site, so they are two.
        both = dict.fromkeys(files)
    return [
        (match[1], match[2], path) if match else (_name(path), "1", path)
        for path, match in both.items()
    ]


def _by_times(files: Sequence[Path]) -> list[tuple[str, str, Path]]:
    """Read the LiDAR from the part of a name besides the time; recordings near in time are one
    placement.

    Near is nearer than half of the least time between two recordings of one LiDAR.
    """
    recorded: list[tuple[datetime, str, Path]] = []
    for path in files:
        name = _name(path)
        match = TIMED.search(name)
        assert match is not None
        lidar = (name[: match.start()] + name[match.end() :]).strip("-_. ") or "lidar"
        digits = re.sub(r"\D", "", match["date"] + match["time"]).ljust(14, "0")
        try:
            recorded.append((datetime.strptime(digits, "%Y%m%d%H%M%S"), lidar, path))
        except ValueError:
            raise UsageError(f"{path.name}: {match[0]} is no time") from None
    recorded.sort(key=lambda each: each[:2])
    last: dict[str, datetime] = {}
    least = timedelta.max
    for when, lidar, _ in recorded:
        least = min(least, when - last.get(lidar, datetime.min))
        last[lidar] = when
    found: list[tuple[str, str, Path]] = []
    placement, before = 1, recorded[0][0]
    for when, lidar, path in recorded:
        placement += when - before > least / 2
        before = when
        found.append((lidar, str(placement), path))
    return found


def _nested(folder: Path, inner: Mapping[str, Sequence[Path]]) -> list[tuple[str, str, Path]]:
    """Determine whether the folders are the LiDARs or the placements: the latter have numbers."""
    outer = list(inner)
    within = _ordered({_name(path) for paths in inner.values() for path in paths})
    of_placements = all(NUMBERED.fullmatch(name) for name in outer)
    of_lidars = all(NUMBERED.fullmatch(name) for name in within)
    if of_placements == of_lidars:
        both = "both" if of_lidars else "neither"
        raise UsageError(
            f"{folder}: folders {_quoted(outer)} hold {_quoted(within)}, and {both} look like "
            "numbers of placements; name the placements 1, 2, …, and the LiDARs differently"
        )
    named = [(name, _name(path), path) for name, paths in inner.items() for path in paths]
    return named if of_lidars else [(inside, name, path) for name, inside, path in named]


def _by_names(named: Sequence[tuple[str, str, Path]]) -> Recordings:
    """Find recordings by LiDAR and placement; each has one."""
    found: Recordings = {}
    for lidar, placement, path in named:
        other = found.setdefault((lidar, placement), path)
        if other != path:
            raise UsageError(
                f"{other} and {path} are both {lidar} in placement {placement}; keep one of them"
            )
    return found


def _name(path: Path) -> str:
    """Give the name of a recording without its suffix; a folder has none."""
    return path.name if path.is_dir() else path.stem


def _ordered(names: set[str] | Sequence[str]) -> list[str]:
    """Sort names as people do: 2 before 10."""
    return sorted(
        names, key=lambda name: [(len(p), p) if p.isdigit() else (0, p) for p in _parts(name)]
    )


def _parts(name: str) -> list[str]:
    return [part.lstrip("0") or part for part in re.split(r"(\d+)", name.lower())] + [name]


def _quoted(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(shortened(printable(name), 60) for name in names[:SHOWN]) + more


def _list(names: Sequence[str], what: str) -> str:
    return f"{counted(len(names), what)}: {_quoted(names)}"


def _written(
    folder: Path,
    path: Path,
    lidars: Sequence[str],
    placements: Sequence[str],
    recordings: Recordings,
) -> str:
    """Write the file: what was found, and in comments what may be added."""
    name = printable(folder.resolve().name)[:60].strip() or "site"
    tables = []
    for lidar in lidars:
        table = f'[[lidar]]\nname = {_text(lidar)}\nsensor = "auto"\nrecordings = [\n'
        for placement in placements:
            recording = recordings.get((lidar, placement))
            # With slashes on every system.
            there = recording and PurePath(os.path.relpath(recording, path.parent)).as_posix()
            table += f"  {_text(there or '')},  # placement {placement}\n"
        tables.append(table + "]\n")
    draft = files("retropole.api").joinpath("site_draft.toml").read_text(encoding="utf-8")
    return draft.format(
        name=_text(name),
        placements=", ".join(map(_text, placements)),
        lidars="\n".join(tables),
        first=_text(lidars[0]),
        placement=_text(placements[0]),
    )


def _text(text: str) -> str:
    """Write text as a basic string of TOML."""
    text = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda c: f"\\u{ord(c[0]):04x}", text) + '"'
