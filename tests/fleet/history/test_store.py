"""A history is appended to, never twice, and read as it was written."""

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from retropole.errors import ReadError
from retropole.fleet.history.rows import observed, plain, row_of
from retropole.fleet.history.store import append, read, schema
from tests.fleet.history.checks import row

pa = pytest.importorskip("pyarrow", reason="needs the extra fleet")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra fleet")


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def test_what_was_written_is_read(tmp_path: Path) -> None:
    rows = [row(k) for k in range(6)]
    rows.append(row(6, step=None, covariance=None, random=None, codes=("a", "b"), message="ö"))
    assert append(tmp_path, [*rows, row(2, "lamp-2")]) == 8
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
    append(tmp_path, [row(k) for k in range(3)])
    before = files(tmp_path)
    assert append(tmp_path, [row(k) for k in range(3)]) == 0
    assert files(tmp_path) == before
    assert append(tmp_path, [row(k) for k in range(4)]) == 1
    assert before.items() <= files(tmp_path).items()


def test_there_is_no_history_before_the_first(tmp_path: Path) -> None:
    assert read(tmp_path / "none") == {}


def test_what_is_damaged_is_said(tmp_path: Path) -> None:
    append(tmp_path, [row()])
    (path,) = files(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ReadError, match="no history"):
        read(tmp_path)
    pq.write_table(pa.table({"id": ["a"]}), path)
    with pytest.raises(ReadError, match="not of the schema"):
        read(tmp_path)
    changed = pa.Table.from_pylist(
        [{**pq.ParquetFile(_written(tmp_path, whole)).read().to_pylist()[0], "id": "x"}], schema()
    )
    pq.write_table(changed, path)
    with pytest.raises(ReadError, match="not that of its key"):
        read(tmp_path)


def _written(folder: Path, data: bytes) -> Path:
    (folder / "whole").write_bytes(data)
    return folder / "whole"


@pytest.mark.parametrize(
    ("name", "value"),
    [("step", [np.nan] * 6), ("step", None), ("covariance", list(-np.eye(6).ravel()))],
)
def test_no_step_is_taken_that_is_none(name: str, value: object) -> None:
    with pytest.raises(ReadError, match="lamp-1"):
        row_of({**plain(row()), name: value})


def test_checks_against_an_older_stored_pose_are_left_out() -> None:
    rows = [row(k, stored_sha256="a" if k < 3 else "b") for k in range(5)]
    assert [one.target_sha256 for one, _ in observed(rows[::-1])] == ["t3", "t4"]


def test_only_steps_that_can_be_trusted_count() -> None:
    assert row(0).is_usable
    assert replace(row(1), status="cannot_tell", codes=("too_weak",)).is_usable
    assert not replace(row(1), status="cannot_tell").is_usable
    assert not row(2, codes=("several_minima",)).is_usable
    assert not row(3, step=None, covariance=None, random=None).is_usable


def test_the_first_way_of_being_found_is_the_one_to_compare_with() -> None:
    seen = observed([row(0), row(1, used="scene"), row(2)])
    assert [one.other for _, one in seen] == [False, True, False]
    assert seen[1][1].days - seen[0][1].days == timedelta(days=7) / timedelta(days=1)
