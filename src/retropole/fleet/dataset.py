"""The answers of a fleet as partitioned Parquet, schema ``retropole/fleet/1``.

``answers/part-3f.parquet`` holds the rows of all sites whose id has a SHA-256 that begins with
``3f``, in the order of the ids: nothing but the rows decides what a file is, byte for byte. What
differs from run to run, times and machines, lies beside it in ``runs/part-3f.parquet``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, Literal, TypeVar

import msgspec

from ..errors import ReadError
from ..result import BudgetEntryDoc, ErrorAtRange
from .parquet import arrow, opened, parquet_of
from .sites import Kind
from .storage import below, names_in, remove, write_bytes

FLEET_SCHEMA = "retropole/fleet/1"
ANSWERS, RUNS = "answers", "runs"
LARGEST_PARTITION = 2**31
"""Bytes; four thousand rows of a quarter of a megabyte."""

AGAIN = "; remove it, and its sites are calibrated again"
"""What to do about a partition that is damaged."""

AT_RANGE = 30.0
"""Where the errors of sites are compared, m."""

Status = Literal["ok", "warn", "refused", "error"]


class InputEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One recording; the hash is None where it could not be read."""

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
    budget: list[BudgetEntryDoc]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """What became of one site; equal inputs give an equal row."""

    id: str
    kind: Kind
    status: Status
    codes: list[str] = []
    messages: list[str] = []
    site_file: str | None = None
    site_sha256: str | None = None
    inputs: list[InputEntry] = []
    latitude_rad: float | None = None
    longitude_rad: float | None = None
    frame: str | None = None
    lidars: list[LidarEntry] = []
    sigma_30m_m: float | None = None
    document: str | None = None
    key: str | None = None
    version: str
    libraries: str


class Step(msgspec.Struct, frozen=True):
    """How long one step took."""

    name: str
    seconds: float


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """How a row came about: no two runs have the same."""

    id: str
    key: str | None = None
    started: str
    seconds: float
    steps: list[Step] = []
    host: str
    memory_bytes: int
    attempts: int = 1


class Known(msgspec.Struct, frozen=True):
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


def known_in(out: str) -> dict[str, Known]:
    """Read what a dataset has of each site, by id.

    Raises
    ------
    ReadError
        Where a partition is damaged or of another schema.
    """
    known: dict[str, Known] = {}
    for name in partitions_in(out):
        known |= read_as(out, ANSWERS, name, Known)
    return known


def read_rows(out: str, partition: str) -> dict[str, Row]:
    """Read the rows of a partition, by id; none where there is none.

    Raises
    ------
    ReadError
        As `known_in`.
    """
    return read_as(out, ANSWERS, partition, Row) if _is_there(out, ANSWERS, partition) else {}


def read_runs(out: str, partition: str) -> dict[str, Run]:
    """Read how the rows of a partition came about, by id.

    Raises
    ------
    ReadError
        As `known_in`.
    """
    return read_as(out, RUNS, partition, Run) if _is_there(out, RUNS, partition) else {}


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
        As `known_in`.
    """
    place = below(below(out, folder), partition)
    rows = _table(place, list({"id": None, **dict.fromkeys(of.__struct_fields__)}))
    try:
        return {row["id"]: msgspec.convert(row, of) for row in rows}
    except (KeyError, msgspec.ValidationError) as error:
        raise ReadError(f"{place}: damaged ({error}){AGAIN}") from None


def write_partition(out: str, partition: str, rows: Iterable[Row], runs: Iterable[Run]) -> None:
    """Write a partition: each file is whole or not there, the answers last.

    Raises
    ------
    OSError
        Where it cannot be written.
    """
    for folder, schema, each in (
        (RUNS, _schemas()[1], sorted(runs, key=lambda run: run.id)),
        (ANSWERS, _schemas()[0], sorted(rows, key=lambda row: row.id)),
    ):
        place = below(below(out, folder), partition)
        if each:
            write_bytes(place, parquet_of(map(msgspec.to_builtins, each), schema))
        elif partition in names_in(below(out, folder)):
            remove(place)


def _is_there(out: str, folder: str, partition: str) -> bool:
    return partition in names_in(below(out, folder))


def _table(place: str, columns: Sequence[str]) -> list[dict[str, Any]]:
    """Read some columns of a file, as rows."""
    with opened(place, f"damaged ({{}}){AGAIN}", LARGEST_PARTITION) as file:
        schema = (file.schema_arrow.metadata or {}).get(b"schema", b"").decode(errors="replace")
        if schema != FLEET_SCHEMA:
            raise ReadError(f"{place}: schema {schema!r}, expected {FLEET_SCHEMA}{AGAIN}")
        rows: list[dict[str, Any]] = file.read(columns=list(columns)).to_pylist()
    return rows


@cache
def _schemas() -> tuple[Any, Any]:
    """Give the columns of the answers, and of the runs."""
    pa, _ = arrow()

    def field(name: str, kind: Any, null: bool = False) -> Any:
        return pa.field(name, kind, nullable=null)

    text, real, whole = pa.string(), pa.float64(), pa.int64()
    numbers, texts = pa.list_(field("item", real)), pa.list_(field("item", text))

    def several(*fields: Any) -> Any:
        return pa.list_(pa.field("item", pa.struct(fields), nullable=False))

    inputs = several(
        field("lidar", text),
        field("placement", text),
        field("path", text),
        field("sha256", text, True),
        field("sensor", text, True),
        field("points", whole, True),
    )
    budget = several(
        field("name", text),
        field("sensor", text, True),
        field("sigma", real),
        field("unit", text),
        field("estimated", real, True),
        field("share_at_30m", real),
    )
    lidars = several(
        field("name", text),
        field("sensor", text),
        field("T", numbers),
        field("covariance", numbers),
        field("predicted_error", several(field("range_m", real), field("sigma_m", real))),
        field("budget", budget),
    )
    answers = (
        *(field("id", text), field("kind", text), field("status", text)),
        *(field("codes", texts), field("messages", texts)),
        *(field("site_file", text, True), field("site_sha256", text, True)),
        field("inputs", inputs),
        *(field("latitude_rad", real, True), field("longitude_rad", real, True)),
        *(field("frame", text, True), field("lidars", lidars)),
        *(field("sigma_30m_m", real, True), field("document", text, True)),
        *(field("key", text, True), field("version", text), field("libraries", text)),
    )
    runs = (
        *(field("id", text), field("key", text, True), field("started", text)),
        *(
            field("seconds", real),
            field("steps", several(field("name", text), field("seconds", real))),
        ),
        *(field("host", text), field("memory_bytes", whole), field("attempts", whole)),
    )
    metadata = {"schema": FLEET_SCHEMA}
    return pa.schema(answers, metadata=metadata), pa.schema(runs, metadata=metadata)
