"""Damaged recordings: an error that says so, or a cloud that the file can hold.

In a process of its own, whose memory is measured; see `tests.damage`.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT


def hold_many(folder: Path, first: int, last: int, seconds: float) -> None:
    command = [sys.executable, "-m", "tests.damage", str(first), str(last), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=seconds)
    seed = (folder / "seed").read_text() if (folder / "seed").exists() else "none"
    assert done.returncode == 0, f"seed {seed}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    assert f"{last - first} files, 0 wrong" in done.stdout


@pytest.mark.full
def test_a_damaged_recording_is_an_error_or_a_cloud(tmp_path: Path) -> None:
    hold_many(tmp_path, 0, 60, 120)


@pytest.mark.parametrize(
    "first",
    [pytest.param(1000, marks=pytest.mark.full), pytest.param(2500, marks=pytest.mark.nightly)],
)
def test_more_damaged_recordings(first: int, tmp_path: Path) -> None:
    hold_many(tmp_path, first, first + 750, 500)


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(10))
def test_many_damaged_recordings(part: int, tmp_path: Path) -> None:
    hold_many(tmp_path, 10_000 * (part + 1), 10_000 * (part + 2), 3600)
