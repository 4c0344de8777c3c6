"""Tables as Parquet, on any file system."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from ..base.errors import MissingExtraError, ReadError
from .storage import LARGEST_LIST, read_bytes


def arrow() -> tuple[Any, Any]:
    """Import pyarrow and its Parquet.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("fleet", "a table of a fleet") from None
    return pyarrow, pyarrow.parquet


def parquet_of(rows: Iterable[Mapping[str, Any]], schema: Any) -> bytes:
    """Write rows as one Parquet file; the same rows give the same bytes."""
    pa, pq = arrow()
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), sink, compression="zstd")
    data: bytes = sink.getvalue().to_pybytes()
    return data


@contextmanager
def opened(place: str, fault: str, most: int = LARGEST_LIST) -> Iterator[Any]:
    """Open a Parquet file.

    Parameters
    ----------
    place
        Path or URL.
    fault
        What it is where it cannot be read, with the reason in the place of ``{}``.
    most
        Bytes that it may have.

    Raises
    ------
    ReadError
        Where it cannot be read, or what is read of it meanwhile.
    MissingExtraError
        As `arrow`.
    """
    pa, pq = arrow()
    data = read_bytes(place, most)
    try:
        yield pq.ParquetFile(io.BytesIO(data))
    except (pa.ArrowException, OSError) as error:
        raise ReadError(f"{place}: {fault.format(error)}") from None
