"""The queries of docs/fleet.md run on a dataset as it is written, and find what is in it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from retropole.fleet.overview import Overview, overview_of
from retropole.result.decoding import decode
from tests.fleet.made_up import write_city
from tests.paths import ROOT

duckdb = pytest.importorskip("duckdb", reason="needs the extra fleet")

PAGE = (ROOT / "docs/fleet.md").read_text(encoding="utf-8")
QUERIES = {
    name.strip(): query
    for block in re.findall(r"```sql\n(.*?)```", PAGE, re.DOTALL)
    for name, query in re.findall(r"-- (.*?)\n(.*?);", block, re.DOTALL)
    if "'fleet/" in query
}


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_city(tmp_path_factory.mktemp("city") / "fleet", 60)


@pytest.fixture(scope="module")
def overview(city: Path) -> Overview:
    return overview_of(str(city))


def asked(query: str, city: Path) -> list[tuple[Any, ...]]:
    """Ask a query of the page, of a dataset that lies elsewhere."""
    assert "'fleet/" in query
    rows: list[tuple[Any, ...]] = duckdb.sql(query.replace("'fleet/", f"'{city}/")).fetchall()
    return rows


@pytest.mark.parametrize("name", QUERIES)
def test_every_query_finds_something(name: str, city: Path) -> None:
    assert asked(QUERIES[name], city)


def test_they_count_as_the_report_does(city: Path, overview: Overview) -> None:
    assert dict(asked(QUERIES["How did it go?"], city)) == overview.statuses
    codes = [code for site in overview.sites for code in site.codes]
    assert dict(asked(QUERIES["Which reasons are the commonest?"], city)) == {
        code: codes.count(code) for code in codes
    }
    worst = [row[0] for row in asked(QUERIES["The worst twenty"], city)]
    assert worst == [site.id for site in overview.worst(20)]


def test_one_answer_is_taken_out(
    city: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overview: Overview
) -> None:
    (code,) = re.findall(r"```python\n(import duckdb.*?)```", PAGE, re.DOTALL)
    (name,) = re.findall(r"id = '([^']*)'", code)
    found = overview.worst(1)[0].id
    monkeypatch.chdir(tmp_path)
    exec(code.replace(name, found).replace("'fleet/", f"'{city}/"), {})
    assert decode((tmp_path / "result.json").read_bytes()).status in ("ok", "warn")
