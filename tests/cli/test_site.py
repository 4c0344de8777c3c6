"""The commands ``retropole site init`` and ``retropole site calibrate``."""

import json
from pathlib import Path

import pytest

from retropole.adjustment.answer import SiteCalibration
from retropole.base.bounded import Status
from retropole.base.description import Site
from retropole.cli import run
from retropole.result.decoding import decode_site
from tests.api.site_files import answer_to, write_recordings, write_site
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_site(tmp_path)


def answering(monkeypatch: pytest.MonkeyPatch, status: Status) -> None:
    def answer(site: Site, **options: object) -> SiteCalibration:
        return answer_to(site, status)

    monkeypatch.setattr("retropole.pipeline.calibrate_site", answer)


def test_a_folder_becomes_a_site_that_is_read(tmp_path: Path) -> None:
    write_recordings(tmp_path)
    done = retropole_here("site", "init", tmp_path)
    assert done.returncode == 0
    assert "3 LiDARs: gate, mast-a, mast-b; 2 placements: 1, 2" in done.stdout
    assert f"next: retropole site calibrate {tmp_path / 'site.toml'}" in done.stdout
    assert "gate has no recording of placement 2" in done.stderr
    before = (tmp_path / "site.toml").read_text()
    again = retropole_here("site", "init", tmp_path)
    assert again.returncode == 2
    assert "exists already; --force replaces it" in again.stderr
    assert "'retropole site init --help'" in again.stderr
    assert retropole_here("site", "init", tmp_path, "--force", "-q").returncode == 0
    assert (tmp_path / "site.toml").read_text() == before


@pytest.mark.parametrize(
    ("status", "options", "code"),
    [
        *(("ok", (), 0), ("warn", (), 0), ("ok", ("--strict",), 0), ("warn", ("--strict",), 1)),
        *(("refused", (), 3), ("refused", ("--strict", "-q"), 3)),
    ],
)
def test_exit_codes_are_those_of_calibrate(
    path: Path,
    monkeypatch: pytest.MonkeyPatch,
    status: Status,
    options: tuple[str, ...],
    code: int,
) -> None:
    answering(monkeypatch, status)
    out = path.parent / "out"
    done = retropole_here("site", "calibrate", path, "--out", out, *options)
    assert done.returncode == code
    assert decode_site((out / "site-result.json").read_bytes()).status == status
    assert (out / "site-report.html").exists()
    quiet = "-q" in options
    assert done.stdout.startswith("" if quiet else f"verdict: {status}\n")
    lines = done.stdout.splitlines()
    assert len(lines) <= 40
    commands = "written", "next", "field test", "later"
    assert all(len(line) <= 80 for line in lines if not line.startswith(commands))
    assert ("refused (ambiguous)" in done.stderr) == (status == "refused")
    # Whichever stream a reader sees has the reason, and the two together have it once.
    if status == "refused":
        message = decode_site((out / "site-result.json").read_bytes()).reasons[0].message
        both = " ".join(f"{done.stdout}\n{done.stderr}".split())
        assert both.count(" ".join(message.split())) == 1


def test_json_is_the_document_alone(
    path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    answering(monkeypatch, "warn")
    out = path.parent / "out"
    assert run(["site", "calibrate", str(path), "--out", str(out), "--json"]) == 0
    said = capfd.readouterr()
    assert said.out.encode() == (out / "site-result.json").read_bytes()
    assert "warning (small_margin)" in said.err


def test_after_an_error_an_older_result_is_set_aside(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, "ok")
    out = path.parent / "out"
    assert retropole_here("site", "calibrate", path, "--out", out, "-q").returncode == 0
    path.write_text(path.read_text().replace("recordings", "recording"))
    done = retropole_here("site", "calibrate", path, "--out", out, "--json")
    assert done.returncode == 2
    assert "lidar 1 (mast-a): " in done.stderr
    error = json.loads(done.stdout)["error"]
    assert (error["code"], error["read_on"]) == ("unreadable", "docs/site.md")
    names = {each.name for each in out.iterdir()}
    assert names == {"older-site-result.json", "older-site-report.html"}


def test_what_a_recording_cannot_be_is_said_in_the_words_of_the_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, "ok")
    path.write_text(path.read_text() + 'unit = "mm"\n')
    done = retropole_here("site", "calibrate", path, "--out", path.parent / "out")
    assert "gate/1.pcd: 95 % of the points are within 0.0" in done.stderr


def test_a_folder_without_a_site_file_is_told_how_to_get_one(tmp_path: Path) -> None:
    write_recordings(tmp_path)
    words = f"has no site.toml; 'retropole site init {tmp_path}' writes site.toml"
    for given in (tmp_path, tmp_path / "site.toml"):
        done = retropole_here("site", "calibrate", given, "--out", tmp_path / "out")
        assert done.returncode == 2
        assert f"{tmp_path}: {words}" in done.stderr


def test_the_group_tells_its_commands() -> None:
    done = retropole_here("site", "--help")
    assert done.returncode == 0
    for name in ("init", "calibrate"):
        assert f"\n  {name} " in done.stdout
    wrong = retropole_here("site", "nothing")
    assert wrong.returncode == 2
    assert "'retropole site --help'" in wrong.stderr
