"""Where an answer goes: full, closed, without an encoding, or to a reader that has gone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiers import first_of

pytestmark = pytest.mark.skipif(os.name != "posix", reason="devices and shells of POSIX")


def shell(command: str, folder: Path, **env: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command of a shell, in which ``retropole`` is this package."""
    line = f"set -o pipefail; retropole() {{ '{sys.executable}' -m retropole \"$@\"; }}; {command}"
    return subprocess.run(
        ["bash", "-c", line],
        capture_output=True,
        cwd=folder,
        env={**os.environ, **env},
        timeout=120,
    )


@pytest.mark.parametrize(
    "command",
    [
        "retropole info lidar0.pcd > /dev/full",
        "retropole info --help > /dev/full",
        "retropole export truth.json --from json --to matrix --out /dev/full",
        "retropole export truth.json --from json --to matrix <&- >&-",
        *first_of(
            [
                "retropole info lidar0.pcd --json > /dev/full",
                "retropole info lidar0.pcd <&- >&-",
                "retropole simulate bare --out lidar0.pcd/in/a/file",
                "retropole export truth.json --from json --to matrix > /dev/full",
            ],
            0,
        ),
    ],
)
@pytest.mark.full
def test_an_output_that_takes_nothing_is_one_line_and_what_to_do(command: str, scene: Path) -> None:
    if "/dev/full" in command and not Path("/dev/full").exists():
        pytest.skip("this system has no full device")
    before = {path.name: path.read_bytes() for path in scene.iterdir()}
    done = shell(command, scene)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(b"retropole: error: ")
    assert done.stderr.splitlines()[1].startswith(b"what to do: ")
    assert done.stderr.count(b"\n") == 2
    assert {path.name: path.read_bytes() for path in scene.iterdir()} == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root writes anywhere")
def test_a_folder_that_is_read_only_is_one_line_and_what_to_do(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    done = shell("retropole simulate bare --out out", tmp_path)
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 2)


@pytest.mark.parametrize("command", first_of(["info lidar0.pcd", "info lidar0.pcd --json"]))
@pytest.mark.full
def test_a_reader_that_has_gone_ends_it_without_a_word(command: str, scene: Path) -> None:
    done = shell(f"retropole {command} | true", scene)
    assert (done.returncode, done.stdout, done.stderr) == (141, b"", b"")


@pytest.mark.parametrize("closed", first_of(["<&- >&- 2>&-", "2>&-", "2>/dev/full"]))
@pytest.mark.full
def test_an_error_that_nobody_can_hear_keeps_its_exit_code(closed: str, scene: Path) -> None:
    assert shell(f"retropole info missing.pcd {closed}", scene).returncode == 2


@pytest.mark.full
def test_what_prints_nothing_needs_no_output(scene: Path, tmp_path: Path) -> None:
    done = shell(f"retropole simulate bare -q --out '{tmp_path}' >&-", scene)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("encoding", first_of(["cp1252", "ascii"]))
@pytest.mark.full
def test_any_encoding_can_show_an_answer(encoding: str, scene: Path) -> None:
    done = shell("retropole info lidar0.pcd", scene, PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"points" in done.stdout
    if encoding == "cp1252":
        assert b"###" in done.stdout
        assert b"<- threshold" in done.stdout


@pytest.mark.full
def test_the_plainest_locale_can_show_an_error(tmp_path: Path) -> None:
    env = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = shell("retropole info 'é '$'\\xff\\n''.pcd'", tmp_path, **env)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 2
    assert all(32 <= byte < 127 or byte == 10 for byte in done.stderr)
