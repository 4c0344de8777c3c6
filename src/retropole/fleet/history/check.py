"""What is watched, and the drift check of one pair as a row.

Of a site of many LiDARs each pair is watched by itself. Nothing that can be wrong with one ends
more than itself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from ...api.checking import pair_config, shared_placements, stored_pairs
from ...api.site_file import LARGEST_SITE_FILE, LidarTable, SiteFile, decode_site_file
from ...api.stored import with_sensors_from
from ...base.errors import ReadError, Refusal, RetropoleError, quoting
from ...base.files import LARGEST_DOCUMENT, read_document
from ...base.version import __version__
from ...result import RESULT_FILE, SITE_RESULT_FILE, result_file
from ...result.decoding import decode_site
from ...result.site import SiteDoc
from ..dataset import Row
from ..sites import ROLES, FleetSite
from ..storage import below, exists, folder_of, is_url, read_bytes, written
from ..work import Check, Hashed, LocalFiles, code_of, local_files
from .store import CheckRow, flat


@dataclass(frozen=True)
class WatchedPair:
    """A pair to watch.

    Attributes
    ----------
    site
        The pair as it is checked; what is wrong with it is its `fault`.
    origin
        Id of the site that it is of: the site's id, or that of a site of many LiDARs.
    lidars
        Target and source by their names in the stored result of a site; None of a pair.
    """

    site: FleetSite
    origin: str
    lidars: tuple[str, str] | None = None


def watched_pairs(
    site: FleetSite, answers: Mapping[str, Row] | None = None
) -> Iterator[WatchedPair]:
    """Give the watched pairs of a site: a pair itself, or each pair of LiDARs with poles in common.

    Parameters
    ----------
    site
        A pair, or a site file of the new recordings.
    answers
        Rows that hold the stored results, by the ids of sites; None if each site names its results,
        or has ``site-result.json`` next to its file.
    """
    if site.kind == "pair" or site.fault:
        fault = site.fault or ("" if answers is None else _unanswered(answers.get(site.id)))
        yield WatchedPair(replace(site, fault=fault), site.id)
        return
    try:
        stored, place = _result_of_site(site, answers)
        file = decode_site_file(read_bytes(site.site, LARGEST_SITE_FILE), Path(site.site).parent)
        yield from _pairs(site, stored, file, place)
    except RetropoleError as error:
        fault = quoting(f"{site.site}: {error}")
        yield WatchedPair(replace(site, fault=fault), site.id)


def _unanswered(stored: Row | None) -> str:
    """State why a pair has no stored result among the answers; empty if it has one."""
    if stored is None:
        return "the answers have no site with this id; calibrate it"
    if stored.kind == "site":
        return "under this id the answers have a site with several LiDARs: give a site file"
    return "" if stored.document else f"it was not calibrated: {', '.join(stored.codes)}"


def _result_of_site(site: FleetSite, answers: Mapping[str, Row] | None) -> tuple[SiteDoc, str]:
    """Read the stored result of a site, and name its place where it has one."""
    if answers is not None:
        row = answers.get(site.id)
        if row is None or row.document is None or row.kind != "site":
            raise ReadError("the answers have no result of a site with this id")
        return decode_site(row.document.encode()), ""
    place = site.result or folder_of(site.site)
    if exists(place, as_folder=True):
        place = below(place, SITE_RESULT_FILE)
    document = decode_site(read_bytes(place, LARGEST_DOCUMENT))
    return with_sensors_from(document, Path(place).parent), place


def _pairs(site: FleetSite, stored: SiteDoc, file: SiteFile, place: str) -> Iterator[WatchedPair]:
    tables = {lidar.name: lidar for lidar in file.lidar}
    shared = stored_pairs(stored)
    if stored.status == "refused" or not shared:
        codes = ", ".join(reason.code for reason in stored.reasons)
        raise ReadError(f"its stored result has no pair with poles in common ({codes})")
    for both in shared:
        given: dict[str, Any] = {"result": place}
        try:
            if not tables.keys() >= {*both}:
                raise ReadError(f"it has no LiDARs {quoting(' and '.join(both))}")
            given |= _recorded(site, stored, *(tables[name] for name in both))
        except ReadError as error:
            given["fault"] = f"{site.site}: {error}"
        name = "/".join((site.id, *both))
        pair = replace(site, id=name, kind="pair", site="", **given)
        yield WatchedPair(pair, site.id, both)


def _recorded(
    site: FleetSite, stored: SiteDoc, target: LidarTable, source: LidarTable
) -> dict[str, Any]:
    """Use the recordings of the first placement that both have, with the options of the file."""
    shared = shared_placements(target, source)
    if not shared:
        raise ReadError(f"no placement of both {target.name} and {source.name}")
    if target.frames or source.frames:
        raise ReadError("frames: a check needs whole recordings")
    recordings = (each.recordings[shared[0]] for each in (target, source))
    places = (below(folder_of(site.site), each) for each in recordings)
    return {**dict(zip(ROLES, places, strict=True)), "config": pair_config(stored, target, source)}


def check_site(
    site: FleetSite, check: Check, report: Callable[[Hashed], None] = lambda hashed: None
) -> CheckRow | None:
    """Check one site, unless the history has this very check.

    Parameters
    ----------
    site
        A pair, and the path of its stored result: ``result.json`` next to the target where it
        names none.
    check
        What to compare it with.
    report
        Called with the hashes of its files before anything is read of what is in them.

    Returns
    -------
    CheckRow or None
        The row, whatever happens; None if the history has it without an error: the
        same recordings and stored result, at the same time.
    """
    tried = _tried(site, check)
    try:
        with local_files(site) as local:
            stored, inputs = _stored(site, check, local), local.inputs()
            target, source = (each.sha256 or "" for each in inputs)
            tried = replace(
                tried,
                # Where the list has no time, it is when the later recording was written.
                time=tried.time if site.time else max(written(site.target), written(site.source)),
                stored_sha256=hashlib.sha256(read_document(stored)).hexdigest(),
                target_sha256=target,
                source_sha256=source,
            )
            report(Hashed(tried.key, inputs, tried.stored_sha256))
            if tried.key in check.known:
                return None
            tried = _checked(site, check, local, stored, tried)
    except Refusal as refusal:
        tried = replace(tried, codes=(refusal.code,), message=quoting(refusal.message))
    except Exception as error:
        code, message = code_of(error)
        tried = replace(tried, status="error", codes=(code,), message=message)
    return tried


def unanswered_check(site: FleetSite, check: Check, row: Row) -> CheckRow:
    """Make the row of a check whose process or worker never answered, from what is known."""
    hashes = [each.sha256 or "" for each in row.inputs] or ["", ""]
    return replace(
        _tried(site, check),
        status="error",
        codes=tuple(row.codes),
        message=row.messages[0] if row.messages else None,
        stored_sha256=row.site_sha256 or "",
        target_sha256=hashes[0],
        source_sha256=hashes[-1],
    )


def _tried(site: FleetSite, check: Check) -> CheckRow:
    """Begin the row of a check that has no result yet."""
    time = datetime.fromisoformat(site.time) if site.time else check.tried
    return CheckRow(site.id, time, "cannot_tell", version=__version__)


def _stored(site: FleetSite, check: Check, local: LocalFiles) -> Path:
    """Bring the stored result to this machine."""
    if check.document is not None:
        return local.keep(check.document.encode(), RESULT_FILE)
    place = site.result or below(folder_of(site.target), RESULT_FILE)
    if not exists(place):
        raise ReadError(
            f"{place}: there is no stored result; give it in a column result, or give the "
            "answers of 'fleet calibrate'"
        )
    if not is_url(place):
        return result_file(Path(place))
    inside = below(place, RESULT_FILE) if exists(place, as_folder=True) else place
    return local.keep(read_bytes(inside, LARGEST_DOCUMENT), place)


def _checked(
    site: FleetSite, check: Check, local: LocalFiles, result: Path, tried: CheckRow
) -> CheckRow:
    from ...api.checking import check_recordings, read_stored

    stored = read_stored(result, lidars=check.lidars)
    if check.lidars is not None:
        stored = stored._replace(config=site.config)
    rotation, translation = check.tolerance
    answer = check_recordings(stored, *local.pair, rotation=rotation, translation=translation)
    names = ("status", "used", "step", "covariance", "random", "chi2", "power")
    return replace(
        tried,
        codes=tuple(reason.code for reason in answer.reasons),
        message=quoting(answer.reasons[0].message) if answer.reasons else None,
        **{name: flat(getattr(answer, name)) for name in names},
    )
