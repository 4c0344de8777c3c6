"""Which sites to check, and the drift check of one as a row.

A site that cannot be read or told is a row too: nothing ends the others.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

from ... import __version__
from ...errors import ReadError, Refusal, RetropoleError, UsageError, quoting
from ...export.documents import result_file
from ...files import read_document
from ...io import sha256_of
from ...monitoring.tolerance import DEFAULT_TOLERANCE, Tolerance
from . import store
from .rows import LONGEST_ID, CheckRow

COLUMNS = ("id", "target", "source", "result")

LATEST = datetime(2200, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class WatchedSite:
    """A site to check: its name, the new recordings, and what they are checked against.

    `time` is when they were recorded; None takes when the later of the two files was written.
    """

    id: str
    target: Path
    source: Path
    result: Path
    time: datetime | None = None


def find_sites(path: Path) -> list[WatchedSite]:
    """Read which sites to check.

    Parameters
    ----------
    path
        A CSV or Parquet list with the columns id, target, source, result and, if known, time (ISO
        8601), its paths relative to its own folder. Or a folder of folders, one for each site,
        with result.json, and recordings named target and source (``target.pcd``, ``source/``).

    Raises
    ------
    ReadError
        Where it is no such list.
    UsageError
        Where two sites have one name, or there is none.
    """
    if path.is_dir():
        sites = list(_in_folder(path))
    else:
        rows = _parquet(path) if path.suffix == ".parquet" else _csv(path)
        sites = [_listed(path, number, row) for number, row in enumerate(rows, start=1)]
    if not sites:
        raise UsageError(f"{path}: no site with result.json, target and source")
    counted = Counter(site.id for site in sites)
    name, count = counted.most_common(1)[0]
    if count > 1:
        raise UsageError(f"{path}: {count} sites are called {name!r}")
    return sites


def _in_folder(folder: Path) -> Iterator[WatchedSite]:
    for site in sorted(folder.iterdir()):
        recordings = [
            sorted(site.glob(f"{name}.*")) + [p for p in (site / name,) if p.is_dir()]
            for name in ("target", "source")
        ]
        if (site / "result.json").is_file() and all(len(found) == 1 for found in recordings):
            yield WatchedSite(site.name, recordings[0][0], recordings[1][0], site / "result.json")


def _csv(path: Path) -> list[dict[str, object]]:
    try:
        text = read_document(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ReadError(f"{path}: a list of sites is CSV (UTF-8) or Parquet") from None
    return [dict(row) for row in csv.DictReader(io.StringIO(text))]


def _parquet(path: Path) -> list[dict[str, object]]:
    pa, pq = store.arrow()
    try:
        return list(pq.read_table(path).to_pylist())
    except pa.ArrowException as error:
        raise ReadError(f"{path}: no Parquet: {error}") from None


def _listed(path: Path, number: int, row: dict[str, object]) -> WatchedSite:
    values = [row.get(name) for name in COLUMNS]
    if not all(isinstance(value, str) and value for value in values):
        raise ReadError(f"{path}, site {number}: expected the columns {', '.join(COLUMNS)}")
    name, *paths = (str(value) for value in values)
    if len(name) > LONGEST_ID:
        raise ReadError(f"{path}, site {number}: an id of more than {LONGEST_ID} characters")
    target, source, result = (path.parent / each for each in paths)
    return WatchedSite(name, target, source, result, _time(path, number, row.get("time")))


def _time(path: Path, number: int, given: object) -> datetime | None:
    """Read a time; without a zone it is UTC."""
    if given is None or given == "":
        return None
    try:
        time = given if isinstance(given, datetime) else datetime.fromisoformat(str(given))
    except ValueError:
        raise ReadError(f"{path}, site {number}: {given!r} is no time (ISO 8601)") from None
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    if not datetime(1970, 1, 1, tzinfo=UTC) <= time < LATEST:
        raise ReadError(f"{path}, site {number}: {given!r} is no time of a recording")
    return time


def check_site(
    site: WatchedSite, *, tolerance: Tolerance = DEFAULT_TOLERANCE, history: Path | None = None
) -> CheckRow | None:
    """Check one site; whatever goes wrong is said in its row.

    None where `history` has this very check already: the same recordings and stored result.
    """
    # What could not even be read has no other time than that of the attempt.
    time = site.time or datetime.now(UTC).replace(microsecond=0)
    tried = CheckRow(site.id, time, "error", version=__version__)
    try:
        paths = result_file(site.result), site.target, site.source
        hashes = [sha256_of(path) for path in paths]
        tried = replace(
            tried,
            time=site.time or _recorded(site),
            stored_sha256=hashes[0],
            target_sha256=hashes[1],
            source_sha256=hashes[2],
        )
        if history is not None and tried.key in _known(history, f"{tried.time:%Y-%m}"):
            return None
        return _checked(site, tried, tolerance)
    except Refusal as refusal:
        return replace(
            tried, status="cannot_tell", codes=(refusal.code,), message=quoting(refusal.message)
        )
    except (RetropoleError, OSError, MemoryError) as error:
        return replace(tried, message=quoting(f"{error}" or type(error).__name__))


@lru_cache(maxsize=4)
def _known(history: Path, month: str) -> set[str]:
    return store.keys(history, [f"month={month}"])


def _recorded(site: WatchedSite) -> datetime:
    """Give when the later recording was written, to the second."""
    files = [
        each
        for path in (site.target, site.source)
        for each in (path.rglob("*") if path.is_dir() else (path,))
    ]
    latest = max((each.stat().st_mtime for each in files), default=0.0)
    return datetime.fromtimestamp(int(latest), UTC)


def _checked(site: WatchedSite, tried: CheckRow, tolerance: Tolerance) -> CheckRow:
    from ...api.checking import checked, read_stored, topic_for
    from ...api.inputs import read_input

    stored = read_stored(site.result)
    config = stored.config
    target = read_input(
        site.target,
        sensor=config.sensor_target,
        threshold=config.threshold_target,
        topic=topic_for(site.target, None, config.target_topic),
        unit=config.unit,
    )
    source = read_input(
        site.source,
        sensor=config.sensor_source,
        threshold=config.threshold_source,
        topic=topic_for(site.source, None, config.source_topic),
        unit=config.source_unit,
    )
    answer = checked(stored, target, source, tolerance)
    words = [reason.message for reason in answer.reasons]
    return replace(
        tried,
        status=answer.status,
        used=answer.used,
        codes=tuple(reason.code for reason in answer.reasons),
        message=quoting(words[0]) if words else None,
        step=answer.step,
        covariance=answer.covariance,
        random=answer.random,
        chi2=answer.chi2,
        power=answer.power,
    )
