"""The questions that docs/fleet.md puts to a history are answered."""

import re
from pathlib import Path

import pytest

from retropole.fleet.history.store import append
from tests.fleet.history.checks import MOVED, row

pytestmark = pytest.mark.full

duckdb = pytest.importorskip("duckdb", reason="needs the extra fleet")

DOCS = Path(__file__).parents[3] / "docs/fleet.md"


def test_every_query_of_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = {"step": None, "covariance": None, "random": None}
    append(
        str(tmp_path / "history"),
        [
            *(row(k, "lamp-17", step=MOVED) for k in range(3)),
            row(0, "lamp-18"),
            row(1, "lamp-18", status="error", codes=("unreadable",), **nothing),
        ],
    )
    monkeypatch.chdir(tmp_path)
    queries = [
        query
        for block in re.findall(r"```sql\n(.*?)```", DOCS.read_text(), re.DOTALL)
        for query in block.split(";")
        if "'history/" in query
    ]
    assert len(queries) == 4
    newest, missing, lengths, reasons = (
        duckdb.sql(query).to_arrow_table().to_pylist() for query in queries
    )
    assert [(each["id"], each["status"]) for each in newest] == [
        ("lamp-17", "same"),
        ("lamp-18", "error"),
    ]
    assert all(each["id"].startswith("lamp") for each in missing)
    assert [each["mm"] for each in lengths] == pytest.approx([30.0] * 3)
    assert reasons == [{"code": "unreadable", "checks": 1, "sites": 1}]
