"""From recordings to a site that is calibrated, tested and exported, by what each output names."""

import json
import shlex
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


def named(output: str) -> list[list[str]]:
    """The commands that an output names, as typed."""
    lines = (line.partition(": retropole ") for line in output.splitlines())
    return [shlex.split(typed) for _, sign, typed in lines if sign]


def test_four_recordings_become_a_site_in_four_commands(tmp_path: Path) -> None:
    words = "simulate", "site", "posts", "--lidars", 4, "--placements", 1, "--poles", 4
    done = retropole_here(*words, "--seed", 5, "--out", "made", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (tmp_path / "my recordings").mkdir()
    for k in range(1, 5):
        file = tmp_path / "my recordings" / f"lidar_{k}.pcd"
        shutil.copy(tmp_path / "made" / f"posts-{k}_1.pcd", file)
    commands = [["site", "init", "my recordings"]]
    run = 0
    while run < len(commands):
        done = retropole_here(*commands[run], cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        # What to do some other day is no part of it.
        commands += [words for words in named(done.stdout) if words[:2] != ["site", "check"]]
        run += 1
    assert [words[0] for words in commands] == ["site", "site", "export", "certify"]
    out = tmp_path / "retropole-out"
    assert json.loads((out / "site-result.json").read_text())["status"] == "ok"
    assert json.loads((out / "field-test.json").read_text())["status"] == "pass"
    links = ElementTree.parse(out / "site.urdf").findall("link")
    assert {link.get("name") for link in links} >= {f"lidar_{k}" for k in range(1, 5)}
