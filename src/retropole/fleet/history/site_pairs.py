"""The pairs of a site of many LiDARs, each to be watched by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec

from ...api.site_file import LARGEST_SITE_FILE, LidarTable, SiteFile, decode_site_file
from ...base.errors import ReadError, RetropoleError, quoting
from ...base.files import LARGEST_DOCUMENT
from ...result import RunConfig
from ...result.decoding import decode_site
from ...result.folder import SITE_RESULT_FILE
from ...result.site import SiteDoc
from ..dataset import partition_of, read_rows
from ..sites import FleetSite
from ..storage import below, folder_of, is_folder, read_bytes


@dataclass(frozen=True)
class WatchedPair:
    """A pair to watch.

    Attributes
    ----------
    site
        The pair as it is checked; what is wrong with it is its `fault`.
    origin
        Id of the site that it is of: its own, or that of a site of many LiDARs.
    lidars
        Target and source by their names in the stored result of a site; None of a pair.
    """

    site: FleetSite
    origin: str
    lidars: tuple[str, str] | None = None


def watched_pairs(site: FleetSite, answers: str | None = None) -> Iterator[WatchedPair]:
    """Give what is watched of a site: a pair itself, of many LiDARs each pair that shared poles.

    Parameters
    ----------
    site
        A pair, or a site file of the new recordings.
    answers
        Dataset that holds the stored results; None where each site names its own, or has
        ``site-result.json`` beside its file.
    """
    if site.kind == "pair" or site.fault:
        yield WatchedPair(site, site.id)
        return
    try:
        stored, place = _stored(site, answers)
        file = decode_site_file(read_bytes(site.site, LARGEST_SITE_FILE))
        yield from _pairs(site, stored, file, place)
    except RetropoleError as error:
        yield WatchedPair(_faulty(site, quoting(f"{site.site}: {error}")), site.id)


def _faulty(site: FleetSite, fault: str) -> FleetSite:
    return msgspec.structs.replace(site, fault=fault)


def _stored(site: FleetSite, answers: str | None) -> tuple[SiteDoc, str]:
    """Read the stored result of a site, and name its place where it has one."""
    if answers is not None:
        row = read_rows(answers, partition_of(site.id)).get(site.id)
        if row is None or row.document is None or row.kind != "site":
            raise ReadError("the answers have no result of a site of this id")
        return decode_site(row.document.encode()), ""
    place = site.result or folder_of(site.site)
    if is_folder(place):
        place = below(place, SITE_RESULT_FILE)
    return decode_site(read_bytes(place, LARGEST_DOCUMENT)), place


def _pairs(site: FleetSite, stored: SiteDoc, file: SiteFile, place: str) -> Iterator[WatchedPair]:
    names = [lidar.name for lidar in stored.lidars]
    tables = {lidar.name: lidar for lidar in file.lidar}
    shared = [each.lidars for each in stored.pairs if each.shared_poles and each.refusal is None]
    if stored.status == "refused" or not shared:
        codes = ", ".join(reason.code for reason in stored.reasons)
        raise ReadError(f"its stored result has no pair that shares poles ({codes})")
    for i, j in shared:
        both = names[i], names[j]
        pair = FleetSite(
            id="/".join((site.id, *both)),
            kind="pair",
            result=place,
            time=site.time,
            latitude=site.latitude,
            longitude=site.longitude,
        )
        if tables.keys() >= {*both}:
            pair = _recorded(pair, site, stored, *(tables[name] for name in both))
        else:
            pair = _faulty(pair, f"{site.site}: it has no LiDARs {quoting(' and '.join(both))}")
        yield WatchedPair(pair, site.id, both)


def _recorded(
    pair: FleetSite, site: FleetSite, stored: SiteDoc, target: LidarTable, source: LidarTable
) -> FleetSite:
    """Take the recordings of the first placement that both have, with the options of the file."""
    both = zip(target.recordings, source.recordings, strict=False)
    recordings = next(filter(all, both), None)
    if recordings is None:
        return _faulty(pair, f"{site.site}: no placement of both {target.name} and {source.name}")
    if target.frames or source.frames:
        return _faulty(pair, f"{site.site}: frames: a check takes whole recordings")
    folder = folder_of(site.site)
    return msgspec.structs.replace(
        pair,
        target=below(folder, recordings[0]),
        source=below(folder, recordings[1]),
        config=RunConfig(
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
        ),
    )
