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

REASONS = {
    "zstd.mcap": "unpack to more than 67,108,864",
    "bz2.bag": "unpack to more than 67,108,864",
    "packed message": "unpack to more than 67,108,864",
    "endless tree": "takes more steps than a database of",
    "messages are a view": "messages is not a table of plain columns",
    "computed columns": "messages is not a table of plain columns",
    "aliases": "or an alias",
    "large.npz": "unpack to more than",
    "hole.mcap": "up to 68,157,440 are read",
}

READ = """
import faulthandler, json, sys
from retropole.base.errors import ReadError
from retropole.io import read_cloud
from tests.memory import peak_memory
for path in sys.argv[1:]:
    faulthandler.dump_traceback_later(LIMIT, exit=True)
    try:
        read_cloud(path)
        said = None
    except ReadError as error:
        said = str(error)
    faulthandler.cancel_dump_traceback_later()
    print(json.dumps([said, peak_memory() // 2**20]))
""".replace("LIMIT", str(MAX_SECONDS))


def read_all(paths: list[Path]) -> list[tuple[str, int]]:
    """Read files in one process: what it says of each, and its peak until then, MiB."""
    done = subprocess.run(
        [sys.executable, "-c", READ, *map(str, paths)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def assert_harmless(folder: Path, size: int, *, skipped: tuple[str, ...] = ()) -> None:
    made = dict(bombs.make(folder, size, skipped))
    for name, (said, peak) in zip(made, read_all(list(made.values())), strict=True):
        assert said is not None, name
        assert str(folder) in said
        assert REASONS.get(name, "") in said
        assert "\n" not in said
        assert len(said) < 600
        assert peak < MAX_MIB, name


def test_bombs_are_harmless(tmp_path: Path) -> None:
    assert_harmless(tmp_path, 2**28, skipped=("again.bag", "again.mcap", "many.npz"))


@pytest.mark.full
def test_large_bombs_are_harmless(tmp_path: Path) -> None:
    assert_harmless(tmp_path, 5 * 2**30)
