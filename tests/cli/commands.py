"""Running commands, as a process and here."""

import io
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from retropole.base.datatypes import Array
from retropole.cli import cli, run
from retropole.result.decoding import decode


def all_commands(of: click.Command = cli, name: str = "") -> Iterator[tuple[str, click.Command]]:
    """Give every command that does something, those of groups too, by what is typed."""
    inner = of.commands if isinstance(of, click.Group) else {}
    for each in list(inner):
        yield from all_commands(inner[each], f"{name} {each}".strip())
    if not inner or (isinstance(of, click.Group) and of.invoke_without_command):
        yield name, of


def retropole(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command as a process of its own."""
    command = [sys.executable, "-m", "retropole", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=120)


@dataclass(frozen=True)
class Done:
    """What a command printed, and its exit code."""

    returncode: int
    stdout: str
    stderr: str


def retropole_here(*words: object, cwd: Path | None = None) -> Done:
    """Run a command in this process, which takes no time to start."""
    # Documents are written as bytes.
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8") for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err), chdir(cwd or Path()):
        code = run([str(word) for word in words])
    return Done(code, *(_text(each) for each in (out, err)))


def _text(written: io.TextIOWrapper) -> str:
    written.seek(0)
    return written.read()


def transform_of(folder: Path) -> Array:
    """Read the transform of a result."""
    result = decode((folder / "result.json").read_bytes())
    assert result.T_target_source is not None
    return np.array(result.T_target_source)
