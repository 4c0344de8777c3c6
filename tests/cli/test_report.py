"""`retropole report` as a user runs it: the page again, from a result and its clouds."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.io import read_cloud, write_pcd
from retropole.simulation.writing import write_site
from tests.adjustment.adjusting import made
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two scans and the result of calibrating them, by relative paths."""
    folder = tmp_path_factory.mktemp("run")
    sensor = ("--sensor", "VLP-16")
    done = retropole_here("simulate", "harbor", "--seed", 1, *sensor, "--out", folder)
    assert done.returncode == 0, done.stderr
    done = retropole_here("calibrate", "lidar0.pcd", "lidar1.pcd", "--out", "r", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def own(run: Path, tmp_path: Path) -> Path:
    shutil.copytree(run, tmp_path / "own")
    return tmp_path / "own"


def test_makes_the_page_that_calibrate_made(own: Path) -> None:
    before = (own / "r" / "report.html").read_text()
    (own / "r" / "report.html").unlink()
    done = retropole_here("report", "r/result.json", cwd=own)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "written: r/report.html"
    assert (own / "r" / "report.html").read_text() == before


def test_takes_the_folder_of_a_result(own: Path) -> None:
    before = (own / "r" / "report.html").read_text()
    (own / "r" / "report.html").unlink()
    done = retropole_here("report", "r", cwd=own)
    assert (done.returncode, done.stdout.strip()) == (0, "written: r/report.html")
    assert (own / "r" / "report.html").read_text() == before


def test_finds_the_clouds_next_to_the_result(own: Path, tmp_path: Path) -> None:
    shutil.copy(own / "r" / "result.json", own / "result.json")
    done = retropole_here("report", own / "result.json", "--out", tmp_path / "a.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "a.html").stat().st_size > 100_000


def test_takes_the_clouds_that_are_given(own: Path) -> None:
    for k in (0, 1):
        (own / f"lidar{k}.pcd").rename(own / f"moved{k}.pcd")
    done = retropole_here("report", "r/result.json", cwd=own)
    assert done.returncode == 2
    assert "lidar0.pcd" in done.stderr
    assert "TARGET and SOURCE" in done.stderr
    done = retropole_here("report", "r/result.json", "moved0.pcd", "moved1.pcd", cwd=own)
    assert (done.returncode, done.stderr) == (0, "")


def test_says_where_a_cloud_is_not_the_one_of_the_run(own: Path) -> None:
    done = retropole_here("report", "r/result.json", "lidar1.pcd", "lidar0.pcd", cwd=own)
    assert done.returncode == 0
    assert done.stderr.count("is not the file that the run read") == 2
    page = (own / "r" / "report.html").read_text()
    assert page.count("is not the file that the run read") == 2
    # The poles found in a wrong cloud are not held against the result's.
    assert "rms from the surface" not in page


def test_wrong_numbers_of_clouds_and_wrong_files(own: Path) -> None:
    assert retropole_here("report", "r/result.json", "lidar0.pcd", cwd=own).returncode == 2
    done = retropole_here("report", "lidar0.pcd", cwd=own)
    assert done.returncode == 2
    assert "no result document" in done.stderr
    done = retropole_here("report", "none.json", cwd=own)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    document = json.loads((own / "r" / "result.json").read_text())
    (own / "empty.json").write_text(json.dumps({**document, "inputs": []}))
    done = retropole_here("report", "empty.json", cwd=own)
    assert done.returncode == 2
    assert "0 inputs" in done.stderr


def test_refused_and_several_placements(own: Path) -> None:
    rng = np.random.default_rng(0)
    for k in (0, 1):
        cloud = read_cloud(own / f"lidar{k}.pcd")
        again = replace(cloud, xyz=cloud.xyz + rng.normal(0.0, 1e-3, cloud.xyz.shape))
        write_pcd(own / f"again{k}.pcd", again)
    pairs = [("--placement", f"{name}0.pcd", f"{name}1.pcd") for name in ("lidar", "again")]
    done = retropole_here("calibrate", *pairs[0], *pairs[1], "--no-refine", "--out", "two", cwd=own)
    assert done.returncode == 0, done.stderr
    before = (own / "two" / "report.html").read_text()
    done = retropole_here("report", "two/result.json", cwd=own)
    assert done.returncode == 0, done.stderr
    assert (own / "two" / "report.html").read_text() == before
    done = retropole_here(
        "calibrate", "lidar0.pcd", "lidar1.pcd", "--poles", 5, "--out", "no", cwd=own
    )
    assert done.returncode == 3
    before = (own / "no" / "report.html").read_text()
    assert retropole_here("report", "no/result.json", cwd=own).returncode == 0
    assert (own / "no" / "report.html").read_text() == before


def test_reads_the_topics_and_frames_of_the_run(own: Path) -> None:
    pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")
    from tests.bags import points_of, write_bag

    points = [points_of(read_cloud(own / f"lidar{k}.pcd")) for k in (0, 1)]
    topics = {"/front": [points[0], points[1]], "/rear": [points[1], points[0]]}
    bag = write_bag(own, "mcap", topics)
    which = ("--topic", "/front", "--topic", "/rear", "--frames", "0:1")
    done = retropole_here("calibrate", bag, bag, *which, "--no-refine", "--out", "b", "-q", cwd=own)
    assert done.returncode == 0, done.stderr
    before = (own / "b" / "report.html").read_text()
    done = retropole_here("report", "b/result.json", cwd=own)
    assert (done.returncode, done.stderr) == (0, "")
    assert (own / "b" / "report.html").read_text() == before


def test_the_certificate_names_the_site_and_the_lidars(own: Path) -> None:
    before = (own / "r" / "report.html").read_text()
    named = ("--site", "Pier 4 <b>", "--serial", "target", "11002", "--serial-source", "11007")
    assert retropole_here("report", "r", *named, cwd=own).returncode == 0
    page = (own / "r" / "report.html").read_text()
    for said in ("Pier 4 &lt;b&gt;", "11002", "11007"):
        assert said in page
        assert said not in before


@pytest.fixture(scope="module")
def site_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a site, and in `out` what its calibration wrote."""
    folder = tmp_path_factory.mktemp("site")
    write_site(made(placements=1), folder / "s")
    done = retropole_here("site", "calibrate", "s", "--out", "out", "-q", cwd=folder)
    assert done.returncode == 0
    return folder


@pytest.fixture
def site(site_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "site"
    shutil.copytree(site_run, folder)
    monkeypatch.chdir(folder)
    return folder


def test_the_page_of_a_site_is_made_again(site: Path) -> None:
    before = (site / "out" / "site-report.html").read_text()
    (site / "out" / "site-report.html").unlink()
    done = retropole_here("report", "out", cwd=site)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == "written: out/site-report.html"
    assert (site / "out" / "site-report.html").read_text() == before
    (site / "s" / "posts-1_1.pcd").rename(site / "elsewhere.pcd")
    done = retropole_here("report", "out", cwd=site)
    assert done.returncode == 0
    assert done.stderr.startswith("retropole: ../s/posts-1_1.pcd: not found")
    assert retropole_here("report", "out", "elsewhere.pcd", cwd=site).stderr == ""
    assert (site / "out" / "site-report.html").read_text() == before


def test_serial_numbers_of_a_site_are_given_by_name(site: Path, own: Path) -> None:
    done = retropole_here("report", "out", "--serial", "posts-1", "11<02", cwd=site)
    assert (done.returncode, done.stderr) == (0, "")
    assert "11&lt;02" in (site / "out" / "site-report.html").read_text()
    for folder, options, said in (
        (site / "out", ("--serial", "mast", "1"), "no LiDAR 'mast'; there are posts-1"),
        (site / "out", ("--serial-source", "1"), "no LiDAR 'source'; there are posts-1"),
        (own / "r", ("--serial", "mast", "1"), "no LiDAR 'mast'; there are target, source"),
    ):
        done = retropole_here("report", folder, *options, cwd=site)
        assert done.returncode == 2
        assert said in done.stderr
