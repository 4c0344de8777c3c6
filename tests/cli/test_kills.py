"""Commands that are ended at any moment: nothing torn, nothing mixed, nothing left."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import psutil
import pytest

from retropole.base.files import RUNNING, UNFINISHED
from retropole.io import open_recording
from retropole.result.decoding import decode

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}

URDF = b'<robot name="r">\n  <link name="target"/>\n  <link name="source"/>\n</robot>\n'


def start(folder: Path, *words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "retropole", *map(str, words)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        start_new_session=True,
    )


@pytest.fixture(scope="module")
def site(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of the same recordings under other names, a result of the first, and a robot."""
    folder = tmp_path_factory.mktemp("site")
    for run in "ab":
        for side in (0, 1):
            shutil.copy(scene / f"lidar{side}.pcd", folder / f"{run}{side}.pcd")
    start(folder, *calibrate("a")).communicate(timeout=120)
    (folder / "robot.urdf").write_bytes(URDF)
    start(folder, "export", "out", "--into", "robot.urdf").communicate(timeout=120)
    start(folder, "simulate", "street", "--seed", 1, "--out", "s").communicate(timeout=120)
    return folder


def calibrate(run: str) -> tuple[str, ...]:
    return "calibrate", f"{run}0.pcd", f"{run}1.pcd", "--out", "out"


WATCH = "watch", "replay:b0.pcd", "replay:b1.pcd"

COMMANDS: dict[str, tuple[object, ...]] = {
    "calibrate": calibrate("b"),
    "report": ("report", "out"),
    "simulate": ("simulate", "street", "--seed", 2, "--out", "s"),
    "watch": (*WATCH, "--sweeps", 3, "--no-page", "--out", "out"),
    "check": ("check", "out", "b0.pcd", "b1.pcd"),
    "export": ("export", "out", "--into", "robot.urdf", "--child", "other"),
}


def assert_whole(folder: Path) -> None:
    """Every file is of one run, from its first byte to its last."""
    out = folder / "out"
    # A run that calibrates sets the result of the one before aside at its start.
    found = [kind for kind in ("", "older-") if (out / f"{kind}result.json").exists()]
    assert found
    for kind in found:
        result = decode((out / f"{kind}result.json").read_bytes())
        if (out / f"{kind}report.html").exists():
            page = (out / f"{kind}report.html").read_text()
            assert page.rstrip().endswith("</html>")
            assert all(item.path in page for item in result.inputs)
    for path in out.glob("*.mcap"):
        for topic in ("/target/points", "/source/points"):
            recording = open_recording(path, topic=topic)
            assert len(list(recording.read(range(recording.count)))) == recording.count >= 1
    truth = json.loads((folder / "s" / "truth.json").read_text())
    clouds = [folder / "s" / truth[role] for role in ("target", "source")]
    sizes = {path.stat().st_size for path in clouds if path.exists()}
    assert all(size > 1000 for size in sizes)
    assert b"</robot>" in (folder / "robot.urdf").read_bytes()


def kill(
    site: Path,
    folder: Path,
    seed: int,
    commands: Mapping[str, tuple[object, ...]] = COMMANDS,
    look: Callable[[Path], None] = assert_whole,
    ends: Collection[int] = (0,),
) -> str:
    """End a command at a random moment, look at what is there, run it again, and name it."""
    dice = random.Random(seed)
    name, number = dice.choice(list(commands)), dice.choice(list(CODES))
    shutil.copytree(site, folder, dirs_exist_ok=True)
    process = start(folder, *commands[name])
    # While modules are loaded, anywhere, and where files are written.
    when = dice.randrange(3)
    if when < 2:
        time.sleep(dice.uniform(0.05, 0.4) if when == 0 else dice.uniform(0.2, 4.0))
    else:
        while process.poll() is None and not any(folder.rglob(f"*{UNFINISHED}")):
            time.sleep(0.0005)
        time.sleep(dice.uniform(0.0, 0.02))
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    # Before our own first line and after our last, Python ends the process as it does: 128 + the
    # number of the signal to a shell as well, without a word or with its own.
    assert "Traceback" not in errors or "retropole" not in errors, f"seed {seed}: {errors[-800:]}"
    is_told = "retropole: interrupted" in errors or "retropole: terminated" in errors
    allowed = (*ends, CODES[number]) + (() if is_told else (-number,))
    assert process.returncode in allowed, f"seed {seed}: {process.returncode}"
    look(folder)
    left = list(folder.rglob(f"*{UNFINISHED}"))
    assert not left or number == signal.SIGKILL, f"seed {seed}: {left}"
    assert_no_process_of(process.pid)
    done = start(folder, *commands[name])
    _, errors = done.communicate(timeout=300)
    assert done.returncode in ends, f"seed {seed}: {errors[-800:]}"
    assert not list(folder.rglob(f"*{UNFINISHED}")), f"seed {seed}"
    assert not list(folder.rglob(RUNNING)), f"seed {seed}"
    look(folder)
    return name


def assert_no_process_of(session: int) -> None:
    """Whatever a command has started ends soon after it."""
    deadline = time.monotonic() + 30
    while left := [pid for pid in psutil.pids() if session_of(pid) == session]:
        assert time.monotonic() < deadline, [psutil.Process(pid).cmdline() for pid in left]
        time.sleep(0.1)


def session_of(process: int) -> int | None:
    try:
        return os.getsid(process)
    except ProcessLookupError:
        return None


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(seed, marks=pytest.mark.full if seed < 104 else pytest.mark.nightly)
        for seed in range(100, 400)
    ],
)
def test_ended_at_any_moment(seed: int, site: Path, tmp_path: Path) -> None:
    kill(site, tmp_path, seed)
