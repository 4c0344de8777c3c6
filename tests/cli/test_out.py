"""The folder that a command writes to: of no other run, and nothing in it is of a run before."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import pytest

from retropole.base.files import RUNNING, run_alone
from retropole.cli import out as out_module
from retropole.cli.out import DEFAULT_OUT, WRITES
from tests.cli.commands import all_commands, retropole_here

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
    assert "no result of this run; the previous one is now" in done.stderr
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


@pytest.mark.full
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


def writing() -> dict[str, click.Command]:
    """Every command with a folder to write to."""
    return {
        name: command
        for name, command in all_commands()
        for option in command.params
        if option.name == "out" and isinstance(option.type, click.Path)
        if option.type.dir_okay and not option.type.file_okay
    }


GIVEN = {
    "simulate": ["street"],
    "simulate site": ["posts"],
    "watch": ["folder:.", "folder:.."],
    "detect": ["missing.pcd"],
    "site calibrate": ["missing.toml"],
}
"""What these commands need to begin; others two recordings."""


def test_every_command_that_writes_to_a_folder_has_it_for_itself(out: Path) -> None:
    commands = writing()
    assert commands.keys() >= {"calibrate", "certify", "plan", *GIVEN}
    for name, command in commands.items():
        assert command.callback in WRITES, name
    with run_alone(out, "retropole watch"):
        before = contents(out)
        for name in commands:
            given = GIVEN.get(name, ["missing.pcd", "none.pcd"])
            done = retropole_here(*name.split(), *given, "--out", out)
            assert done.returncode == 2, name
            assert f"{out}: another run is writing to it (retropole watch, process " in done.stderr
            assert str(os.getpid()) in done.stderr
            assert "name another folder with --out" in done.stderr
            # Not even where its words make no sense.
            assert retropole_here(*name.split(), *given, "--nonsense", "--out", out).returncode == 2
            assert contents(out) == before, name
        # A report goes beside its result; elsewhere nothing is in the way.
        done = retropole_here("report", out / "result.json")
        assert "another run is writing to it" in done.stderr
        done = retropole_here("report", out / "result.json", "--out", out.parent / "a.html")
        assert "another run" not in done.stderr
    done = retropole_here("calibrate", "missing.pcd", "none.pcd", "--out", out)
    assert "another run" not in done.stderr
    assert RUNNING not in contents(out)


@contextmanager
def run_in(out: Path) -> Iterator[None]:
    with out_module._without_older(out, [*OLDER]):
        assert contents(out) == SET_ASIDE
        yield


def test_what_is_interrupted_leaves_none_of_a_run_before(
    out: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt), run_in(out):
        raise KeyboardInterrupt
    assert contents(out) == SET_ASIDE
    assert "no result of this run; the previous one is now" in capfd.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_that_ends_the_process_says_where_the_older_one_is(out: Path) -> None:
    script = """
import signal, sys
from pathlib import Path
from retropole.__main__ import _end
from retropole.base.files import run_alone
from retropole.cli.out import _without_older
out = Path(sys.argv[1])
with run_alone(out), _without_older(out, ["result.json", "report.html"]):
    _end(signal.SIGTERM, None)
"""
    done = subprocess.run([sys.executable, "-c", script, out], capture_output=True, text=True)
    assert done.returncode == 143
    assert f"the previous one is now {out / 'older-result.json'} and" in done.stderr
    assert done.stderr.endswith("retropole: terminated\n")
    assert contents(out) == SET_ASIDE


def test_what_replaces_an_older_one_has_its_links_and_permissions(out: Path) -> None:
    from retropole.base.files import write_together

    (out / "report.html").unlink()
    (out / "elsewhere.html").write_bytes(b"its page")
    (out / "report.html").symlink_to("elsewhere.html")
    (out / "result.json").chmod(0o640)
    with out_module._without_older(out, [*OLDER]):
        assert not (out / "result.json").exists()
        assert not (out / "report.html").is_symlink()
        write_together({out / "result.json": b"new", out / "report.html": b"new page"})
    assert (out / "elsewhere.html").read_bytes() == b"new page"
    assert (out / "report.html").is_symlink()
    assert stat.S_IMODE((out / "result.json").stat().st_mode) == 0o640
    assert not list(out.glob("older-*"))


def test_where_there_is_no_room_the_older_one_stays_aside(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from retropole.base import files

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"), run_in(out):
        files.write_together({out / name: b"new" for name in OLDER})
    assert contents(out) == SET_ASIDE


def test_a_check_by_a_watch_keeps_the_result(out: Path) -> None:
    for more in ((), ("--nonsense",)):
        done = retropole_here("watch", "folder:.", "folder:..", "--check", out, "--out", out, *more)
        assert done.returncode == 2
        assert set(contents(out)) == {*OLDER, "notes.txt"}
