"""Documents of a fleet that a disk, a program or a hand damaged: an error, or what they say."""

from __future__ import annotations

import csv
import io
import json
import math
import random
import re
import tomllib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from retropole.api.site_file import read_site_file
from retropole.base import se3
from retropole.base.errors import ReadError, UsageError
from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.dataset import (
    ANSWERS,
    RUNS,
    document_of,
    partition_of,
    partitions_in,
    read_rows,
    read_runs,
)
from retropole.fleet.history import store
from retropole.fleet.history.run import changes_of
from retropole.fleet.network.dataset import find_network, read_nodes
from retropole.fleet.overview import overview_of
from retropole.fleet.report import render_fleet
from retropole.fleet.sites import find_sites
from retropole.result.decoding import check_covariance
from tests.api.test_site_file import HEAD, LIDARS, POINT, SURVEY
from tests.damage import damaged, ended_after
from tests.fleet.fleets import here
from tests.fleet.history.checks import row as check_row
from tests.fleet.made_up import FIRST, made_up_row, names_in_first, write_made_up
from tests.fleet.network.made_up_fleet import write_made_up_fleet
from tests.test_untrusted_documents import edited
from tests.tiers import first_of

LONGEST = 20.0
"""Seconds that no document may take."""

SITE_TOML = (
    f"{HEAD}max_points = 100000\n[poles]\nradius_m = 0.03\n[need]\nwithin_cm = 2\n"
    '[reference]\nframe = "enu"\nlatitude_deg = 52\nlongitude_deg = 4\nheight_m = 1\n'
    f"{LIDARS}{SURVEY}{POINT}"
)

LIST = """\
id,target,source,site,radius_m,sensor_target,unit,max_points,latitude_deg,longitude_deg,time
post-1,a/t.pcd,a/s.pcd,,0.02,VLP-16,m,100000,52.5163,13.3777,2026-11-02T03:00
post-2,b/t.pcd,b/s.pcd,,,,,,,,
quay/west,,,quay/site.toml,,,,,53.5413,9.9841,2026-11-02T03:00:00+01:00
post-3,/abs/t.pcd,/abs/s.pcd,,0.03,auto,mm,,-33.5,151.2,
"""

VALUE = re.compile(r'"[^"\n]*"|-?\d[\w.:+-]*|[a-z]\w*(?=[,\n])')
WORDS = (
    *('""', "nan", "inf", "-inf", "-1", "0", "1e999", "1e308", "9" * 400, "0x10", "1_0", "true"),
    *("[]", "[1]", "{}", '"a"', '"x\\u0000"', '"../.."', "2026-11-02", "2026-13-02", "'\ud7ff'"),
    *("ftp://a/b", '"' + "x" * 5000 + '"', "simplecache::s3://a/b", "0.5", "91", "361", "mast-a"),
)
"""What stands in a text in the place of a value."""

BIG = 2**62
STRANGE: tuple[Callable[[int], Any], ...] = (
    *(lambda n, unit=unit: pa.array([BIG] * n, pa.timestamp(unit)) for unit in ("s", "us", "ns")),
    *(lambda n, at=at: pa.array([at] * n, pa.timestamp("ns", "UTC")) for at in (-BIG, BIG + 1)),
    lambda n: pa.array([1] * n, pa.timestamp("us", "Nowhere/Here")),
    lambda n: pa.array([2**30] * n, pa.date32()),
    lambda n: pa.array([BIG] * n, pa.duration("ns")),
    lambda n: pa.array([b"\xff\xfe"] * n, pa.binary()),
    lambda n: pa.array([b"caf\xe9"] * n, pa.binary()).view(pa.string()),
    *(lambda n, each=each: pa.array([each] * n) for each in (math.nan, math.inf, -1e308, True)),
    *(lambda n, each=each: pa.array([each] * n) for each in (["a"], {"a": 1}, "x" * 10**5, "a")),
    lambda n: pa.array([2**64 - 1] * n, pa.uint64()),
    lambda n: pa.array(["a"] * n).dictionary_encode(),
    lambda n: pa.nulls(n),
)
"""Columns that another program may have written."""


def damaged_text(text: str, dice: random.Random) -> bytes:
    """Damage a text, or put another value in the place of one, some of those that it has."""
    if dice.random() < 0.3:
        return damaged(text.encode(), dice)
    for _ in range(dice.choice((1, 1, 2))):
        values = list(VALUE.finditer(text))
        at, other = dice.choice(values), dice.choice((*WORDS, *[each[0] for each in values] * 2))
        text = f"{text[: at.start()]}{other}{text[at.end() :]}"
    return text.encode("utf-8", "surrogatepass")


def damaged_table(data: bytes, dice: random.Random) -> bytes:
    """Damage the bytes of a Parquet file, its columns, its rows or its values."""
    table = pq.read_table(io.BytesIO(data))
    what, k = dice.randrange(6), dice.randrange(table.num_columns)
    if what == 0:
        return damaged(data, dice)
    name = table.column_names[k]
    if what == 1:
        table = table.set_column(k, name, dice.choice(STRANGE)(len(table)))
    elif what == 2:
        table = table.take(dice.choices(range(len(table)), k=len(table)))
    elif what == 3:
        table = table.remove_column(k)
    else:
        values = json.loads(edited(msgspec.to_builtins(table.column(k).to_pylist()), dice))
        # What the column cannot hold is one of another kind, or of no values.
        for kind in (table.schema.field(k).type, None, pa.null()):
            with suppress(pa.ArrowException, TypeError, AttributeError, ValueError, OverflowError):
                table = table.set_column(k, name, pa.array(values[: len(table)], kind))
                break
    # Some values cannot be written; then only bytes are damaged.
    with suppress(pa.ArrowException):
        return bytes_of(table)
    return damaged(data, dice)


def bytes_of(table: Any) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def as_table(text: str, *numbers: str) -> bytes:
    """Write a CSV list as Parquet, some of its columns as numbers."""
    rows = [
        {
            key: (float(cell) if key in numbers else cell) if cell else None
            for key, cell in row.items()
        }
        for row in csv.DictReader(io.StringIO(text))
    ]
    return bytes_of(pa.Table.from_pylist(rows))


class Whole(NamedTuple):
    """What there is before anything is damaged."""

    answers: bytes
    runs: bytes
    fleet: str
    nodes: str


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    folder, rng = tmp_path_factory.mktemp("whole"), np.random.default_rng(3)
    out = write_made_up(folder / "city", [made_up_row(name, rng) for name in names_in_first(8)])
    fleet = write_made_up_fleet(folder)
    answers, runs = ((out / part / FIRST).read_bytes() for part in (ANSWERS, RUNS))
    return Whole(answers, runs, fleet.dataset, fleet.nodes.read_text())


def hold_site_file(folder: Path, dice: random.Random, whole: Whole) -> None:
    """All that a site file says is taken as it stands there, and workers take it as well."""
    path = folder / "site.toml"
    path.write_bytes(damaged_text(SITE_TOML, dice))
    assert_calibrates(path)
    file = read_site_file(path)
    assert_taken(tomllib.loads(path.read_text()), msgspec.to_builtins(file))
    assert len({each.name for each in file.lidar}) == len(file.lidar)
    assert all(len(each.recordings) == len(file.placements) for each in file.lidar)


def assert_taken(given: Any, taken: Any) -> None:
    """Every value of a document is there, unchanged, and is finite."""
    if isinstance(given, dict):
        for key in given:
            assert_taken(given[key], taken[key])
    elif isinstance(given, list):
        for one, other in zip(given, taken, strict=True):
            assert_taken(one, other)
    else:
        assert given == taken
        assert not isinstance(taken, float) or math.isfinite(taken)


def assert_calibrates(path: Path) -> None:
    """Every site ends in a row, and none in a fault of the program: recordings are not there."""
    sites = find_sites([str(path)])
    out = path.with_name("out")
    summary = calibrate_fleet(sites, str(out), here, drop_others=True)
    rows = [row for part in partitions_in(str(out)) for row in read_rows(str(out), part).values()]
    assert {row.id for row in rows} == {site.id for site in sites}
    assert "internal" not in summary.codes, [row.messages for row in rows]
    if rows:
        render_fleet(overview_of(str(out)))


def hold_csv(folder: Path, dice: random.Random, whole: Whole) -> None:
    path = folder / "list.csv"
    path.write_bytes(damaged_text(LIST, dice))
    assert_listed(path)
    # Numbers are what the cells say.
    rows = csv.DictReader(io.StringIO(path.read_text("utf-8-sig"), newline=""))
    stripped = [{key.strip(): cell.strip() for key, cell in row.items()} for row in rows]
    sites = {site.id: site for site in find_sites([str(path)])}
    assert len(sites) == len(stripped)
    for cells in stripped:
        site = sites[cells["id"]]
        if site.fault:
            continue
        for key, angle in (("latitude_deg", site.latitude), ("longitude_deg", site.longitude)):
            if cells.get(key) or angle is not None:
                assert math.degrees(angle or 0.0) == pytest.approx(float(cells[key]))
        if cells.get("radius_m"):
            assert site.config.radius_m == float(cells["radius_m"])


def hold_table(folder: Path, dice: random.Random, whole: Whole) -> None:
    path = folder / "list.parquet"
    numbers = ("radius_m", "max_points", "latitude_deg", "longitude_deg")
    path.write_bytes(damaged_table(as_table(LIST, *numbers), dice))
    assert_listed(path)


def assert_listed(path: Path) -> None:
    """A site of a list is a pair or a site file, somewhere on earth, or says what is wrong."""
    for site in find_sites([str(path)]):
        places = (site.target, site.source, site.site)
        assert site.fault or [bool(each) for each in places] in ([1, 1, 0], [0, 0, 1])
        assert site.fault.isprintable()
        assert abs(site.latitude or 0.0) <= math.pi / 2
        assert abs(site.longitude or 0.0) <= 2 * math.pi
        assert math.isfinite(site.config.radius_m)
    assert_calibrates(path)


def hold_dataset(folder: Path, dice: random.Random, whole: Whole) -> None:
    """What is read of a dataset is sound, by all that read it."""
    hurt = dice.choice((ANSWERS, ANSWERS, RUNS))
    for part, data in ((ANSWERS, whole.answers), (RUNS, whole.runs)):
        (folder / part).mkdir(exist_ok=True)
        (folder / part / FIRST).write_bytes(damaged_table(data, dice) if part == hurt else data)
    render_fleet(overview_of(str(folder)))
    runs = read_runs(str(folder), FIRST).values()
    assert all(0 <= run.seconds < math.inf for run in runs)
    rows = read_rows(str(folder), FIRST)
    assert any(row.document for row in rows.values()) or hurt == ANSWERS
    for name, row in rows.items():
        if row.document is not None:
            document_of(row.document, row.kind)
        assert (row.id, partition_of(name)) == (name, FIRST)
        assert 0 <= (row.sigma_30m_m or 0.0) < math.inf
        assert abs(row.latitude_rad or 0.0) <= math.pi / 2
    lines = [f"{name}-{role},{name},{role}" for name in rows for role in ("target", "source")]
    nodes = folder / "nodes.csv"
    nodes.write_text("\n".join(["node,site,lidar", *lines]))
    assert_edges(str(folder), nodes)


def assert_edges(dataset: str, nodes: Path) -> None:
    """What a network is made of is poses and covariances, and points that are somewhere."""
    graph = find_network(dataset, read_nodes(str(nodes))).graph
    for T, C in zip(graph.edges.T_i_j, graph.edges.covariance, strict=True):
        se3.rigid(T)
        check_covariance("edge", C)
    for each in (graph.points.world, graph.points.seen, graph.points.covariance):
        assert each is None or np.isfinite(each).all()


def hold_nodes(folder: Path, dice: random.Random, whole: Whole) -> None:
    path = folder / dice.choice(("nodes.csv", "nodes.parquet"))
    if path.suffix == ".csv":
        path.write_bytes(damaged_text(whole.nodes, dice))
    else:
        table = as_table(whole.nodes, "x_m", "y_m", "z_m", "sigma_m")
        path.write_bytes(damaged_table(table, dice))
    assert_edges(whole.fleet, path)


def hold_history(folder: Path, dice: random.Random, whole: Whole) -> None:
    place = str(folder / "history")
    store.append(place, [check_row(k) for k in range(4)])
    (path,) = Path(place).rglob("*.parquet")
    path.write_bytes(damaged_table(path.read_bytes(), dice))
    store.contents(place)
    for _, rows in store.read(place):
        assert all(row.step is None or np.isfinite(row.step).all() for row in rows)
        changes_of(rows)


KINDS = {
    "site file": hold_site_file,
    "list": hold_csv,
    "list as Parquet": hold_table,
    "dataset": hold_dataset,
    "nodes": hold_nodes,
    "history": hold_history,
}


def hold(kind: str, seed: int, folder: Path, whole: Whole) -> str:
    """Damage a document: an error that is documented, or it is taken for what it says."""
    said = ""
    try:
        with ended_after(LONGEST):
            KINDS[kind](folder, random.Random(f"{kind} {seed}"), whole)
    except (ReadError, UsageError) as error:
        said = str(error)
    assert said.isprintable()
    assert len(said) <= 300
    return "error" if said else "taken"


def hold_many(kind: str, seeds: range, folder: Path, whole: Whole) -> None:
    came = Counter[str]()
    for seed in seeds:
        try:
            own = folder / str(seed)
            own.mkdir()
            came[hold(kind, seed, own, whole)] += 1
        except Exception as error:
            raise AssertionError(f"{kind}, seed {seed}: {type(error).__name__}: {error}") from error
    # Neither refuses everything nor takes everything.
    assert 0.05 < came["taken"] / len(seeds) < 0.8, came


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_damaged_is_taken_before(
    kind: str, tmp_path: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = "tests.fleet.test_damaged"
    monkeypatch.setattr(f"{own}.damaged_text", lambda text, dice: text.encode())
    monkeypatch.setattr(f"{own}.damaged_table", lambda data, dice: data)
    assert hold(kind, 0, tmp_path, whole) == "taken"


@pytest.mark.parametrize("kind", first_of(KINDS, 2))
def test_a_damaged_document_is_an_error_or_what_it_says(
    kind: str, tmp_path: Path, whole: Whole
) -> None:
    hold_many(kind, range(12), tmp_path, whole)


@pytest.mark.parametrize(
    "seeds",
    [
        pytest.param(range(100, 150), marks=pytest.mark.full),
        pytest.param(range(150, 600), marks=pytest.mark.nightly),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_documents(kind: str, seeds: range, tmp_path: Path, whole: Whole) -> None:
    hold_many(kind, seeds, tmp_path, whole)
