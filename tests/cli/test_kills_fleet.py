"""Commands of sites and fleets that are ended at any moment: nothing torn, and the next goes on."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from retropole.api.site_file import read_site_file
from retropole.fleet.dataset import known_answers, partitions_in, read_rows, read_runs
from retropole.fleet.history import store
from retropole.result.decoding import decode, decode_site
from tests.cli.test_kills import kill, start
from tests.fleet.fleets import ENDS, write_fleet
from tests.fleet.network.made_up_fleet import write_made_up_fleet

pytest.importorskip("distributed", reason="needs the extra fleet")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

IDS = {name for names in ENDS.values() for name in names}

NEW = ("fleet", "calibrate", "city/sites.csv", "--workers", "1", "--out", "new")
CHECK = ("fleet", "check", "city/sites.csv", "--answers", "known", "--workers", "1", "--history")
COMMANDS: dict[str, tuple[object, ...]] = {
    "init": ("site", "init", "posts", "--force"),
    "calibrate": ("site", "calibrate", "posts/site.toml", "--out", "out"),
    "fleet": (*NEW, "--reports", "reports", "--report", "fleet.html"),
    "check": (*CHECK, "history"),
    "report": ("fleet", "report", "known", "--out", "fleet.html"),
    "network": ("fleet", "network", "fleet", "--nodes", "nodes.csv", "--out", "network.parquet"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a site and of a fleet, a dataset of it, and a network."""
    folder = tmp_path_factory.mktemp("whole")
    write_fleet(folder / "city")
    write_made_up_fleet(folder)
    known = (*NEW[:-1], "known")
    posts = ("simulate", "site", "posts", "--lidars", "2", "--seed", "1", "--out", "posts")
    for words in (posts, known, COMMANDS["report"], COMMANDS["network"]):
        done = start(folder, *words)
        assert done.wait(timeout=300) in (0, 4)
    return folder


def assert_whole(folder: Path) -> None:
    """Every file is what it was or what it becomes, from its first byte to its last."""
    for path in folder.rglob("*.html"):
        assert path.read_text().rstrip().endswith("</html>")
    for path in folder.rglob("site-result.json"):
        decode_site(path.read_bytes())
    for path in folder.rglob("[!i-]*/result.json"):
        decode(path.read_bytes())
    read_site_file(folder / "posts/site.toml")
    for out in (str(folder / "known"), str(folder / "new")):
        for part in partitions_in(out):
            assert read_rows(out, part).keys() == read_runs(out, part).keys() <= IDS
    assert known_answers(str(folder / "known")).keys() == IDS
    assert (folder / "network.parquet").read_bytes()[-4:] == b"PAR1"
    for name, rows in store.read(str(folder / "history")):
        # A check that found no answer is tried again, and has another row.
        assert len([row for row in rows if row.status != "error"]) <= 1
        assert name in IDS


def hold(seed: int, whole: Path, folder: Path) -> None:
    """End one command at a random moment; the next run does what is left, all of it."""
    name = kill(whole, folder, seed, COMMANDS, assert_whole, ends=(0, 4))
    if name == "fleet":
        assert known_answers(str(folder / "new")).keys() == IDS
        assert len(list((folder / "reports").rglob("*report.html"))) == 5
    if name == "check":
        assert {each for each, _ in store.read(str(folder / "history"))} == IDS


FEW = {name: COMMANDS[name] for name in ("init", "network")}
FEW["report"] = ("fleet", "report", "fleet", "--out", "fleet.html")


@pytest.mark.full
def test_ended_where_little_is_worked_out(tmp_path: Path) -> None:
    """What needs no recordings of a fleet; the others take long."""
    site, folder = tmp_path / "site", tmp_path / "run"
    site.mkdir()
    write_made_up_fleet(site)
    (site / "posts").mkdir()
    for name in ("a_1.pcd", "a_2.pcd", "b_1.pcd", "b_2.pcd"):
        (site / "posts" / name).touch()
    for words in FEW.values():
        assert start(site, *words).wait(timeout=300) in (0, 4)

    def look(folder: Path) -> None:
        read_site_file(folder / "posts/site.toml")
        assert (folder / "fleet.html").read_text().rstrip().endswith("</html>")
        assert (folder / "network.parquet").read_bytes()[-4:] == b"PAR1"

    assert {kill(site, folder, k, FEW, look, (0, 4)) for k in (0, 5)} == {"network", "report"}


@pytest.mark.parametrize("seed", range(1))
@pytest.mark.full
def test_ended_at_any_moment(seed: int, whole: Path, tmp_path: Path) -> None:
    hold(seed, whole, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [1, *range(100, 160)])
def test_ended_at_many_moments(seed: int, whole: Path, tmp_path: Path) -> None:
    hold(seed, whole, tmp_path)
