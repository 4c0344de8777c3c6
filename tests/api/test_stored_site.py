"""The page of a site again, from its result and its recordings, wherever both lie now."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as changed

import retropole as rp
from retropole.api.stored import MOST_NOTES, scans_of
from retropole.io import read_cloud, write_pcd
from retropole.simulation.writing import write_site
from tests.adjustment.adjusting import made

pytestmark = pytest.mark.full

FILES = tuple(f"posts-{k}_1.pcd" for k in (1, 2, 3))
GONE = ("not found (looked for", "the page does not show it")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site in a folder, one LiDAR in centimetres, and in `out` what its calibration wrote."""
    folder = tmp_path_factory.mktemp("run")
    write_site(made(placements=1), folder / "s")
    cloud = read_cloud(folder / "s" / FILES[1])
    write_pcd(folder / "s" / FILES[1], replace(cloud, xyz=100 * cloud.xyz))
    text = (folder / "s" / "site.toml").read_text()
    own = 'name = "posts-2"\n'
    (folder / "s" / "site.toml").write_text(text.replace(own, f'{own}unit = "cm"\nserial = "17"\n'))
    result = rp.calibrate_site(folder / "s")
    assert result.status == "ok"
    result.save(folder / "out")
    return folder


@pytest.fixture
def own(run: Path, tmp_path: Path) -> Path:
    """The same elsewhere: both moved together."""
    return shutil.copytree(run, tmp_path / "moved" / "away")


def page_of(folder: Path) -> str:
    return (folder / "site-report.html").read_text()


def test_a_remade_page_is_that_of_the_run(run: Path, own: Path) -> None:
    loaded = rp.load_site_result(own / "out")
    assert loaded.report(own / "again.html").read_text() == page_of(run / "out")
    written = loaded.save(own / "deeper" / "copy")
    document = rp.load_site_result(own / "deeper" / "copy").document
    paths = [item.path for item in document.inputs]
    assert paths == [f"../../s/{name}" for name in FILES]
    assert scans_of(document, written[0].parent).notes == ()


def test_recordings_are_found_next_to_the_result_and_from_here(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = rp.load_site_result(own / "out").document
    beside = shutil.copytree(own / "s", tmp_path / "beside")
    assert scans_of(document, beside).notes == ()
    (own / "here").mkdir()
    monkeypatch.chdir(own / "here")
    assert scans_of(document, tmp_path).notes == ()


def test_moved_recordings_are_recognized_by_their_hashes(run: Path, own: Path) -> None:
    (own / "s").rename(own / "moved")
    moved = [(own / "moved" / name).rename(own / f"{k}.pcd") for k, name in enumerate(FILES)]
    loaded = rp.load_site_result(own / "out")
    page = loaded.report(own / "again.html", clouds=moved[::-1]).read_text()
    assert page == page_of(run / "out")


def test_what_is_given_and_not_of_the_run_is_refused(own: Path) -> None:
    loaded = rp.load_site_result(own / "out")
    foreign = own / "foreign.pcd"
    write_pcd(foreign, read_cloud(own / "s" / FILES[0]).select(np.arange(100)))
    with pytest.raises(rp.UsageError, match=r"foreign\.pcd: is no recording of this result"):
        loaded.report(own / "again.html", clouds=[foreign])
    with pytest.raises(rp.ReadError, match=r"absent\.pcd"):
        loaded.report(own / "again.html", clouds=[own / "absent.pcd"])
    assert not (own / "again.html").exists()


def test_a_page_without_a_cloud_that_is_gone_or_another_reports_it(own: Path) -> None:
    loaded = rp.load_site_result(own / "out")
    (own / "s" / FILES[0]).unlink()
    shutil.copy(own / "s" / FILES[2], own / "s" / FILES[1])
    scans = scans_of(loaded.document, own / "out")
    assert [row[0] is not None for row in scans.scans] == [False, False, True]
    gone, other = scans.notes
    assert all(word in gone for word in (FILES[0], *GONE))
    assert f"{FILES[1]} is not the file that the run read" in other
    assert other.endswith("the page does not show it")
    page = loaded.report(own / "again.html").read_text()
    assert page.count('class="alert"') == 2
    assert "1 cloud; the page shows" in page
    (own / "s" / FILES[2]).unlink()
    page = loaded.report(own / "again.html").read_text()
    assert "the page shows" not in page
    assert "Poses of the LiDARs" in page


def test_of_many_that_are_gone_a_few_are_named(own: Path) -> None:
    document = rp.load_site_result(own / "out").document
    inputs = [changed(document.inputs[0], path=f"{k}.pcd") for k in range(MOST_NOTES + 2)]
    notes = scans_of(changed(document, inputs=inputs), own / "out").notes
    assert len(notes) == MOST_NOTES + 1
    assert notes[-1] == "likewise not shown: 2 more recordings"


def test_a_pipe_is_not_opened(own: Path) -> None:
    (own / "s" / FILES[0]).unlink()
    os.mkfifo(own / "s" / FILES[0])
    (note,) = scans_of(rp.load_site_result(own / "out").document, own / "out").notes
    assert "is a named pipe, expected a file" in note


def test_clouds_that_were_never_files_are_reported_once(tmp_path: Path) -> None:
    result = rp.calibrate_site(made(placements=1).as_site())
    result.save(tmp_path / "out")
    (note,) = scans_of(rp.load_site_result(tmp_path / "out").document, tmp_path / "out").notes
    assert "was an array, not a file" in note


def test_serial_numbers_are_those_of_the_site_file_or_given(own: Path) -> None:
    loaded = rp.load_site_result(own / "out")
    page = loaded.report(own / "a.html", site="Pier 4 <b>", serials={"posts-1": "11<2"}).read_text()
    sheet = page[page.index('class="certificate"') :][:4000]
    for said in ("Pier 4 &lt;b&gt;", "11&lt;2", "17"):
        assert said in sheet
        assert said == "17" or said not in page_of(own / "out")
    with pytest.raises(rp.UsageError, match="no LiDAR 'gate'; there are posts-1, posts-2, posts-3"):
        loaded.report(own / "b.html", serials={"gate": "1"})
