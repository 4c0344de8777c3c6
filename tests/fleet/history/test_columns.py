"""What is read by columns is what the rows say, whatever is wrong with some of them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.fleet.history import reading
from retropole.fleet.history.columns import common_of, histories, is_positive
from retropole.fleet.history.run import changes_of, replay
from retropole.fleet.history.store import CheckRow, append, observed, schema
from tests.fleet.history.checks import COMMON, MOVED, RANDOM, SIGMA, row

pytestmark = pytest.mark.full

pa = pytest.importorskip("pyarrow", reason="needs the extra fleet")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra fleet")

NOTHING = {"step": None, "covariance": None, "random": None}


def rows_of(name: str, seed: int) -> list[CheckRow]:
    rng = np.random.default_rng(seed)
    rows = [
        row(k, name, step=SIGMA * rng.normal(size=6) + MOVED * (k >= 9), status="moved" * (k > 8))
        if k > 8
        else row(k, name, step=SIGMA * rng.normal(size=6), used=("poles", "scene")[k % 2])
        for k in range(14)
    ]
    rows[3] = row(3, name, status="error", codes=("unreadable",), **NOTHING)
    rows[4] = row(4, name, status="cannot_tell", codes=("swapped",))
    rows[5] = row(5, name, status="cannot_tell", codes=("too_weak",))
    rows[6] = row(6, name, step=SIGMA, random=np.zeros((6, 6)), covariance=COMMON)
    return rows


@pytest.fixture
def history(tmp_path: Path) -> str:
    """Three sites, of which one was calibrated anew."""
    anew = [row(k, "lamp-3", stored_sha256="a" if k < 4 else "b") for k in range(7)]
    sites = [rows_of("lamp-1", 1), rows_of("lamp-2", 2), anew]
    for some in zip(*(rows[:7] for rows in sites), strict=True):
        append(str(tmp_path), some)
    append(str(tmp_path), [one for rows in sites for one in rows[7:]])
    return str(tmp_path)


def raised(error: ReadError) -> None:
    raise error


def test_columns_say_what_rows_do(history: str) -> None:
    rows = dict(reading.read(history))
    (table,) = reading.tables(history)
    found = list(histories(table, raised))
    assert [one.id for one in found] == [*rows] == ["lamp-1", "lamp-2", "lamp-3"]
    for one in found:
        expected = observed(rows[one.id])
        assert one.checks is not None
        assert one.times == tuple(each.time for each, _ in expected)
        assert one.newest == rows[one.id][-1]
        for name in vars(one.checks):
            ours, theirs = vars(one.checks)[name], [vars(each)[name] for _, each in expected]
            np.testing.assert_allclose(ours, np.array(theirs), rtol=1e-12, atol=1e-18)


def test_a_replay_says_what_each_site_does_alone(history: str) -> None:
    found, damaged = replay(history, ["lamp-3", "lamp-1", "lamp-2"])
    assert not damaged
    assert [site.id for site in found] == ["lamp-1", "lamp-2", "lamp-3"]
    for site, (_, rows) in zip(found, reading.read(history), strict=True):
        alone = changes_of(rows)
        assert [(one.kind, one.onset, one.found) for one in site.watched.events] == [
            (one.kind, one.onset, one.found) for one in alone.watched.events
        ]
    assert found[0].changes


def test_sites_are_read_a_few_at_a_time(history: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = replay(history, ["lamp-1", "lamp-2", "lamp-3"])
    monkeypatch.setattr(reading, "MOST_ROWS", 20)
    tables = [table["id"].unique().to_pylist() for table in reading.tables(history)]
    assert sorted(name for names in tables for name in names) == ["lamp-1", "lamp-2", "lamp-3"]
    assert len(tables) > 1
    apart, _ = replay(history, ["lamp-1", "lamp-2", "lamp-3"])
    assert [site.times for site in apart] == [site.times for site in whole]


def test_files_that_came_since_they_were_listed_are_read(history: str) -> None:
    known = reading.contents(history, ["lamp-1"])
    append(history, [row(20, "lamp-1"), row(20, "lamp-2")])
    ((before, _),) = (replay(history, ["lamp-1"]),)
    after, _ = replay(history, ["lamp-1"], known=known)
    assert [site.times for site in after] == [site.times for site in before]
    assert len(after[0].times) > len(rows_of("lamp-1", 1)) - 3


@pytest.mark.parametrize(
    "bad",
    [
        {"covariance": [0.0] * 37},
        {"random": None},
        {"status": "gone"},
        {"key": "other"},
        {"version": None},
        {"codes": [None]},
        {"step": [float("nan")] * 6},
        {"step": [1e7, 0, 0, 0, 0, 0]},
        {"covariance": list(-np.eye(6).ravel())},
        {"random": [*np.eye(6).ravel()[:-1], -1.0]},
        {"random": [1.0, 2.0, *np.eye(6).ravel()[2:]]},
    ],
)
def test_a_row_that_is_none_is_told_and_left_out(tmp_path: Path, bad: Mapping[str, object]) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    (path,) = tmp_path.rglob("*.parquet")
    rows = pq.ParquetFile(path).read().to_pylist()
    pq.write_table(pa.Table.from_pylist([{**rows[0], **bad}, *rows[1:]], schema()), path)
    told: list[ReadError] = []
    (table,) = reading.tables(str(tmp_path))
    (one,) = histories(table, told.append)
    assert len(one.times) == 2
    by_row: list[ReadError] = []
    list(reading.read(str(tmp_path), None, by_row.append))
    assert [*map(str, told)] == [*map(str, by_row)]
    assert str(path) in str(told[0])


def test_a_time_beyond_the_calendar_is_told(tmp_path: Path) -> None:
    append(str(tmp_path), [row(k) for k in range(3)])
    (path,) = tmp_path.rglob("*.parquet")
    table = pq.ParquetFile(path).read()
    k = table.schema.get_field_index("time")
    micros = pa.array([2**62, *table["time"].cast("int64").to_pylist()[1:]])
    field = table.schema.field(k)
    pq.write_table(table.set_column(k, field, micros.cast(field.type)), path)
    told: list[ReadError] = []
    (found,) = (
        each for table in reading.tables(str(tmp_path)) for each in histories(table, told.append)
    )
    assert (len(found.times), len(told)) == (2, 1)


def test_what_checks_share_is_a_covariance() -> None:
    less = COMMON - 1.5 * RANDOM
    shared = common_of(np.array([RANDOM + COMMON, RANDOM + less]), np.array([RANDOM, RANDOM * 2]))
    np.testing.assert_allclose(shared[0], COMMON, rtol=1e-12, atol=1e-20)
    assert np.linalg.eigvalsh(shared[1]).min() >= -1e-20
    assert is_positive(np.array([COMMON, less - RANDOM, 0.0 * COMMON])).tolist() == [
        True,
        False,
        False,
    ]
