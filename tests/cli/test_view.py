"""`retropole view` as a user runs it."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.io import write_pcd
from tests.cli.commands import retropole_here
from tests.report.test_viewer import two_poles

VIEW = [sys.executable, "-m", "retropole", "view"]
HAS_VISER = importlib.util.find_spec("viser") is not None


@pytest.mark.skipif(not HAS_VISER, reason="viser is not installed (extra 'view')")
@pytest.mark.full
def test_prints_its_address_answers_and_ends_by_interrupt(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", two_poles())
    process = subprocess.Popen(
        [*VIEW, str(tmp_path / "a.pcd"), "--port", "8970"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # What runs the tests in the background may have told its children to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    try:
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=20) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert said == ""
    assert "interrupted" in errors
    assert "Traceback" not in errors


@pytest.mark.skipif(not HAS_VISER, reason="viser is not installed (extra 'view')")
def test_no_intensity_is_refused(tmp_path: Path) -> None:
    cloud = PointCloud(np.random.default_rng(0).uniform(-5, 5, (50, 3)), np.full(50, 3.0))
    write_pcd(tmp_path / "flat.pcd", cloud)
    done = retropole_here("view", tmp_path / "flat.pcd")
    assert done.returncode == 3
    assert "no_intensity" in done.stderr


@pytest.mark.skipif(HAS_VISER, reason="viser is installed")
def test_missing_part_is_named(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", two_poles())
    done = retropole_here("view", tmp_path / "a.pcd")
    assert done.returncode == 2
    assert "retropole[view]" in done.stderr


def test_missing_file_is_named(tmp_path: Path) -> None:
    done = retropole_here("view", tmp_path / "a.pcd")
    assert done.returncode == 2
    assert "a.pcd" in done.stderr
