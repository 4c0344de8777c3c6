"""Lists, CSV or Parquet."""

from pathlib import Path

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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x\n1\n", "no column 'id'"),
        ("id,id\n1,2\n", "the column 'id' is there twice"),
        ("id,y\n1,2\n", "unknown column 'y'"),
        ("id,x\n1\n", "line 2 has not as many cells"),
    ],
)
def test_a_slip_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(ReadError, match=words):
        list(lines_of(str(tmp_path / "list.csv"), ("id", "x"), "id"))
