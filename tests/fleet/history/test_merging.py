"""Files of months that are over are merged: fewer files, the same rows, whatever happens."""

from pathlib import Path

import fsspec
import pytest

from retropole.base.errors import ReadError
from retropole.fleet.history import merging
from retropole.fleet.history.merging import merge
from retropole.fleet.history.reading import contents, files_of, read, tables
from retropole.fleet.history.store import append
from tests.fleet.history.checks import row

pytestmark = pytest.mark.full

pytest.importorskip("pyarrow", reason="needs the extra fleet")

NAMES = ("lamp-1", "lamp-2", "lamp-3")
MARCH = "month=2026-03"


def rows_of(folder: Path | str) -> list[tuple[str, list[str]]]:
    return [(name, [one.key for one in rows]) for name, rows in read(str(folder))]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*.parquet")}


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """Nine weeks of three sites, a file a week, and a late one of one site."""
    for k in range(9):
        append(str(tmp_path), [row(k, name) for name in NAMES])
    append(str(tmp_path), [row(1, "lamp-2", target_sha256="late")])
    return tmp_path


def test_months_that_are_over_are_merged_once(history: Path) -> None:
    before, rows = files(history), rows_of(history)
    assert merge(str(history), contents(str(history)), MARCH) == 9
    after = files(history)
    assert rows_of(history) == rows
    assert [len([*month.iterdir()]) for month in sorted(history.iterdir())] == [1, 1, 1]
    # That of March is as it was.
    assert len(after.keys() & before.keys()) == 1
    assert merge(str(history), contents(str(history)), MARCH) == 0
    assert files(history) == after


def test_sites_that_are_read_together_stay_together(
    history: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(str(history), [row(k, f"lamp-{n}") for k in range(4) for n in range(4, 8)])
    append(str(history), [row(9, f"lamp-{n}") for n in range(4, 8)])
    rows = rows_of(history)
    monkeypatch.setattr(merging, "MERGED_ROWS", 13)
    merge(str(history), contents(str(history)), MARCH)
    assert rows_of(history) == rows
    held = contents(str(history)).files.values()
    assert {one.first for one in held if len(one.ids) > 3} == {"lamp-4"}


@pytest.mark.parametrize("removed", range(9))
def test_whatever_ends_it_loses_nothing(
    history: Path, monkeypatch: pytest.MonkeyPatch, removed: int
) -> None:
    rows, left = rows_of(history), [removed]

    def some(place: str) -> None:
        if not left[0]:
            raise OSError("no more")
        left[0] -= 1
        Path(place).unlink()

    monkeypatch.setattr(merging, "remove", some)
    with pytest.raises(OSError, match="no more"):
        merge(str(history), contents(str(history)), MARCH)
    monkeypatch.undo()
    assert rows_of(history) == rows
    merge(str(history), contents(str(history)), MARCH)
    assert rows_of(history) == rows
    assert len(files(history)) == 3


def test_two_at_once_lose_nothing(history: Path) -> None:
    rows, seen = rows_of(history), contents(str(history))
    append(str(history), [row(2, "lamp-1", target_sha256="meanwhile")])
    late = rows_of(history)
    assert late != rows
    merge(str(history), contents(str(history)), MARCH)
    assert merge(str(history), seen, MARCH) == 0
    assert rows_of(history) == late


def test_who_looked_before_it_reads_all_rows_after_it(history: Path) -> None:
    seen, faults = contents(str(history)), list[ReadError]()
    merge(str(history), seen, MARCH)
    found = [*tables(str(history), None, faults.append, seen)]
    assert faults == []
    keys = {key for table in found for key in table["key"].to_pylist()}
    assert keys == {key for _, own in rows_of(history) for key in own}


def test_a_file_that_is_replaced_while_others_are_read_is_no_fault(
    history: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, faults = rows_of(history), list[ReadError]()
    found = read(str(history), None, faults.append)
    looked = contents(str(history))
    monkeypatch.setattr(
        "retropole.fleet.history.reading._groups",
        lambda *given: (merge(str(history), looked, MARCH), [frozenset(NAMES)])[1],
    )
    assert [(name, [one.key for one in own]) for name, own in found] == rows
    assert faults == []
    assert sum(map(len, files_of(str(history)))) == 3


def test_what_is_damaged_stays_where_it_is(history: Path) -> None:
    seen = contents(str(history))
    bad = min((history / "month=2026-01").iterdir())
    bad.write_bytes(bad.read_bytes()[:200])
    before = files(history / "month=2026-01")
    assert merge(str(history), seen, MARCH) == 4
    assert files(history / "month=2026-01") == before
    faults: list[ReadError] = []
    merge(str(history), contents(str(history), None, faults.append), MARCH)
    assert bad.exists()
    assert f"{bad}" in str(faults[0])


def test_rows_of_one_key_that_differ_are_both_kept(tmp_path: Path) -> None:
    append(str(tmp_path), [row(0), row(1)])
    append(str(tmp_path), [row(0, chi2=5.0)])
    merge(str(tmp_path), contents(str(tmp_path)), MARCH)
    (held,) = contents(str(tmp_path)).files.values()
    assert held.count == 3


def test_a_history_in_an_object_store_is_merged() -> None:
    history = "memory://merged-history"
    for k in range(4):
        append(history, [row(k, name) for name in NAMES])
    rows = rows_of(history)
    assert merge(history, contents(history), MARCH) == 4
    assert rows_of(history) == rows
    assert len(fsspec.filesystem("memory").find("/merged-history")) == 1
