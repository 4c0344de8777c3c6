"""The paper as files: every exhibit with its pictures, an index of all, or those asked for."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
import pytest
from click.testing import CliRunner

from studies.paper import experiments, reproduce, write_exhibit
from studies.paper.__main__ import fewer, paper
from studies.paper.exhibit import Exhibit
from tests.paths import ROOT
from tests.studies.paper.exhibits import all_exhibits

pytestmark = pytest.mark.full

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def names_of(data: Path | None = None) -> list[str]:
    return [name for each in experiments(1, data) for name in each.names]


def test_an_exhibit_is_written_as_markdown_csv_and_pictures(tmp_path: Path) -> None:
    def draw(figure: "Figure") -> None:
        figure.subplots().plot([0, 1], [0, 1])

    exhibit = Exhibit("t", "A title", ("a",), ((1,),), "Note.", draw)
    written = write_exhibit(exhibit, tmp_path)
    assert [path.name for path in written] == ["t.md", "t.csv", "t.png", "t.svg"]
    assert (tmp_path / "t.csv").read_text() == exhibit.csv()
    assert (tmp_path / "t.md").read_text() == exhibit.markdown()
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "t.svg").read_text()


@pytest.mark.nightly
def test_the_command_writes_an_index_of_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exhibits = list(all_exhibits().values())
    monkeypatch.setattr("studies.paper.__main__.reproduce", lambda *given, only: exhibits)
    done = CliRunner().invoke(paper, ["--seeds", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    index = (tmp_path / "index.md").read_text()
    for words in (
        "Table I:",
        "Table II:",
        "Fig. 4",
        "Fig. 5",
        "Table III and Fig. 6:",
        "Fig. 7:",
        "Simulated e_rt",
    ):
        assert words in index
    for name in index.split("](")[1:]:
        assert (tmp_path / name.split(")")[0]).is_file()


def test_experiments_make_what_they_say() -> None:
    assert list(all_exhibits()) == names_of()


@pytest.mark.parametrize(("seeds", "scenes"), [(1, 1), (5, 5), (20, 20), (100, 20), (200, 40)])
def test_each_experiment_runs_as_many_scenes_as_requested_or_says_how_many(
    seeds: int, scenes: int
) -> None:
    listed = experiments(seeds, None)
    said = fewer(listed, names_of(), seeds)
    assert {each.scenes for each in listed} == ({None} if scenes == seeds else {None, scenes})
    assert len(said) == (0 if scenes == seeds else 3)
    assert all(f": {scenes} of {seeds} scenes" in line for line in said)
    assert fewer(listed, ["table1_sensors"], seeds) == []


def test_only_what_is_requested_is_run() -> None:
    said: list[str] = []
    made = reproduce(1, None, said.append, only=["table1", "eq3_4_points"])
    assert [exhibit.name for exhibit in made] == ["table1_sensors", "eq3_4_points"]
    assert [step.partition(",")[0] for step in said] == ["Table I", "Equations 3 and 4"]
    assert len(names_of()) == len(set(names_of()))
    assert names_of(Path()) == [*names_of(), "table4_recorded"]


def test_the_command_makes_those_requested(tmp_path: Path) -> None:
    words = ["-m", "studies.paper", "--only", "table1", "--out", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table, said = (tmp_path / "table1_sensors.md").read_text(), f"in {tmp_path}\n"
    assert done.stdout == f"{table}written: 2 tables and figures {said}"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["table1_sensors.csv", "table1_sensors.md"]


@pytest.mark.parametrize("name", ["nonsense", "table4_recorded"])
def test_a_name_that_is_in_none_is_bad_usage(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = CliRunner().invoke(paper, ["--only", "table1", "--only", name, "--out", str(out)])
    assert done.exit_code == 2
    assert "table2_tried" in done.output
    assert not out.exists()


def test_the_help_has_worked_examples() -> None:
    done = CliRunner().invoke(paper, ["--help"])
    assert done.exit_code == 0
    assert "python -m studies.paper --only table2" in done.output.split("Examples:")[1]


def test_what_the_pages_show_can_be_typed() -> None:
    shown = [
        (page.name, shlex.split(words))
        for page in PAGES
        for words in re.findall(r"python -m studies\.paper([^`\n#·]*)", page.read_text("utf-8"))
    ]
    assert len(shown) > 4
    parser = paper.make_parser(click.Context(paper))
    for page, words in shown:
        _, left, _ = parser.parse_args(words)
        assert not left, page
