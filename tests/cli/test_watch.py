"""`retropole watch` as a user runs it."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import urllib.request
from importlib import import_module
from pathlib import Path
from threading import Timer
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from benchmarks.again import record_again
from retropole.api.watching import Watch
from retropole.base import se3
from retropole.io import write_pcd
from retropole.report.watch_terminal import drawn
from retropole.result.watching import LidarNow, WatchDoc
from retropole.simulation import SimulatedPair, simulate_pair
from tests.cli.commands import retropole, retropole_here, transform_of

pytest.importorskip("mcap")

watch = import_module("retropole.cli.watch")

DISTINCT = 15
"""Sweeps that differ; the same again tells nothing more."""

WATCH = [sys.executable, "-m", "retropole", "watch"]


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair(
        "street", np.random.default_rng(3), sensor_target="VLP-16", sensor_source="VLP-16"
    )


@pytest.fixture(scope="module")
def recorded(pair: SimulatedPair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two folders of sweeps, 20 s at 10 Hz, of which a few are told apart."""
    folder = tmp_path_factory.mktemp("sweeps")
    again = [record_again(pair, np.random.default_rng(k)) for k in range(DISTINCT)]
    for name in ("target", "source"):
        (folder / name).mkdir()
        for k, one in enumerate(again):
            write_pcd(folder / name / f"{k}.pcd", getattr(one, name))
        for k in range(DISTINCT, 200):
            (folder / name / f"{k}.pcd").symlink_to(folder / name / f"{k % DISTINCT}.pcd")
    return folder


def sources(recorded: Path) -> tuple[str, str]:
    return f"replay:{recorded / 'target'}", f"replay:{recorded / 'source'}"


@pytest.mark.full
def test_it_says_what_to_do_and_ends_with_the_answer(
    pair: SimulatedPair, recorded: Path, tmp_path: Path
) -> None:
    words = "--intensity", "intensity", "--sweeps", "4", "--no-page", "--out", tmp_path
    ended = retropole("watch", *sources(recorded), *words)
    assert ended.returncode == 0, ended.stderr
    lines = ended.stderr.splitlines()
    assert any(line.startswith("Good: keep still") for line in lines)
    assert lines[-1].startswith("Done")
    assert "placement1.mcap" in ended.stdout
    step = se3.local(transform_of(tmp_path), pair.T_target_source)
    assert np.linalg.norm(step[3:]) < 0.02


@pytest.mark.full
def test_sweeps_without_a_frame_are_not_published(recorded: Path, tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds")
    out = tmp_path / "out"
    words = ("--publish", "--interface", "lo", "--domain", "77", "--no-page", "--out", out)
    done = retropole_here("watch", *sources(recorded), *words)
    assert done.returncode == 2
    assert "have no frame_id" in done.stderr
    assert not (out / "result.json").exists()


@pytest.mark.full
def test_the_page_shows_the_state_and_an_interrupt_ends_it(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    process = subprocess.Popen(
        [*WATCH, f"folder:{tmp_path / 'a'}", f"folder:{tmp_path / 'b'}", "--out", tmp_path / "out"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # What runs the tests in the background may have told its children to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        process.stderr.readline()
        with urllib.request.urlopen(f"{url}state", timeout=20) as answer:
            state = json.load(answer)
        assert state["schema"] == "retropole/watch/1"
        assert state["code"] == "silent"
        assert [each["name"] for each in state["lidars"]] == ["a", "b"]
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Traceback" not in errors


def test_slips_are_usage_errors(tmp_path: Path) -> None:
    folder = f"folder:{tmp_path}"
    for words, said in (
        (("a.pcd", "b.pcd"), "not a source"),
        ((folder, folder), "two sources"),
        ((folder, "folder:nowhere"), "nowhere"),
        ((folder, "replay:nowhere.bag"), "nowhere.bag"),
        ((folder, "velodyne:0x1"), "not a port"),
        ((folder, "ros2:/a", "--interface", "nowhere0"), "no network interface"),
        ((folder, f"{folder}/..", "--at-m", "30"), "give both"),
        ((folder, f"{folder}/..", "--name", "a", "a"), "same name"),
    ):
        ended = retropole_here("watch", *words, "--no-page", "--out", tmp_path / "out")
        assert ended.returncode == 2, words
        assert said in ended.stderr
        assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_one_signal_breaks_off_what_never_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: int
) -> None:
    """A pipe that nobody writes to, as a source may open one, however well it looks before."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()

    def blocked(self: Watch) -> None:
        Timer(0.1, os.kill, (os.getpid(), number)).start()
        (tmp_path / "pipe").read_bytes()

    monkeypatch.setattr(watch, "GRACE", 0.1)
    monkeypatch.setattr(Watch, "step", blocked)
    sources = f"folder:{tmp_path / 'a'}", f"folder:{tmp_path / 'b'}"
    # A run in the background of a shell ignores Ctrl-C, and so would the watch.
    before = signal.signal(number, signal.default_int_handler)
    try:
        ended = retropole_here("watch", *sources, "--no-page", "--out", tmp_path / "out")
    finally:
        signal.signal(number, before)
    assert ended.returncode == code
    assert signal.getsignal(signal.SIGALRM) == signal.SIG_DFL


def test_a_watch_says_once_in_a_pipe_that_it_skips_sweeps(
    capfd: pytest.CaptureFixture[str],
) -> None:
    words = [f"skipped {k} of 30 sweeps of front: …" for k in (0, 7, 8)]
    lidars = [
        LidarNow(
            name="front", source="x", sweeps_per_s=10, age_s=0.1, points=9, poles=[],
            skipped=each if k else "",
        )
        for k, each in enumerate(words)
    ]  # fmt: skip
    with watch._view(quiet=False) as view:
        for lidar in lidars:
            said = WatchDoc(
                phase="placing", is_good=False, code="a", next="Go", seconds=1, lidars=[lidar]
            )
            view(said)
    assert capfd.readouterr().err.splitlines() == ["Go", words[1]]
    console = Console(width=100, file=io.StringIO())
    console.print(drawn(said))
    assert words[2] in cast(io.StringIO, console.file).getvalue()


def test_a_watch_that_nobody_looks_at_says_what_cannot_be_written(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with watch._view(quiet=True) as view:
        for code in ("good", "not_written", "not_written", "good"):
            view(
                WatchDoc(
                    phase="placing", is_good=False, code=code, next=f"{code}!", seconds=1, lidars=[]
                )
            )
    assert capfd.readouterr().err == "not_written!\n"
