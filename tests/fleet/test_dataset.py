"""Rows as Parquet, and back."""

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from retropole.base.errors import NewerError, ReadError
from retropole.fleet.dataset import (
    InputEntry,
    KnownAnswer,
    LidarEntry,
    Row,
    Run,
    Step,
    known_answers,
    partition_of,
    read_rows,
    read_runs,
    write_partition,
)
from retropole.result import BudgetEntry, ErrorAtRange
from tests.fleet.made_up import names_in_first

A, B = names_in_first(2)

EMPTY = Row(id=A, kind="pair", status="error", version="1", libraries="numpy 2")
RUN = Run(id=A, started="2026-01-01T00:00:00", seconds=0.5, host="h", memory_bytes=1)


def full(name: str, rng: np.random.Generator) -> Row:
    """Make a row that has everything, with numbers that no decimal writes."""
    return Row(
        id=name,
        kind="site",
        status="warn",
        codes=["few_points", "small_margin"],
        messages=["σ", "ü"],
        site_file="site.toml",
        site_sha256="0" * 64,
        inputs=[
            InputEntry(lidar="a", placement="1", path="p", sha256="1", sensor="OS1", points=3),
            InputEntry(lidar="b", placement="1", path="q"),
        ],
        latitude_rad=rng.uniform(-1, 1),
        longitude_rad=rng.uniform(-1, 1),
        frame="enu",
        lidars=[
            LidarEntry(
                name="a",
                sensor="OS1",
                T=rng.normal(size=16).tolist(),
                covariance=rng.normal(size=36).tolist(),
                predicted_error=[ErrorAtRange(30.0, rng.uniform())],
                budget=[BudgetEntry("scale", None, rng.uniform(), "1", None, rng.uniform())],
            )
        ],
        sigma_30m_m=rng.uniform(),
        document="{}",
        key="k",
        version="1",
        libraries="numpy 2",
    )


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    rng, out = np.random.default_rng(0), str(tmp_path)
    rows = [full(B, rng), EMPTY]
    write_partition(out, "part-00.parquet", rows, [RUN])
    assert read_rows(out, "part-00.parquet") == {row.id: row for row in rows}
    assert read_runs(out, "part-00.parquet") == {A: RUN}
    assert known_answers(out) == {A: KnownAnswer(None, "error"), B: KnownAnswer("k", "warn")}
    assert read_rows(out, "part-01.parquet") == {}
    first = (tmp_path / "answers/part-00.parquet").read_bytes()
    write_partition(out, "part-00.parquet", rows[::-1], [])
    assert (tmp_path / "answers/part-00.parquet").read_bytes() == first
    assert not (tmp_path / "runs/part-00.parquet").exists()
    write_partition(out, "part-00.parquet", [], [])
    assert known_answers(out) == {}


def test_steps_come_back(tmp_path: Path) -> None:
    run = msgspec.structs.replace(RUN, steps=[Step("read", 0.1)], key="k", attempts=2)
    write_partition(str(tmp_path), "part-00.parquet", [EMPTY], [run])
    assert read_runs(str(tmp_path), "part-00.parquet") == {A: run}


def test_a_partition_follows_from_the_id_alone() -> None:
    names = [partition_of(f"post-{k}") for k in range(2000)]
    assert names[7] == partition_of("post-7")
    counts = np.unique(names, return_counts=True)[1]
    assert (len(counts), counts.max() < 30) == (256, True)


def test_a_site_has_one_row_in_its_own_partition(tmp_path: Path) -> None:
    for rows in ([EMPTY, EMPTY], [msgspec.structs.replace(EMPTY, id="elsewhere")]):
        write_partition(str(tmp_path), "part-00.parquet", rows, [])
        with pytest.raises(ReadError, match="a site appears twice, or in another's place"):
            known_answers(str(tmp_path))


def test_an_answer_has_a_pose_and_nothing_else_has(tmp_path: Path) -> None:
    row = full(B, np.random.default_rng(0))
    two = {"kind": "pair", "lidars": row.lidars * 2}
    faults: list[dict[str, Any]] = [{"status": "refused"}, {"lidars": []}, two]
    for changes in faults:
        with pytest.raises(ValueError, match="poses"):
            Row(**msgspec.structs.asdict(row) | changes)


def test_a_page_whose_bytes_changed_is_named(tmp_path: Path) -> None:
    write_partition(str(tmp_path), "part-00.parquet", [full(B, np.random.default_rng(0))], [])
    path = tmp_path / "answers/part-00.parquet"
    data = bytearray(path.read_bytes())
    column = pq.ParquetFile(path).metadata.row_group(0).column(0)
    data[column.data_page_offset + column.total_compressed_size // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ReadError, match=r"part-00\.parquet: damaged"):
        known_answers(str(tmp_path))


def test_a_partition_of_a_newer_version_is_kept(tmp_path: Path) -> None:
    write_partition(str(tmp_path), "part-00.parquet", [EMPTY], [])
    path = tmp_path / "answers/part-00.parquet"
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({"schema": "retropole/fleet/2"}), path)
    with pytest.raises(
        NewerError, match=r"part-00\.parquet: schema 'retropole/fleet/2' is from a newer"
    ):
        known_answers(str(tmp_path))


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
def test_a_pipe_in_the_place_of_a_partition_is_neither_read_nor_written(tmp_path: Path) -> None:
    write_partition(str(tmp_path), "part-00.parquet", [EMPTY], [])
    path = tmp_path / "answers/part-00.parquet"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ReadError, match="is a named pipe, expected a file"):
        known_answers(str(tmp_path))
    with pytest.raises(ReadError, match="is a named pipe, expected a file"):
        write_partition(str(tmp_path), "part-00.parquet", [EMPTY], [])


@pytest.mark.parametrize("damage", ["cut", "not", "foreign"])
def test_a_damaged_partition_is_named(tmp_path: Path, damage: str) -> None:
    write_partition(str(tmp_path), "part-00.parquet", [EMPTY], [])
    path = tmp_path / "answers/part-00.parquet"
    if damage == "foreign":
        pq.write_table(pa.table({"id": ["a"]}), path)
    else:
        path.write_bytes(path.read_bytes()[:-100] if damage == "cut" else b"PAR1")
    with pytest.raises(ReadError, match=r"part-00\.parquet: .*; remove it"):
        known_answers(str(tmp_path))


def test_other_programs_read_it(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    write_partition(str(tmp_path), "part-00.parquet", [full(B, np.random.default_rng(0))], [])
    query = f"select id, lidars[1].T[4], codes from '{tmp_path}/answers/*.parquet'"
    ((name, x, codes),) = duckdb.sql(query).fetchall()
    assert (name, codes) == (B, ["few_points", "small_margin"])
    assert isinstance(x, float)
