"""One site: files in, a row out. Nothing that can be wrong with it ends more than itself."""

from __future__ import annotations

import hashlib
import os
import platform
import posixpath
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from ..base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, printable, quoting
from ..base.files import LARGEST_DOCUMENT
from ..base.version import __version__
from ..result import RESULT_FILE, SITE_RESULT_FILE, ResultDoc
from ..result.site import SiteDoc
from .dataset import FLEET_SCHEMA, InputEntry, Row, Run, Status, Step, answered, document_of
from .history.store import CheckRow
from .sites import ROLES, FleetSite
from .storage import (
    below,
    fetch,
    folder_of,
    is_url,
    other_protocols,
    read_bytes,
    replace_bytes,
)

if TYPE_CHECKING:
    from ..api.result import CalibrationResult, SiteResult


Doc = TypeVar("Doc", ResultDoc, SiteDoc)


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """What a site is compared with.

    Attributes
    ----------
    tolerance
        Movement that matters, rad and m; None for the least that the data show.
    tried
        When the run began: the time of a site whose recordings have none.
    document
        The stored result itself; None if it is at the path that the site names.
    lidars
        Target and source by their names, of the stored result of a site; None of a pair.
    known
        Keys of the checks that the history has: these are not done again.
    """

    tolerance: tuple[float | None, float | None]
    tried: datetime
    document: str | None = None
    lidars: tuple[str, str] | None = None
    known: list[str] = []


CODES: tuple[tuple[type[Exception], str], ...] = (
    (ReadError, "unreadable"),
    (MissingExtraError, "missing_extra"),
    (RetropoleError, "usage"),
    (MemoryError, "out_of_memory"),
    (OSError, "system"),
    (Exception, "internal"),
)
"""The code of a row that ended in an error, by the first kind that it is of."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker receives: the site, and the key of its present row.

    With a `check` the site is compared with its stored result, and not calibrated. Of `protocols`
    URLs are followed as by whoever gives it.
    """

    site: FleetSite
    check: Check | None = None
    known: str | None = None
    reports: str | None = None
    time_limit: float
    environment: str
    protocols: tuple[str, ...] = ()


class Hashed(msgspec.Struct, frozen=True, tag=True):
    """Inputs have been read as bytes: whatever comes, the row shows which they were."""

    key: str
    inputs: list[InputEntry]
    site_sha256: str | None


class Outcome(msgspec.Struct, frozen=True, tag=True):
    """The outcome of a task: the row of a calibration, or that of a check.

    Neither is there where the existing row is still valid.
    """

    id: str
    row: Row | None = None
    run: Run | None = None
    check: CheckRow | None = None


def task_of(site: FleetSite, time_limit: float, **given: Any) -> Task:
    """Make the task of a site, for a worker that computes with the same settings as the caller."""
    given = {"environment": environment(), "protocols": other_protocols(), **given}
    return Task(site=site, time_limit=time_limit, **given)


@cache
def environment() -> str:
    """Name what the numbers of an answer depend on, in addition to its inputs."""
    libraries = (f"{name} {version(name)}" for name in ("numpy", "scipy", "small_gicp"))
    python = f"Python {platform.python_version()}"
    return ", ".join([f"retropole {__version__}", *libraries, python, platform.machine()])


def answer(task: Task, report: Callable[[Hashed], None] = lambda hashed: None) -> Outcome:
    """Calibrate one site, unless the row that there is was made of the same.

    Parameters
    ----------
    task
        The site, and its data.
    report
        Called with the hashes of its files before anything is read of what is in them.

    Returns
    -------
    Outcome
        With a row, whatever happens.
    """
    import psutil

    start = time.perf_counter()
    hashed: Hashed | None = None
    steps: Mapping[str, float] = {}
    try:
        with local_files(task.site) as local:
            hashed = _hashed(task.site, local)
            report(hashed)
            if hashed.key == task.known and _is_reported(task, hashed):
                return Outcome(task.site.id)
            row, steps = _calibrated(task, local, hashed)
    except Refusal as error:
        row = failed(task.site, "refused", error.code, error.message, hashed)
    except Exception as error:
        row = failed(task.site, "error", *code_of(error), hashed)
    memory = int(psutil.Process().memory_info().rss)
    return Outcome(task.site.id, row, _run(row, time.perf_counter() - start, steps, memory))


def code_of(error: Exception) -> tuple[str, str]:
    """Name what went wrong: its code, and in words."""
    code = next(code for kind, code in CODES if isinstance(error, kind))
    text = str(error)
    if code in ("system", "out_of_memory", "internal"):
        text = f"{type(error).__name__}: {text}"
    return code, quoting(text)


def failed(
    site: FleetSite, status: Status, code: str, message: str, hashed: Hashed | None = None
) -> Row:
    """Make the row of a site without an answer."""
    return _row(
        site,
        hashed,
        status=status,
        codes=[code],
        messages=[message],
        inputs=pair_inputs(site) if hashed is None else hashed.inputs,
        latitude_rad=site.latitude,
        longitude_rad=site.longitude,
    )


def _row(site: FleetSite, hashed: Hashed | None, **columns: Any) -> Row:
    """Make a row of the outcome of a site, with what all rows have."""
    return Row(
        id=site.id,
        kind=site.kind,
        site_file=printable(site.site) if site.site else None,
        site_sha256=None if hashed is None else hashed.site_sha256,
        key=None if hashed is None else hashed.key,
        version=__version__,
        libraries=environment(),
        **columns,
    )


def unanswered(
    site: FleetSite, code: str, message: str, hashed: Hashed | None = None, seconds: float = 0.0
) -> Outcome:
    """Make the outcome of a site whose process or worker never answered."""
    row = failed(site, "error", code, message, hashed)
    return Outcome(site.id, row, _run(row, seconds, {}, 0))


def _run(row: Row, seconds: float, steps: Mapping[str, float], memory: int) -> Run:
    """Describe how the present row was made."""
    started = datetime.now(UTC) - timedelta(seconds=seconds)
    return Run(
        id=row.id,
        key=row.key,
        started=started.isoformat(timespec="milliseconds"),
        seconds=seconds,
        steps=[Step(name, value) for name, value in steps.items()],
        host=socket.gethostname(),
        memory_bytes=memory,
    )


def _hashed(site: FleetSite, local: LocalFiles) -> Hashed:
    """Hash the inputs, and with them all that a row follows from: files, settings, version."""
    site_sha256 = None if local.site is None else hash_of(local.site)
    inputs = local.inputs()
    site = msgspec.structs.replace(site, result="", time="")
    parts = [FLEET_SCHEMA, __version__, site, site_sha256, inputs, local.metadata()]
    key = hashlib.sha256(msgspec.json.encode(parts)).hexdigest()
    return Hashed(key, inputs, site_sha256)


def _calibrated(task: Task, local: LocalFiles, hashed: Hashed) -> tuple[Row, Mapping[str, float]]:
    """Calibrate, and report where that is requested; gives the time of each step too."""
    site, result = task.site, _result(task.site, local)
    if not _is_of(result.document, hashed):
        raise ReadError(f"{site.id}: a recording changed while it was read")
    if task.reports is not None:
        _report(result, below(task.reports, site.id), local.folder / "report")
    columns = answered(site, result.document, hashed.inputs)
    return _row(site, hashed, **columns), result.document.seconds


def _is_of(document: ResultDoc | SiteDoc, hashed: Hashed) -> bool:
    """Whether a result is of these inputs."""
    return [each.sha256 for each in document.inputs] == [each.sha256 for each in hashed.inputs]


def _result(site: FleetSite, local: LocalFiles) -> CalibrationResult | SiteResult:
    """Calibrate, and call the files as they were given."""
    from ..api.calibration import calibrate_site, calibrate_with

    if local.site is not None:
        of_site = calibrate_site(local.site)
        return replace(of_site, document=local.named(of_site.document))
    target, source = local.pair
    of_pair = calibrate_with(target, source, site.config)
    return replace(of_pair, document=local.named(of_pair.document))


def _report(result: CalibrationResult | SiteResult, place: str, folder: Path) -> None:
    """Save a result and its report; to a URL by way of a separate folder."""
    if not is_url(place):
        result.save(place)
        return
    for path in result.save(folder, relative=False):
        replace_bytes(below(place, path.name), path.read_bytes())


def _is_reported(task: Task, hashed: Hashed) -> bool:
    """Whether the result of these inputs is in its folder, or none is requested."""
    if task.reports is None:
        return True
    name = RESULT_FILE if task.site.kind == "pair" else SITE_RESULT_FILE
    place = below(task.reports, task.site.id, name)
    try:
        document = document_of(read_bytes(place, LARGEST_DOCUMENT).decode(), task.site.kind)
    except (ReadError, UnicodeDecodeError):
        return False
    return _is_of(document, hashed) and document.version == __version__


class LocalFiles:
    """The files of a site as local paths.

    Attributes
    ----------
    folder
        Where copies go.
    pair
        Target and source of a pair; nothing of a site file.
    site
        The site file; None of a pair.

    Parameters
    ----------
    site
        What to take.
    folder
        An empty folder.

    Raises
    ------
    ReadError
        If a file is not there.
    """

    def __init__(self, site: FleetSite, folder: Path) -> None:
        self.folder = folder
        self._given: dict[str, str] = {}
        self.pair = [self._take(getattr(site, each), each) for each in ROLES if not site.site]
        self.site = None if not site.site else self._take(site.site, "site")
        if self.site is not None and self.site.is_dir():
            self.site /= "site.toml"

    def _take(self, place: str, into: str) -> Path:
        if not is_url(place):
            return Path(place)
        if into == "site" and not place.endswith(".toml"):
            place = below(place, "site.toml")
        path = fetch(place, self.folder / into)
        self._given[str(path)] = place
        return path

    def inputs(self) -> list[InputEntry]:
        """Hash the recordings; those next to a site file at a URL are copied first.

        Raises
        ------
        ReadError
            If one cannot be read, or the site file is none.
        """
        return [
            InputEntry(
                lidar=lidar,
                placement=placement,
                path=printable(self._given.get(str(path), str(path))),
                sha256=hash_of(path),
            )
            for lidar, placement, path in self._recordings()
        ]

    def _recordings(self) -> Iterator[tuple[str, str, Path]]:
        """Give each recording with its LiDAR and placement."""
        if self.site is None:
            yield from zip(ROLES, ("1", "1"), self.pair, strict=True)
            return
        from ..api.site_file import read_site_file

        file = read_site_file(self.site)
        for lidar in file.lidar:
            for placement, name in zip(file.placements, lidar.recordings, strict=True):
                if name:
                    yield lidar.name, placement, self._brought(self.site, lidar.name, name)

    def _brought(self, site: Path, lidar: str, name: str) -> Path:
        """Bring a recording that a site file names."""
        path, given = site.parent / name, self._given.get(str(site))
        if given is not None:
            inside = posixpath.normpath(name)
            if posixpath.isabs(inside) or inside.split("/")[0] == ".." or "\\" in name:
                raise ReadError(
                    f"{given}: lidar {lidar}: {name}: the files of a site file at a URL "
                    "must be in its folder or below"
                )
            place = below(folder_of(given), inside)
            if not path.exists():
                fetch(place, path.parent)
            self._given[str(path)] = place
        return path

    def metadata(self) -> list[str]:
        """Hash what is next to recordings: metadata of packets, angles and a survey of a site file.

        Raises
        ------
        ReadError
            If one that is named cannot be read.
        """
        metadata = [path.with_suffix(".json") for path in self.pair if path.suffix == ".pcap"]
        found = [path for path in metadata if path.is_file()]
        if self.site is not None:
            from ..api.site_file import read_site_file

            file = read_site_file(self.site)
            if file.survey is not None:
                found.append(self._brought(self.site, "survey", file.survey))
            for lidar in file.lidar:
                if lidar.angles is not None:
                    name = os.path.relpath(lidar.angles, self.site.parent)
                    found.append(self._brought(self.site, lidar.name, name))
        return [hash_of(path) for path in found]

    def renamed(self, text: str) -> str:
        """Call what lies in our folder as it was given."""
        for path in sorted(self._given, key=len, reverse=True):
            text = text.replace(path, self._given[path])
        return text

    def keep(self, data: bytes, place: str) -> Path:
        """Write what was read of the stored result at a place into a separate folder."""
        path = self.folder / "stored" / posixpath.basename(place.rstrip("/"))
        path.parent.mkdir()
        path.write_bytes(data)
        self._given[str(path)] = place
        return path

    def named(self, document: Doc) -> Doc:
        """Call the files of a result document as they were given."""
        from ..api.stored import renamed

        return renamed(document, self.renamed, self.renamed)


@contextmanager
def local_files(site: FleetSite) -> Iterator[LocalFiles]:
    """Bring the files of a site to this machine; what is wrong with one calls it as it was given.

    Raises
    ------
    ReadError
        If a file is not there.
    """
    with tempfile.TemporaryDirectory(prefix="retropole-") as folder:
        local = LocalFiles(site, Path(folder))
        try:
            yield local
        except (Refusal, MissingExtraError):
            raise
        except RetropoleError as error:
            raise type(error)(local.renamed(str(error))) from None


def pair_inputs(site: FleetSite) -> list[InputEntry]:
    """Name the recordings of a pair; of a site file, what it names is not known yet."""
    roles = () if site.kind == "site" else ROLES
    return [
        InputEntry(lidar=role, placement="1", path=printable(getattr(site, role))) for role in roles
    ]


def hash_of(path: Path) -> str:
    """SHA-256 of a file or a folder; whoever only makes tasks has no need of what can read it."""
    from ..api.inputs import recording_hash

    return recording_hash(path)
