"""`retropole view`, and the pages of ``detect`` and ``info``, as a user gets them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.io import write_pcd
from tests.cli.commands import retropole_here
from tests.report.pages import cloud_of


@pytest.fixture(autouse=True)
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a browser was asked to open."""
    asked = list[str]()

    def browse(url: str) -> bool:
        asked.append(url)
        return True

    monkeypatch.setattr("webbrowser.open", browse)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return asked


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_pcd(tmp_path / "a.pcd", cloud_of(300))
    return tmp_path / "a.pcd"


def test_a_page_is_written_and_opened(recording: Path, opened: list[str]) -> None:
    done = retropole_here("view", recording)
    assert done.returncode == 0, done.stderr
    page = Path(done.stdout.removeprefix("written: ").strip())
    assert opened == [page.as_uri()]
    assert "<h1>a.pcd</h1>" in page.read_text()
    assert page.stat().st_mode & 0o077 == 0


def test_files_of_one_name_are_named_by_their_folders(tmp_path: Path, recording: Path) -> None:
    flat = PointCloud(np.eye(3) + 2, np.full(3, 3.0))
    write_pcd(tmp_path / "b" / "a.pcd", flat)
    page = tmp_path / "p.html"
    done = retropole_here("view", recording, tmp_path / "b" / "a.pcd", "--out", page, "-q")
    assert (done.returncode, done.stdout) == (0, "")
    assert f"{tmp_path / 'b' / 'a.pcd'}</h2>" in page.read_text()
    assert "no_intensity" in page.read_text()


@pytest.mark.full
def test_of_a_result_it_is_the_report(scene: Path, tmp_path: Path) -> None:
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    assert retropole_here("calibrate", *clouds, "--out", tmp_path / "r", "-q").returncode == 0
    page = tmp_path / "p.html"
    done = retropole_here("view", tmp_path / "r", "--out", page)
    assert done.returncode == 0, done.stderr
    assert page.read_text() == (tmp_path / "r" / "report.html").read_text()


@pytest.mark.parametrize("name", ["a.pcd", "a.json"])
def test_missing_file_is_named(tmp_path: Path, name: str) -> None:
    done = retropole_here("view", tmp_path / name)
    assert done.returncode == 2
    assert name in done.stderr


def test_detect_and_info_write_the_page(recording: Path, tmp_path: Path, opened: list[str]) -> None:
    page = tmp_path / "p.html"
    done = retropole_here("info", recording, "--page", page)
    assert done.returncode == 0, done.stderr
    assert "written: " in done.stdout
    assert "points     300" in page.read_text()
    done = retropole_here("detect", recording, "--page", page, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "0 poles in" in page.read_text()
    assert opened == []
