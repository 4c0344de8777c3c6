"""The answers of a fleet as partitioned Parquet, schema ``retropole/fleet/1``.

``answers/part-3f.parquet`` has the rows of all sites whose id has a SHA-256 that begins with
``3f``, in the order of the ids: nothing but the rows decides what a file is, byte for byte. What
differs from run to run, times and machines, lies next to it in ``runs/part-3f.parquet``.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from ..base.errors import ReadError, said
from ..result import BudgetEntry, ErrorAtRange, ResultDoc, encode
from ..result.decoding import decode, decode_site
from ..result.site import SiteDoc, as_site
from .sites import FleetSite, Kind
from .storage import below, names_in, remove, replace_bytes
from .tables import arrow, opened, parquet_of

FLEET_SCHEMA = "retropole/fleet/1"
ANSWERS, RUNS = "answers", "runs"
LARGEST_PARTITION = 2**31
"""Bytes; four thousand rows of a quarter of a megabyte."""

AGAIN = "; remove it, and its sites are calibrated again"
"""What to do about a partition that is damaged."""

AT_RANGE = 30.0
"""Where the errors of sites are compared, m."""

Status = Literal["ok", "warn", "refused", "error"]

Latitude = Annotated[float, Meta(ge=-math.pi / 2, le=math.pi / 2)]
Longitude = Annotated[float, Meta(ge=-math.pi, le=2 * math.pi)]
Length = Annotated[float, Meta(ge=0.0, le=1e12)]
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]


class InputEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One recording; the hash is None if it could not be read."""

    lidar: str
    placement: str
    path: str
    sha256: str | None = None
    sensor: str | None = None
    points: int | None = None


class LidarEntry(msgspec.Struct, frozen=True, kw_only=True):
    """The pose of one LiDAR in the row's frame: `T` 4×4 and `covariance` 6×6, row by row."""

    name: str
    sensor: str
    T: list[float]
    covariance: list[float]
    predicted_error: list[ErrorAtRange]
    budget: list[BudgetEntry]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of one site; equal inputs give an equal row."""

    id: str
    kind: Kind
    status: Status
    codes: list[str] = []
    messages: list[str] = []
    site_file: str | None = None
    site_sha256: str | None = None
    inputs: list[InputEntry] = []
    latitude_rad: Latitude | None = None
    longitude_rad: Longitude | None = None
    frame: str | None = None
    lidars: list[LidarEntry] = []
    sigma_30m_m: Length | None = None
    document: str | None = None
    key: str | None = None
    version: str
    libraries: str

    def __post_init__(self) -> None:
        """Refuse an answer without a pose, and a pose without an answer."""
        count = len(self.lidars)
        if (self.status in ("ok", "warn")) != (count > 0) or (self.kind == "pair" and count > 1):
            raise ValueError(f"a {self.kind} that is {self.status} with {count} poses")


class Step(msgspec.Struct, frozen=True):
    """How long one step took."""

    name: str
    seconds: float


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """How a row came about: no two runs have the same."""

    id: str
    key: str | None = None
    started: str
    seconds: Seconds
    steps: list[Step] = []
    host: str
    memory_bytes: int
    attempts: int = 1


class KnownAnswer(msgspec.Struct, frozen=True):
    """What a dataset has of a site: the key of its inputs, and how it ended."""

    key: str | None
    status: Status


Of = TypeVar("Of", bound=msgspec.Struct)


def partition_of(name: str) -> str:
    """Name the partition of a site: it follows from its id alone."""
    return f"part-{hashlib.sha256(name.encode()).hexdigest()[:2]}.parquet"


def partitions_in(out: str, folder: str = ANSWERS) -> list[str]:
    """Name the partitions that a dataset has, of `ANSWERS` or of `RUNS`."""
    return [name for name in names_in(below(out, folder)) if name.endswith(".parquet")]


def known_answers(out: str) -> dict[str, KnownAnswer]:
    """Read what a dataset has of each site, by id.

    Raises
    ------
    ReadError
        If a partition is damaged or of another schema.
    """
    known: dict[str, KnownAnswer] = {}
    for name in partitions_in(out):
        known |= read_as(out, ANSWERS, name, KnownAnswer)
    return known


def read_rows(out: str, partition: str) -> dict[str, Row]:
    """Read the rows of a partition, by id; none where there is none.

    Raises
    ------
    ReadError
        As `known_answers`.
    """
    return read_as(out, ANSWERS, partition, Row) if partition in partitions_in(out) else {}


def read_runs(out: str, partition: str) -> dict[str, Run]:
    """Read how the rows of a partition came about, by id.

    Raises
    ------
    ReadError
        As `known_answers`.
    """
    return read_as(out, RUNS, partition, Run) if partition in partitions_in(out, RUNS) else {}


def read_as(out: str, folder: str, partition: str, of: type[Of]) -> dict[str, Of]:
    """Read the columns of a partition that a data class has, by id.

    Parameters
    ----------
    out
        Path or URL of the dataset.
    folder
        `ANSWERS` or `RUNS`.
    partition
        Of `partitions_in`.
    of
        Its fields are names of columns; what they hold is checked.

    Raises
    ------
    ReadError
        As `known_answers`.
    """
    place = below(out, folder, partition)
    with opened(place, "damaged ({})", LARGEST_PARTITION, FLEET_SCHEMA, AGAIN) as file:
        rows = file.read(columns=[*dict.fromkeys(("id", *of.__struct_fields__))]).to_pylist()
    try:
        found = {msgspec.convert(row["id"], str): msgspec.convert(row, of) for row in rows}
    except (KeyError, msgspec.ValidationError) as error:
        raise ReadError(f"{place}: damaged ({said(error)}){AGAIN}") from None
    if len(found) < len(rows) or any(partition_of(each) != partition for each in found):
        raise ReadError(f"{place}: damaged (a site appears twice, or in another's place){AGAIN}")
    return found


def write_partition(out: str, partition: str, rows: Iterable[Row], runs: Iterable[Run]) -> None:
    """Write a partition: each file is whole or not there, the answers last.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    for folder, of, each in (
        (RUNS, Run, sorted(runs, key=lambda run: run.id)),
        (ANSWERS, Row, sorted(rows, key=lambda row: row.id)),
    ):
        place = below(out, folder, partition)
        if each:
            replace_bytes(place, parquet_of(map(msgspec.to_builtins, each), _schema(of)))
        elif partition in partitions_in(out, folder):
            remove(place)


@cache
def _schema(of: type[msgspec.Struct]) -> Any:
    """Give the columns of the rows that a data class is of."""
    pa = arrow()
    return pa.schema(_columns(of), metadata={"schema": FLEET_SCHEMA})


def _columns(of: type[msgspec.Struct]) -> list[Any]:
    """Give the fields of a data class as columns, in its order; null is what may be None."""
    pa = arrow()
    columns = []
    for name, kind in get_type_hints(of).items():
        options = set(get_args(kind)) if get_origin(kind) in (Union, UnionType) else {kind}
        (one,) = options - {NoneType}
        columns.append(pa.field(name, _column(one), nullable=NoneType in options))
    return columns


def _column(kind: Any) -> Any:
    """Give the type of a column: of lists, of data classes, of numbers; all else is text."""
    pa = arrow()
    if get_origin(kind) is list:
        return pa.list_(pa.field("item", _column(*get_args(kind)), nullable=False))
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return pa.struct(_columns(kind))
    return {float: pa.float64(), int: pa.int64()}.get(kind, pa.string())


def answered(
    site: FleetSite, document: ResultDoc | SiteDoc, inputs: Sequence[InputEntry]
) -> dict[str, Any]:
    """Give the columns of a row that follow from a result.

    Parameters
    ----------
    site
        What was calibrated.
    document
        Its result.
    inputs
        Its recordings, in the order of the document.
    """
    lidars, frame = _lidars(document), "target"
    latitude, longitude = site.latitude, site.longitude
    if isinstance(document, SiteDoc):
        frame, geodetic = document.frame.name, document.frame.geodetic
        if latitude is None and geodetic is not None:
            latitude, longitude = geodetic.latitude_rad, geodetic.longitude_rad
    errors = chain.from_iterable(lidar.predicted_error for lidar in lidars)
    at_range = [each.sigma_m for each in errors if each.range_m == AT_RANGE]
    return {
        "status": document.status,
        "codes": [reason.code for reason in document.reasons],
        "messages": [reason.message for reason in document.reasons],
        "inputs": [
            msgspec.structs.replace(entry, sensor=read.sensor, points=read.points)
            for entry, read in zip(inputs, document.inputs, strict=True)
        ],
        "latitude_rad": latitude,
        "longitude_rad": longitude,
        "frame": frame if lidars else None,
        "lidars": lidars,
        "sigma_30m_m": max(at_range, default=None),
        # When it was made, and how long it took, is not part of the answer.
        "document": encode(msgspec.structs.replace(document, created="", seconds={})).decode(),
    }


def document_of(text: str, kind: Kind) -> ResultDoc | SiteDoc:
    """Read the result document of a row.

    Raises
    ------
    ReadError
        If it is none.
    """
    return decode(text.encode()) if kind == "pair" else decode_site(text.encode())


def _lidars(document: ResultDoc | SiteDoc) -> list[LidarEntry]:
    """Give the pose of the source in the frame of the target, or of every LiDAR in the site's.

    None if refused.
    """
    return [
        LidarEntry(
            name=each.name,
            sensor=each.sensor,
            T=each.T_site_lidar.ravel().tolist(),
            covariance=each.covariance.ravel().tolist(),
            predicted_error=list(each.predicted_error or ()),
            budget=list(each.budget or ()),
        )
        for each in as_site(document).lidars[isinstance(document, ResultDoc) :]
        if each.T_site_lidar is not None and each.covariance is not None
    ]
