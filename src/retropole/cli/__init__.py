"""The command line: files and printing at the edge of the method.

A command is a module of this folder with a function of the same name, and a line of `COMMANDS`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, MutableMapping, Sequence
from importlib import import_module

import click

from ..base.errors import Refusal, RetropoleError
from .common import CONTEXT, EXIT_INTERRUPTED, EXIT_PIPE, never_fail_to_encode, say
from .errors import asks_for_json, failure_of, tell

COMMANDS = (
    "calibrate",
    "certify",
    "check",
    "compare",
    "detect",
    "evaluate",
    "export",
    "fleet",
    "info",
    "report",
    "simulate",
    "site",
    "view",
)
"""Every command, by the name of its module."""


class LazyCommands(MutableMapping[str, click.Command]):
    """Commands by name, each imported when it is asked for: a command pays its own imports alone.

    Parameters
    ----------
    names
        Modules of this folder.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._commands: dict[str, click.Command | None] = dict.fromkeys(names)

    def __getitem__(self, name: str) -> click.Command:
        """Import a command."""
        command = self._commands[name]
        if command is None:
            found = getattr(import_module(f".{name}", __name__), name)
            assert isinstance(found, click.Command)
            command = self._commands[name] = found
        return command

    def __setitem__(self, name: str, command: click.Command) -> None:
        """Add a command."""
        self._commands[name] = command

    def __delitem__(self, name: str) -> None:
        """Take a command out."""
        del self._commands[name]

    def __iter__(self) -> Iterator[str]:
        """Give the names."""
        return iter(self._commands)

    def __len__(self) -> int:
        """Count the commands."""
        return len(self._commands)


@click.group(context_settings=CONTEXT, commands=LazyCommands(COMMANDS))
@click.version_option(package_name="retropole")
def cli() -> None:
    """Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

    Put two (or more) taped poles, not parallel, about 5 m away where both LiDARs see them, record
    a moment on each, and run

    \b
        retropole calibrate target.pcd source.pcd

    The answer maps points of the source LiDAR into the frame of the target LiDAR.
    """


def run(words: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit code; every error of retropole ends here.

    Parameters
    ----------
    words
        What follows ``retropole``; None takes it from `sys.argv`.
    """
    args = sys.argv[1:] if words is None else list(words)
    never_fail_to_encode()
    try:
        code = cli.main(args, prog_name="retropole", standalone_mode=False)
    except (click.ClickException, RetropoleError, OSError, MemoryError) as error:
        command = _command_of(args)
        refused = isinstance(error, Refusal)
        return tell(failure_of(error, command), refused=refused, as_json=asks_for_json(args))
    except SystemExit as error:
        # click and rich end so where the reader of a pipe has gone; here 1 has another meaning.
        if error.code == 1:
            return EXIT_PIPE
        raise
    except (KeyboardInterrupt, click.Abort):
        say("retropole: interrupted")
        return EXIT_INTERRUPTED
    return int(code or 0)


def _command_of(words: Sequence[str]) -> str:
    """Name the command that was called, and of a group which of it: ``retropole site init``."""
    named = next((k for k, word in enumerate(words) if word in COMMANDS), None)
    if named is None:
        return "retropole"
    group = cli.commands[words[named]]
    inner = group.commands if isinstance(group, click.Group) else {}
    following = words[named + 1 : named + 2]
    return " ".join(["retropole", words[named], *(word for word in following if word in inner)])
