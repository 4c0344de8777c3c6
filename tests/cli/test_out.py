"""A run that failed leaves no older result that could be taken for its own, and destroys none."""

from __future__ import annotations

from pathlib import Path

import pytest

from retropole.cli.out import DEFAULT_OUT
from tests.cli.commands import retropole_here

OLDER = {"result.json": b"the one before", "report.html": b"its page"}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    for name, data in OLDER.items():
        (folder / name).write_bytes(data)
    (folder / "notes.txt").write_text("mine")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


SET_ASIDE = {**{f"older-{name}": data for name, data in OLDER.items()}, "notes.txt": b"mine"}


@pytest.mark.parametrize(
    "words",
    [
        ("missing.pcd", "none.pcd"),
        ("missing.pcd",),
        ("missing.pcd", "none.pcd", "--radius", "much"),
        ("missing.pcd", "none.pcd", "--rdius", "0.02"),
        ("missing.pcd", "none.pcd", "--json"),
        ("missing.pcd", "none.pcd", "-q"),
    ],
)
@pytest.mark.parametrize("joined", [False, True])
def test_after_an_error_the_older_result_has_another_name(
    out: Path, words: tuple[str, ...], joined: bool
) -> None:
    where = (f"--out={out}",) if joined else ("--out", out)
    done = retropole_here("calibrate", *words, *where)
    assert done.returncode == 2
    assert contents(out) == SET_ASIDE
    assert "no result of this run; the one before is now" in done.stderr
    assert "older-result.json" in done.stderr
    # Nothing is left to set aside: the older one stays.
    again = retropole_here("calibrate", *words, *where)
    assert "older-" not in again.stderr
    assert contents(out) == SET_ASIDE


def test_without_out_it_is_the_default_folder(
    out: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    out.rename(DEFAULT_OUT)
    assert retropole_here("calibrate", "missing.pcd", "--poles", "x").returncode == 2
    assert contents(tmp_path / DEFAULT_OUT) == SET_ASIDE


def test_a_run_that_answers_replaces_the_older_result(scene: Path, out: Path) -> None:
    clouds = (scene / "lidar0.pcd", scene / "lidar1.pcd")
    assert retropole_here("calibrate", *clouds, "--no-refine", "--out", out).returncode == 0
    assert set(contents(out)) == {*OLDER, "notes.txt"}
    assert contents(out)["result.json"] != OLDER["result.json"]


def test_help_and_other_folders_are_left_alone(out: Path, tmp_path: Path) -> None:
    assert retropole_here("calibrate", "--out", out, "--help").returncode == 0
    assert retropole_here("calibrate", "a", "b", "--out", tmp_path / "new").returncode == 2
    assert set(contents(out)) == {*OLDER, "notes.txt"}
    assert not (tmp_path / "new").exists()
