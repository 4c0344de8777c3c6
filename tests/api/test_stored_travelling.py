"""A result and its recordings are moved together, and found again."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest

import retropole as rp
from retropole.api.checking import read_stored
from retropole.api.stored import find_recordings, named_from
from retropole.io import write_pcd
from retropole.result import encode
from retropole.result.site import RecordingDoc, SiteConfig
from tests.api.clouds import calibrated, pair
from tests.export.sites import free

pytestmark = pytest.mark.full

FILES = ("target.pcd", "source.pcd")
SENSOR = 'like = "VLP-16"\n'


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with recordings, a sensor's file and a result, calibrated from within it."""
    folder = tmp_path / "run"
    (folder / "recordings").mkdir(parents=True)
    for name, cloud in zip(FILES, (pair().target, pair().source), strict=True):
        write_pcd(folder / "recordings" / name, cloud)
    (folder / "mine.toml").write_text(SENSOR)
    monkeypatch.chdir(folder)
    files = [str(Path("recordings", name)) for name in FILES]
    result = rp.calibrate(*files, sensor=("mine.toml", "auto"), options=rp.RunConfig(refine=False))
    assert [each.path for each in result.document.inputs] == files
    result.save(folder / "out")
    return folder


def test_paths_count_from_the_folder_of_the_result(run: Path) -> None:
    document = json.loads((run / "out" / "result.json").read_text())
    assert [each["path"] for each in document["inputs"]] == [f"../recordings/{n}" for n in FILES]
    assert document["config"]["sensor_target"] == "../mine.toml"
    assert [each["sensor"] for each in document["inputs"]] == ["../mine.toml", "auto"]
    assert str(run) not in (run / "out" / "result.json").read_text()


def test_a_folder_that_was_moved_has_its_recordings(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = (run / "out" / "report.html").read_bytes()
    moved = run.rename(tmp_path / "elsewhere")
    loaded = rp.load_result(moved / "out")
    assert loaded.report(tmp_path / "page.html").read_bytes() == before
    stored = read_stored(moved / "out")
    assert stored.config.sensor_target == str(moved / "mine.toml")
    # Saved into another folder, the paths count from there.
    loaded.save(tmp_path / "deeper" / "copy")
    document = rp.load_result(tmp_path / "deeper" / "copy").document
    assert document.inputs[0].path == "../../elsewhere/recordings/target.pcd"
    assert document.config.sensor_target == "../../elsewhere/mine.toml"


def test_of_two_files_with_the_path_the_one_of_the_run_is_taken(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # From here the path that counts from the result is that of another recording.
    other = tmp_path / "other" / "here"
    other.mkdir(parents=True)
    shutil.copytree(run / "recordings", other.parent / "recordings")
    (other.parent / "recordings" / FILES[0]).write_bytes(b"another")
    monkeypatch.chdir(other)
    document = rp.load_result(run / "out").document
    found = [each.path for each in find_recordings(document, run / "out") if each.path]
    assert [path.resolve() for path in found] == [run / "recordings" / name for name in FILES]
    # The other way round: beside the result is another one now.
    shutil.copy(run / "recordings" / FILES[0], other.parent / "recordings" / FILES[0])
    (run / "recordings" / FILES[0]).write_bytes(b"another")
    found = [each.path for each in find_recordings(document, run / "out") if each.path]
    assert found[0].resolve() == other.parent / "recordings" / FILES[0]


def test_older_results_with_absolute_paths_are_read(run: Path, tmp_path: Path) -> None:
    document = rp.load_result(run / "out").document
    inputs = [
        msgspec.structs.replace(each, path=str(run / "recordings" / name))
        for each, name in zip(document.inputs, FILES, strict=True)
    ]
    config = msgspec.structs.replace(document.config, sensor_target=str(run / "mine.toml"))
    old = msgspec.structs.replace(document, inputs=inputs, config=config)
    (tmp_path / "result.json").write_bytes(encode(old))
    loaded = rp.load_result(tmp_path)
    assert [each.path for each in find_recordings(loaded.document, tmp_path)] == [
        run / "recordings" / name for name in FILES
    ]
    assert read_stored(tmp_path).config.sensor_target == str(run / "mine.toml")


def test_paths_are_kept_where_that_is_requested(run: Path, tmp_path: Path) -> None:
    result = rp.load_result(run / "out")
    before = result.document.inputs
    result.save(tmp_path / "kept", relative=False)
    assert rp.load_result(tmp_path / "kept").document.inputs == before


def test_an_array_and_a_file_that_is_gone_keep_their_names(tmp_path: Path) -> None:
    document = calibrated().document
    inputs = [msgspec.structs.replace(document.inputs[0], path="s3://a/gone.pcd")]
    document = msgspec.structs.replace(document, inputs=[*inputs, document.inputs[1]])
    assert named_from(document, tmp_path, Path()).inputs == document.inputs


def test_through_a_linked_folder_the_path_is_that_of_the_system(run: Path, tmp_path: Path) -> None:
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "far" / "away" / "link").symlink_to(run, target_is_directory=True)
    result = rp.load_result(run / "out")
    folder = tmp_path / "far" / "away" / "link" / "again"
    result.save(folder)
    path = rp.load_result(folder).document.inputs[0].path
    assert path == f"../recordings/{FILES[0]}"
    assert (folder / path).exists()


def test_the_files_of_a_site_count_from_its_result(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("")
    (tmp_path / "a.pcd").write_bytes(b"abc")
    site = free()
    inputs = [
        RecordingDoc(str(tmp_path / "a.pcd"), "0" * 64, 3, 0, "auto", None, lidar=0, placement=0)
    ]
    config = SiteConfig(site_file=str(tmp_path / "site.toml"))
    site = msgspec.structs.replace(site, inputs=inputs, config=config)
    named = named_from(site, tmp_path / "out", Path())
    assert named.config.site_file == "../site.toml"
    assert [each.path for each in named.inputs] == ["../a.pcd"]
