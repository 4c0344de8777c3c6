"""A whole site against its stored result: each pair of LiDARs is checked, and one answer made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..base.errors import ReadError, Reason, Refusal, naming
from ..base.quantities import step_of
from ..checking.movement import CheckResult, Status
from ..checking.tolerance import Asked
from ..io import sha256_of
from ..result import SITE_RESULT_FILE, RunConfig, refusal_of
from ..result.decoding import decode_site
from ..result.site import SiteDoc
from .checking import check_pair, read_stored
from .inputs import SILENT, Input, InputPair, Listener, read_input
from .site_file import LidarTable, SiteFile, read_site_file
from .site_inputs import site_file_in
from .stored import loaded


class CheckedPair(NamedTuple):
    """Two LiDARs of a site by their names, and what the check of both answers."""

    target: str
    source: str
    answer: CheckResult


@dataclass(frozen=True, eq=False)
class SiteCheck:
    """Whether the LiDARs of a site still stand as they stood.

    Attributes
    ----------
    status
        ``same`` where pairs that are the same join all LiDARs, ``moved`` where a pair moved,
        ``cannot_tell`` otherwise.
    reasons
        Why nothing was checked; empty where pairs were.
    pairs
        Each pair that shared poles when the site was calibrated.
    moved
        LiDARs that stand elsewhere to those of the largest group of which all are the same; empty
        where no group is the largest: then nobody can tell which of them moved.
    untold
        LiDARs of which no pair tells whether they moved.
    """

    status: Status
    reasons: tuple[Reason, ...] = ()
    pairs: tuple[CheckedPair, ...] = ()
    moved: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()


def check_site(
    result: Path,
    site: Path,
    *,
    rotation: float | None = None,
    translation: float | None = None,
    listener: Listener = SILENT,
) -> SiteCheck:
    """Check new recordings of a site against its stored result, pair by pair.

    Parameters
    ----------
    result
        ``site-result.json``, or the folder that holds it.
    site
        The site file of the new recordings, or the folder that holds ``site.toml``. Its LiDARs have
        the names that they have in the result; those that it leaves out are not checked. Of each
        pair the first placement that tells is taken.
    rotation, translation
        Movement that matters, rad and m; None for as little as the data tell.
    listener
        Told of each step as it starts, and of each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        Where the result, the site file or a recording cannot be read, and where the site file has
        no two LiDARs that shared poles when the site was calibrated.
    """
    listener.progress("read")
    document = loaded(result / SITE_RESULT_FILE if result.is_dir() else result, decode_site)
    site = site_file_in(site)
    file = read_site_file(site)
    if document.status == "refused":
        return SiteCheck("cannot_tell", (refusal_of(document.reasons).reason.prefixed("stored"),))
    pairs = list(_pairs(document, file))
    if not pairs:
        known = ", ".join(lidar.name for lidar in document.lidars)
        raise ReadError(
            f"{site}: no two of its LiDARs shared poles when the site was calibrated; the result "
            f"has {known}: name them so"
        )
    exchanged = _exchanged(document, file, site)
    if exchanged is not None:
        return SiteCheck("cannot_tell", (exchanged,))
    recordings = _Recordings(file, site, listener)
    asked = Asked(rotation, translation)
    checked = []
    for k, (target, source) in enumerate(pairs, 1):
        listener.progress(step_of(f"check {target} and {source}", k, len(pairs)))
        stored = read_stored(result, lidars=(target, source))
        tables = recordings.tables[target], recordings.tables[source]
        config = pair_config(document, *tables)
        answer = CheckResult("cannot_tell", ())
        for n in shared_placements(*tables):
            pair = InputPair(recordings.read(target, n), recordings.read(source, n))
            try:
                answer = check_pair(stored, pair, config, asked)
            except Refusal as refusal:
                answer = CheckResult("cannot_tell", (refusal.reason,))
            if answer.status != "cannot_tell":
                break
        checked.append(CheckedPair(target, source, answer))
    return verdict_of(checked, [lidar.name for lidar in document.lidars])


def verdict_of(pairs: Sequence[CheckedPair], lidars: Sequence[str]) -> SiteCheck:
    """Make one answer of those of all pairs.

    Parameters
    ----------
    pairs
        The pairs that were checked.
    lidars
        Names of all LiDARs of the site.
    """
    groups = {name: {name} for name in lidars}
    for target, source, answer in pairs:
        if answer.status == "same" and groups[target] is not groups[source]:
            joined = groups[target] | groups[source]
            groups |= dict.fromkeys(joined, joined)
    sizes = sorted({id(group): len(group) for group in groups.values()}.values(), reverse=True)
    largest = max(groups.values(), key=len)
    is_told = len(sizes) == 1 or sizes[0] > sizes[1]
    of_moved = {(a, b) for a, b, answer in pairs if answer.status == "moved"}
    off = {b if a in largest else a for a, b in of_moved if (a in largest) != (b in largest)}
    # Whoever stands with one that moved, moved with it.
    moved = {name for name in lidars if groups[name] & off} if is_told else set()
    told = largest | moved if is_told else {name for pair in of_moved for name in pair}
    untold = tuple(name for name in lidars if name not in told and len(lidars) > 1)
    status: Status = "moved" if of_moved else "cannot_tell" if untold else "same"
    listed = tuple(name for name in lidars if name in moved)
    return SiteCheck(status, (), tuple(pairs), listed, untold)


def _pairs(document: SiteDoc, file: SiteFile) -> Iterator[tuple[str, str]]:
    """Name the pairs that can be checked by the recordings of a site file."""
    tables = {lidar.name: lidar for lidar in file.lidar}
    for target, source in stored_pairs(document):
        if tables.keys() >= {target, source} and shared_placements(tables[target], tables[source]):
            yield target, source


def _exchanged(document: SiteDoc, file: SiteFile, site: Path) -> Reason | None:
    """Say that a recording is one that the result has of another LiDAR, by its hash."""
    owners: dict[str, set[str]] = {}
    for each in document.inputs:
        owners.setdefault(each.sha256, set()).add(document.lidars[each.lidar].name)
    for lidar in file.lidar:
        for recording in filter(None, lidar.recordings):
            place = site.parent / recording
            known = owners.get(sha256_of(place)) if place.is_file() or place.is_dir() else None
            if known and lidar.name not in known:
                owner = ", ".join(sorted(known))
                return Reason(
                    "swapped",
                    f"{place}, given for {lidar.name}, is the very file that the result has of "
                    f"{owner}; give each LiDAR its own",
                    {"told_by": "hashes", "given_for": lidar.name, "of": owner},
                )
    return None


class _Recordings:
    """The recordings of a site file, each read once."""

    def __init__(self, file: SiteFile, site: Path, listener: Listener) -> None:
        self.tables: Mapping[str, LidarTable] = {lidar.name: lidar for lidar in file.lidar}
        self._given = file, site, listener
        self._read: dict[tuple[str, int], Input] = {}

    def read(self, lidar: str, placement: int) -> Input:
        """Read what a LiDAR recorded in a placement."""
        file, site, listener = self._given
        at = lidar, placement
        if at not in self._read:
            table = self.tables[lidar]
            where = f"{site}: lidar {lidar}, placement {file.placements[placement]}"
            with naming(where, is_said_there=True):
                place = site.parent / table.recordings[placement]
                self._read[at] = read_input(place, table.reading(file.max_points), listener)
        return self._read[at]


def pair_config(stored: SiteDoc, target: LidarTable, source: LidarTable) -> RunConfig:
    """Take the options of a check of two LiDARs: of the poles from the result, else of the file."""
    return RunConfig(
        radius_m=stored.radius_m,
        radius_sigma_m=stored.radius_sigma_m,
        sensor_target=target.sensor,
        sensor_source=source.sensor,
        threshold_target=target.threshold,
        threshold_source=source.threshold,
        target_topic=target.topic,
        source_topic=source.topic,
        unit=target.unit,
        unit_source=source.unit,
    )


def shared_placements(target: LidarTable, source: LidarTable) -> list[int]:
    """Give the indices of the placements that both recorded."""
    both = zip(target.recordings, source.recordings, strict=False)
    return [n for n, recordings in enumerate(both) if all(recordings)]


def stored_pairs(document: SiteDoc) -> list[tuple[str, str]]:
    """Name the pairs that shared poles when the site was calibrated."""
    names = [lidar.name for lidar in document.lidars]
    return [
        (names[each.lidars[0]], names[each.lidars[1]])
        for each in document.pairs
        if each.shared_poles and each.refusal is None
    ]
