"""A history is appended to, never twice, and read as it was written."""

from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import NewerError, ReadError
from retropole.fleet.history.reading import contents
from retropole.fleet.history.reading import read as read_sites
from retropole.fleet.history.store import EPOCH, CheckRow, append, schema
from tests.fleet.history.checks import row

pytestmark = pytest.mark.full

pa = pytest.importorskip("pyarrow", reason="needs the extra fleet")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra fleet")


def read(folder: Path, ids: set[str] | None = None) -> dict[str, list[CheckRow]]:
    return dict(read_sites(str(folder), ids))


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def test_what_was_written_is_read(tmp_path: Path) -> None:
    rows = [row(k) for k in range(6)]
    rows.append(row(6, step=None, covariance=None, random=None, codes=("a", "b"), message="ö"))
    assert append(str(tmp_path), [*rows, row(2, "lamp-2")]) == 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["month=2026-01", "month=2026-02"]
    again = read(tmp_path)
    assert list(again) == ["lamp-1", "lamp-2"]
    for one, other in zip(rows, again["lamp-1"], strict=True):
        assert one.key == other.key
        assert (one.time, one.status, one.codes) == (other.time, other.status, other.codes)
        assert (one.used, one.message, one.chi2) == (other.used, other.message, other.chi2)
        for name in ("step", "covariance", "random"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert list(read(tmp_path, {"lamp-2"})) == ["lamp-2"]


def test_the_same_check_twice_adds_nothing(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    before, known = files(tmp_path), contents(str(tmp_path), {"lamp-1"}).keys_of("lamp-1")
    assert append(str(tmp_path), [row(k) for k in range(3)], known) == 0
    assert files(tmp_path) == before
    assert append(str(tmp_path), [row(k) for k in range(4)], known) == 1
    assert before.items() <= files(tmp_path).items()


def test_the_keys_of_some_sites(tmp_path: Path) -> None:
    rows = [row(k) for k in range(6)]
    append(str(tmp_path), [*rows, row(0, "lamp-2")])
    found = contents(str(tmp_path), {"lamp-1"})
    assert found.keys_of("lamp-1") == {one.key for one in rows}
    assert found.keys_of("lamp-2") == set()


def test_the_same_rows_are_the_same_bytes(tmp_path: Path) -> None:
    rows = [row(k) for k in range(3)]
    append(str(tmp_path / "a"), rows)
    append(str(tmp_path / "b"), rows[::-1])
    first, second = (list(files(tmp_path / name).values()) for name in "ab")
    assert first == second


def test_there_is_no_history_before_the_first(tmp_path: Path) -> None:
    assert read(tmp_path / "none") == {}


def test_what_is_damaged_is_said(tmp_path: Path) -> None:
    append(str(tmp_path), [row()])
    (path,) = files(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ReadError, match="no history"):
        read(tmp_path)
    pq.write_table(pa.table({"id": ["a"]}), path)
    with pytest.raises(ReadError, match="not of the schema"):
        read(tmp_path)
    newer = schema().with_metadata({"schema": "retropole/history/2"})
    pq.write_table(pa.Table.from_pylist([], newer), path)
    with pytest.raises(NewerError, match="update this one"):
        contents(str(tmp_path), {"lamp-1"}, lambda fault: None)
    changed = pa.Table.from_pylist(
        [{**pq.ParquetFile(_written(tmp_path, whole)).read().to_pylist()[0], "id": "x"}], schema()
    )
    pq.write_table(changed, path)
    with pytest.raises(ReadError, match="not that of its key"):
        read(tmp_path)


@pytest.mark.parametrize(
    "bad",
    [
        {"covariance": [0.0] * 37},
        {"step": None},
        {"status": "gone"},
        {"time": EPOCH},
        {"key": "other"},
        {"step": [float("nan")] * 6},
        {"random": [-1.0] * 36},
    ],
)
def test_a_row_that_is_none_is_named_with_its_file_and_left_out(
    tmp_path: Path, bad: dict[str, object]
) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    (path,) = files(tmp_path)
    rows = pq.ParquetFile(path).read().to_pylist()
    pq.write_table(pa.Table.from_pylist([{**rows[0], **bad}, *rows[1:]], schema()), path)
    told: list[ReadError] = []
    ((_, left),) = read_sites(str(tmp_path), {"lamp-1"}, told.append)
    assert {each.key for each in left} == {each["key"] for each in rows[1:]}
    assert str(path) in str(told[0])
    with pytest.raises(ReadError):
        read(tmp_path)


def test_a_file_that_is_damaged_is_named_and_left_out(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(6)])
    first, _ = files(tmp_path)
    first.write_bytes(first.read_bytes()[:100])
    told: list[ReadError] = []
    ((_, left),) = read_sites(str(tmp_path), None, told.append)
    assert len(left) == 2
    assert len(contents(str(tmp_path), {"lamp-1"}, told.append).keys_of("lamp-1")) == 2
    assert [str(first) in str(each) for each in told] == [True, True]


def _written(folder: Path, data: bytes) -> Path:
    (folder / "whole").write_bytes(data)
    return folder / "whole"
