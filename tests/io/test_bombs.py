"""Small files that would unpack to GiB, or be read for ever, are errors that say so, and soon."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

from tests.io import bombs
from tests.paths import ROOT

MAX_SECONDS, MAX_MIB = 10, 1024
"""Of CPU time, for each file; and of all files in one process."""

REASONS = {
    "zstd.mcap": "unpack to more than 67,108,864",
    "bz2.bag": "unpack to more than 67,108,864",
    "packed message": "unpack to more than 67,108,864",
    "endless tree": "takes more steps than a database of",
    "messages are a view": "messages is not a table of plain columns",
    "computed columns": "messages is not a table of plain columns",
    "aliases": "or an alias",
    "large.npz": "unpack to more than",
    "many names.csv": "140,000 columns, expected 10,000",
    "hexadecimal.csv": "0xg', expected 4 numbers",
    "counted.pts": "line 1: promises 999999999999999 points, 9 lines",
    "no width.pcd": "the header promises 4000000000 points",
    "hole.mcap": "up to 68,157,440 are read",
}

READ = """
import json, sys
from retropole.base.errors import ReadError
from retropole.io import read_cloud
from tests.damage import ended_after
from tests.memory import peak_memory
for path in sys.argv[1:]:
    said = None
    try:
        with ended_after(LIMIT):
            read_cloud(path)
    except ReadError as error:
        said = str(error)
    print(json.dumps([said, peak_memory() // 2**20]))
""".replace("LIMIT", str(MAX_SECONDS))


def read_all(paths: list[Path]) -> list[tuple[str, int]]:
    """Read files in one process: what it says of each, and its peak until then, MiB."""
    done = subprocess.run(
        [sys.executable, "-c", READ, *map(str, paths)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def assert_harmless(folder: Path, size: int) -> None:
    made = dict(bombs.make(folder, size))
    for name, (said, peak) in zip(made, read_all(list(made.values())), strict=True):
        assert said is not None, name
        assert str(folder) in said
        assert REASONS.get(name, "") in said
        assert "\n" not in said
        assert len(said) < 600
        assert peak < MAX_MIB, name


@pytest.mark.full
def test_bombs_are_harmless(tmp_path: Path) -> None:
    assert_harmless(tmp_path, 2**28)


@pytest.mark.nightly
def test_large_bombs_are_harmless(tmp_path: Path) -> None:
    assert_harmless(tmp_path, 5 * 2**30)
