"""A history is appended to, never twice, and read as it was written, but what is unsound."""

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.errors import NewerError, ReadError
from retropole.fleet.history import store
from retropole.fleet.history.store import (
    EPOCH,
    CheckRow,
    append,
    columns_of,
    contents,
    observed,
    row_of,
    schema,
    tables,
)
from retropole.fleet.history.store import read as read_sites
from tests.fleet.history.checks import COMMON, RANDOM, row

pytestmark = pytest.mark.full

pa = pytest.importorskip("pyarrow", reason="needs the extra fleet")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra fleet")


def read(folder: Path, ids: set[str] | None = None) -> dict[str, list[CheckRow]]:
    return dict(read_sites(str(folder), ids))


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def keys_of(folder: Path, name: str) -> set[str]:
    return {*contents(str(folder), lambda fault: None)[1].get(name, b"").decode().split()}


def test_what_was_written_is_read(tmp_path: Path) -> None:
    rows = [row(k) for k in range(6)]
    rows.append(row(6, step=None, covariance=None, random=None, codes=("a", "b"), message="ö"))
    assert append(str(tmp_path), [*rows, row(2, "lamp-2")]) == 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["month=2026-01", "month=2026-02"]
    again = read(tmp_path)
    assert sorted(again) == ["lamp-1", "lamp-2"]
    for one, other in zip(rows, again["lamp-1"], strict=True):
        assert one.key == other.key
        assert (one.time, one.status, one.codes) == (other.time, other.status, other.codes)
        assert (one.used, one.message, one.chi2) == (other.used, other.message, other.chi2)
        for name in ("step", "covariance", "random"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert list(read(tmp_path, {"lamp-2"})) == ["lamp-2"]


def test_the_same_check_twice_adds_nothing(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    before, known = files(tmp_path), keys_of(tmp_path, "lamp-1")
    assert append(str(tmp_path), [row(k) for k in range(3)], known) == 0
    assert files(tmp_path) == before
    assert append(str(tmp_path), [row(k) for k in range(4)], known) == 1
    assert before.items() <= files(tmp_path).items()


def test_the_keys_of_sites(tmp_path: Path) -> None:
    rows = [row(k) for k in range(6)]
    append(str(tmp_path), [*rows, row(0, "lamp-2")])
    assert keys_of(tmp_path, "lamp-1") == {one.key for one in rows}
    assert keys_of(tmp_path, "lamp-3") == set()


def test_the_same_rows_are_the_same_bytes(tmp_path: Path) -> None:
    rows = [row(k) for k in range(3)]
    append(str(tmp_path / "a"), rows)
    append(str(tmp_path / "b"), rows[::-1])
    first, second = (list(files(tmp_path / name).values()) for name in "ab")
    assert first == second


def test_there_is_no_history_before_the_first(tmp_path: Path) -> None:
    assert read(tmp_path / "none") == {}


def test_what_is_damaged_is_reported(tmp_path: Path) -> None:
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
        contents(str(tmp_path), lambda fault: None)
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
        {"covariance": list(-np.eye(6).ravel())},
        {"step": None},
        {"random": None},
        {"status": "gone"},
        {"time": EPOCH},
        {"key": "other"},
        {"version": None},
        {"codes": [None]},
        {"step": [float("nan")] * 6},
        {"step": [1e7, 0, 0, 0, 0, 0]},
        {"random": [-1.0] * 36},
        {"random": [*np.eye(6).ravel()[:-1], -1.0]},
        {"random": [1.0, 2.0, *np.eye(6).ravel()[2:]]},
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
    contents(str(tmp_path), told.append)
    assert len(keys_of(tmp_path, "lamp-1")) == 2
    assert [str(first) in str(each) for each in told] == [True, True]


def test_a_time_beyond_the_calendar_is_reported(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    (path,) = files(tmp_path)
    table = pq.ParquetFile(path).read()
    k = table.schema.get_field_index("time")
    micros = pa.array([2**62, *table["time"].cast("int64").to_pylist()[1:]])
    field = table.schema.field(k)
    pq.write_table(table.set_column(k, field, micros.cast(field.type)), path)
    told: list[ReadError] = []
    ((_, left),) = read_sites(str(tmp_path), None, told.append)
    assert (len(left), len(told)) == (2, 1)


def test_sites_are_read_a_few_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(3):
        append(str(tmp_path), [row(k, name) for name in ("a", "b", "c")])
    append(str(tmp_path), [row(3, "d"), row(4, "a")])
    whole = read(tmp_path)
    monkeypatch.setattr(store, "SITES_PER_BATCH", 1)
    names = [{*table["id"].to_pylist()} for table in tables(str(tmp_path), None, raised)]
    assert sorted(map(sorted, names)) == [["a"], ["b"], ["c"], ["d"]]
    assert read(tmp_path) == whole


def test_files_that_came_since_they_were_listed_are_read(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    known, _ = contents(str(tmp_path))
    append(str(tmp_path), [row(20), row(20, "lamp-2")])
    found = [table["id"].to_pylist() for table in tables(str(tmp_path), ["lamp-1"], raised, known)]
    assert found == [["lamp-1"] * 4]


def test_a_check_that_is_there_twice_counts_once(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    append(str(tmp_path), [row(2), row(3)])
    assert len(read(tmp_path)["lamp-1"]) == 4


def raised(fault: ReadError) -> None:
    raise fault


@pytest.mark.parametrize(
    ("name", "value"),
    [("step", [np.nan] * 6), ("step", None), ("covariance", list(-np.eye(6).ravel()))],
)
def test_no_step_is_taken_that_is_none(name: str, value: object) -> None:
    with pytest.raises(ReadError, match="lamp-1"):
        row_of({**columns_of(row()), name: value})


def test_the_columns_of_a_row_give_it_back() -> None:
    one = row(3, codes=("too_weak",), chi2=4.5, power=0.25, message="ü")
    again = row_of(columns_of(one))
    assert again.key == one.key
    assert again == one
    with pytest.raises(ReadError, match="not that of its key"):
        row_of({**columns_of(one), "time": one.time + timedelta(days=1)})


def test_an_error_does_not_stand_for_the_check() -> None:
    one = row()
    assert replace(one, message="x", status="moved").key == one.key
    failed = [replace(one, status="error", codes=(code,)) for code in ("killed", "time_limit")]
    assert len({one.key, *(each.key for each in failed)}) == 3


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


def test_what_is_not_drawn_anew_is_common_to_all() -> None:
    ((_, one),) = observed([row()])
    np.testing.assert_allclose(one.common, COMMON, atol=1e-18)
    less = replace(row(), covariance=list((RANDOM + COMMON / 2).ravel()))
    mixed = replace(less, random=list((2 * RANDOM).ravel()))
    assert np.linalg.eigvalsh(observed([mixed])[0][1].common).min() >= -1e-20


def _written(folder: Path, data: bytes) -> Path:
    (folder / "whole").write_bytes(data)
    return folder / "whole"
