"""A figure of a page that is not what its command prints is named."""

import io
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from benchmarks.figures_compare import Table, compare, position, tables
from benchmarks.figures_run import runnable
from tests.cli.commands import Done
from tests.paths import ROOT

HEAD = "| kind | runs | right | e_rt m, median | largest |\n| --- | --- | --- | --- | --- |\n"
RIGHT, MEDIAN = 0.9, 0.02
"""Of the process that these tables are drawn from."""


def figures(*options: str) -> Done:
    """Run the command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", ["figures.py", *options])
        patch.setattr(sys, "path", [*sys.path])
        try:
            runnable("benchmarks/figures.py")()
        except SystemExit as ended:
            code = ended.code
        else:
            code = 0
    assert isinstance(code, int), code
    return Done(code, out.getvalue(), err.getvalue())


def written(folder: Path, text: str) -> Path:
    """A folder with one page, of a commit."""
    (folder / "docs").mkdir()
    (folder / "README.md").write_text(text, encoding="utf-8")
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    commit = ("commit", "-q", "--allow-empty", "-m", "a")
    subprocess.run(["git", *identity, *commit], cwd=folder, check=True)
    return folder


def copied(folder: Path, old: str = "", new: str = "") -> Path:
    """A copy of a page whose table has no chance, one cell of it altered."""
    (folder / "docs").mkdir()
    (folder / "README.md").write_text("")
    page = (ROOT / "docs/cases.md").read_text(encoding="utf-8")
    assert old in page
    (folder / "docs/cases.md").write_text(page.replace(old, new), encoding="utf-8")
    return folder


def drawn(rng: np.random.Generator, runs: int) -> str:
    """A table of so many runs, as a benchmark prints it."""
    values = MEDIAN * np.exp(rng.normal(size=runs))
    right = int((rng.random(runs) < RIGHT).sum())
    return HEAD + f"| a | {runs} | {right} | {np.median(values):.4f} | {values.max():.4f} |\n"


def test_an_altered_cell_is_named(tmp_path: Path) -> None:
    root = copied(tmp_path, "| 7.0 m | 10.5 m |", "| 7.0 m | 10.6 m |")
    done = figures("--share", "0.05", "--root", str(root))
    assert done.returncode == 1, done.stderr
    page = (root / "docs/cases.md").read_text(encoding="utf-8")
    line = page[: page.index("<!-- figures: ")].count("\n") + 1
    said = f"docs/cases.md:{line}, row 'XT32', column '3 m up': said 10.6 m, measured 10.5 m"
    assert said in done.stdout
    assert "24 figures, 1 differ" in done.stdout


def test_a_page_as_it_is_passes(tmp_path: Path) -> None:
    done = figures("--share", "0.05", "--root", str(copied(tmp_path)))
    assert done.returncode == 0, done.stdout + done.stderr


def test_written_tables_hold_what_is_printed(tmp_path: Path) -> None:
    root = written(tmp_path, "")
    page = (ROOT / "docs/cases.md").read_text(encoding="utf-8")
    stale = page.replace("| 7.0 m | 10.5 m |", "| 7.0 m | 10.6 m |")
    assert stale != page
    (root / "docs/cases.md").write_text(stale, encoding="utf-8")
    assert figures("--write", "--root", str(root)).returncode == 0
    fresh = (root / "docs/cases.md").read_text(encoding="utf-8")
    assert tables(fresh) == tables(page)


SHARED = """\
<!-- figures: python -m studies.paper --only table1 · 2026-11-25 · abc1234 -->
<!-- figures: python benchmarks/none.py · 2026-11-25 · abc1234 · an hour -->
| sensor | paper | ours |
| --- | --- | --- |
| **VLP-16** | 230 | {ours} |
| made up | 7 | 7 |
<!-- end of figures -->
"""


def test_each_command_is_held_against_its_own_rows(tmp_path: Path) -> None:
    root = written(tmp_path, SHARED.format(ours="231"))
    done = figures("--share", "0.05", "--root", str(root))
    assert "row 'VLP-16', column 'ours': said 231, measured 230" in done.stdout, done.stderr
    assert "2 figures, 1 differ" in done.stdout
    assert "2 marks, 1 tables, 1 of them compared" in figures("--root", str(root)).stdout


def test_a_command_writes_its_own_rows(tmp_path: Path) -> None:
    root = written(tmp_path, SHARED.format(ours="231"))
    done = figures("--write", "--root", str(root))
    assert done.returncode == 0, done.stderr
    page = (root / "README.md").read_text(encoding="utf-8").splitlines()
    before = SHARED.format(ours="230").splitlines()
    assert page[1:] == before[1:]
    assert page[0].startswith("<!-- figures: python -m studies.paper --only table1 · ")


@pytest.mark.full
def test_a_whole_run_has_the_same_digits(tmp_path: Path) -> None:
    command = "python benchmarks/fleet_network.py --nodes 200 --seeds 0:2"
    page = f"<!-- figures: {command} · 2026-11-25 · abc1234 · whole -->\n"
    page += "| S | cities | CPU s, median | sound edges lost |\n| --- | --- | --- | --- |\n"
    page += "| 0 | 2 | 1000 | {} |\n<!-- end of figures -->\n"
    root = written(tmp_path, page.format("LOST"))
    done = figures("--share", "0.05", "--root", str(root))
    assert done.returncode == 1
    (lost,) = re.findall(r"said LOST, measured (\d+ of \d+)", done.stdout)
    (root / "README.md").write_text(page.format(lost), encoding="utf-8")
    done = figures("--share", "0.05", "--root", str(root))
    assert done.returncode == 0, done.stdout
    assert "2 figures, 0 differ" in done.stdout


@pytest.mark.parametrize(
    ("median", "largest", "named"),
    [
        *(("2.0", "9.0", []), ("2.0", "99.0", []), ("2.0", "0.5", ["CPU s, largest"])),
        *(("7.0", "9.0", ["CPU s, median"]), ("0.6", "9.0", ["CPU s, median"])),
    ],
)
def test_times_are_held_within_a_factor_of_three(
    median: str, largest: str, named: list[str]
) -> None:
    head = "| size | CPU s, median | CPU s, largest |\n| --- | --- | --- |\n"
    (said,) = tables(f"{head}| a | {median} | {largest} |\n")
    cells = compare(said, [f"{head}| a | {time} | {time} |\n" for time in (2, 2, 3)], 9, times=True)
    assert cells is not None
    assert [cell.column for cell in cells if cell.probability < 0.5] == named
    assert compare(said, [f"{head}| a | 99 | 99 |\n"], 9) == []


def test_shares_of_things_that_hang_together_are_not_counted() -> None:
    head = "| sites | answered | region holds: poses |\n| --- | --- | --- |\n"
    (said,) = tables(f"{head}| a | 20 of 20 | 60.0% of 90 |\n")
    cells = compare(said, [f"{head}| a | 1 of 1 | 100.0% of 5 |\n"] * 9, 20)
    assert cells is not None
    assert [cell.column for cell in cells] == ["answered"]


@pytest.mark.full
def test_draws_of_the_same_process_are_rarely_beyond_chance() -> None:
    """The probabilities are such: below p no more often than p."""
    rng = np.random.default_rng(0)
    least = []
    for _ in range(400):
        (said,) = tables(drawn(rng, 40))
        cells = compare(said, [drawn(rng, 1) for _ in range(10)], 40)
        assert cells is not None
        assert [cell.column for cell in cells] == ["right", "e_rt m, median", "largest"]
        least += [cell.probability for cell in cells]
    for level in (0.01, 0.05, 0.2):
        room = 4.0 * np.sqrt(level * (1 - level) / len(least))
        assert np.mean(np.array(least) < level) < level + room


@pytest.mark.parametrize(
    ("column", "cell"), [("right", "8"), ("e_rt m, median", "0.0020"), ("largest", "0.0010")]
)
def test_what_differs_by_more_than_chance_is_improbable(column: str, cell: str) -> None:
    rng = np.random.default_rng(1)
    (said,) = tables(drawn(rng, 40))
    row = list(said.rows[0])
    row[said.head.index(column)] = cell
    cells = compare(Table(said.head, [tuple(row)]), [drawn(rng, 1) for _ in range(20)], 40)
    assert cells is not None
    assert [one.column for one in cells if one.probability < 1e-4] == [column]


def test_a_median_of_many_is_a_sign_test() -> None:
    """All of n on one side of a known median: 2 of 2ⁿ."""
    assert position(0.0, [1.0] * 10, 0.5, 10**9) == pytest.approx(2.0**-9, rel=1e-3)


def test_a_table_that_is_not_printed_is_no_agreement() -> None:
    (said,) = tables(drawn(np.random.default_rng(2), 5))
    assert compare(said, ["nothing"], 5) is None
    assert compare(said, [drawn(np.random.default_rng(2), 1).replace("| a |", "| b |")], 5) is None


def hold(day: int, *, seconds: float, timeout: float | None) -> None:
    """Compare the tables that have a day of the month.

    With unchanged code this cannot fail by chance: the draws are the same every time.
    """
    limits = "--seconds", str(seconds), "--alarm", "0.001"
    try:
        done = subprocess.run(
            [sys.executable, ROOT / "benchmarks/figures.py", "--part", str(day), *limits],
            capture_output=True,
            text=True,
            timeout=timeout,
        )
    except subprocess.TimeoutExpired:
        pytest.skip("this machine is too slow; the nightly tests compare it")
    if done.stdout.startswith("no table"):
        pytest.skip("no table has this day")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.full
def test_figures_of_today_hold() -> None:
    hold(datetime.now(UTC).day, seconds=15.0, timeout=100.0)


@pytest.mark.nightly
@pytest.mark.parametrize("day", range(1, 32))
def test_figures_of_every_day_hold(day: int) -> None:
    hold(day, seconds=60.0, timeout=None)


def test_every_mark_is_read() -> None:
    """A mark that is written otherwise would leave its table out, and nobody would know."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    marks = sum(page.read_text(encoding="utf-8").count("figures: python ") for page in pages)
    done = figures()
    assert done.returncode == 0, done.stderr
    assert f"{marks} marks, " in done.stdout
    scripts = set(re.findall(r"python (benchmarks/\w+\.py)", done.stdout))
    assert scripts
    assert all((ROOT / script).is_file() for script in scripts)


def test_the_readme_says_what_the_comparison_says() -> None:
    """Right, wrong and refused of each method, in %; names and rounding of errors differ."""
    (readme,) = [
        t for t in tables((ROOT / "README.md").read_text(encoding="utf-8")) if t.head[0] == "method"
    ]
    page = tables((ROOT / "docs/evidence/compare.md").read_text(encoding="utf-8"))
    (compared,) = [t for t in page if t.head[:2] == ("method", "runs")]
    own = [row[2:5] for row in compared.rows if not row[0].endswith("+count")]
    assert sorted(row[1:4] for row in readme.rows) == sorted(own)
