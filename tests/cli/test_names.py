"""Names of files that are anything a system allows: they work, and stay text."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from retropole.report.detection import draw_detection
from retropole.result.decoding import decode
from tests.cli.commands import retropole, retropole_here
from tests.tiers import first_of

NAMES = {
    "signs": b"\n\x1b[2J\x07\xe2\x80\xae '\"`x`$(x);$\\frac{$ %41%s <script>alert(1)<!-- ]]> &amp;",
    "no UTF-8": b"-caf\xe9 \xff\xfe",
}


def lines_of(text: str) -> list[str]:
    """Lines of a terminal, none of which may steer it."""
    lines = text.split("\n")
    assert all(line.isprintable() for line in lines), text
    return lines


@pytest.fixture(params=first_of(NAMES))
def place(
    request: pytest.FixtureRequest, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> str:
    """A name, under which the recordings lie in the folder that commands run in."""
    name = os.fsdecode(NAMES[request.param])
    monkeypatch.chdir(tmp_path)
    try:
        for side in (0, 1):
            shutil.copy(scene / f"lidar{side}.pcd", f"./{name}{side}.pcd")
    except (OSError, UnicodeError):
        pytest.skip("this system does not allow such names")
    return name


@pytest.mark.full
def test_all_commands_take_any_name(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The picture takes a while, and is tested below.
    monkeypatch.setattr("retropole.report.detection.draw_detection", lambda *args, **named: None)
    target, source, out = f"./{place}0.pcd", f"./{place}1.pcd", f"./out{place}"
    for words in (
        ("info", target),
        ("detect", target, "--out", out),
        ("calibrate", target, source, "--out", out),
        ("report", out),
        ("check", out, target, source),
        ("export", out, "--to", "json", "--out", f"{out}/exported.json"),
        ("export", out, "--to", "ros2"),
        ("simulate", "bare", "--out", f"{out}/made"),
    ):
        done = retropole_here(*words)
        assert done.returncode == 0, (words[0], done.stderr)
        lines_of(done.stdout)
        assert "not the file" not in done.stderr, "the report finds what the run read"
    stored = decode(Path(out, "result.json").read_bytes())
    assert [Path(item.path).suffix for item in stored.inputs] == [".pcd", ".pcd"]
    page = Path(out, "report.html").read_bytes().decode()
    assert "<script>alert" not in page


@pytest.mark.full
def test_json_is_utf8_whatever_a_file_is_called(place: str) -> None:
    done = retropole("info", f"./{place}0.pcd", "--json")
    assert json.loads(done.stdout)["clouds"][0]["points"] > 0


def test_errors_name_the_file_as_text(place: str) -> None:
    for words in (
        ("info", f"missing {place}.pcd"),
        ("info", f"./{place}"),
        ("report", f"./{place}0.pcd"),
        ("check", f"./{place}0.pcd", f"./{place}0.pcd", f"./{place}1.pcd"),
        ("export", f"./{place}0.pcd", "--to", "json"),
        ("detect", f"./{place}0.pcd", f"--unknown{place}"),
        ("nonsense" + place,),
    ):
        done = retropole_here(*words)
        assert done.returncode == 2, words
        *_, said, end = lines_of(done.stderr)
        assert end == ""
        assert len(said) <= 320


@pytest.mark.full
def test_a_picture_has_a_name_and_no_formula(place: str, tmp_path: Path) -> None:
    from retropole.base.errors import printable
    from retropole.extraction.poles import extract_poles
    from retropole.io import read_cloud

    cloud = read_cloud(f"./{place}0.pcd")
    cloud = cloud.select(cloud.xyz[:, 0] > cloud.xyz[:, 0].mean())
    draw_detection(cloud, extract_poles(cloud), tmp_path / "a.svg", title=printable(place))
    assert ElementTree.parse(tmp_path / "a.svg").getroot().tag.endswith("}svg")
