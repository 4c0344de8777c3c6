"""Lists, CSV or Parquet."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from retropole.base.errors import ReadError
from retropole.fleet.tables import lines_of


def test_empty_cells_are_not_there(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("id, x\na, 1\nb,\n")
    pq.write_table(pa.table({"id": ["a", "b"], "x": ["1", None]}), tmp_path / "list.parquet")
    for name in ("list.csv", "list.parquet"):
        lines = lines_of(str(tmp_path / name), ("id", "x"), "id")
        assert [line.cells for line in lines] == [{"id": "a", "x": "1"}, {"id": "b"}]


def test_columns_of_other_programs_are_taken_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "list.parquet"

    def read(name: str, column: Any) -> list[object]:
        pq.write_table(pa.table({"id": ["a"]} | {name: column}), path)
        return [line.cells.get(name) for line in lines_of(str(path), ("id", "time"), "id")]

    told = datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)
    assert read("time", pa.array([1_700_000_000_123_456_789], pa.timestamp("ns", "UTC"))) == [told]
    for column in (
        pa.array([2**61], pa.timestamp("us")),
        pa.array([2**30], pa.date32()),
        pa.array([b"caf\xe9"]).view(pa.string()),
    ):
        with pytest.raises(ReadError, match=r"list\.parquet: is not Parquet that can be read: "):
            read("time", column)
    for column in (pa.array([b"a"]), pa.array([1.5]), pa.array([["a"]])):
        with pytest.raises(ReadError, match=r"row 1, id: .*expected a name"):
            read("id", column)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x\n1\n", "no column 'id'"),
        ("id,id\n1,2\n", "the column 'id' appears twice"),
        ("id,y\n1,2\n", "unknown column 'y'"),
        ("id,x\n1\n", "line 2 has not as many cells"),
    ],
)
def test_a_slip_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(ReadError, match=words):
        list(lines_of(str(tmp_path / "list.csv"), ("id", "x"), "id"))
