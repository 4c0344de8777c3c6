"""The recordings of the stored result of a site: those of the run, wherever they lie now."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..base.datatypes import Scan
from ..base.errors import ReadError, UsageError
from ..base.quantities import counted, step_of
from ..base.sensors import name_from
from ..result.site import SiteDoc
from .inputs import read_input, recording_hash
from .stored import agreeing, difference, find_recording

MOST_NOTES = 3
"""So many recordings that a page does not show are named with the reason; others are counted."""


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
