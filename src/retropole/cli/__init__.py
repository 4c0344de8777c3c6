"""The command line: files and printing at the edge of the method.

A command is a module of this folder with a function of the same name, and a line of `COMMANDS`.
"""

from __future__ import annotations

import sys
from collections import UserDict
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import click

from ..base.errors import Refusal, RetropoleError
from .common import CONTEXT, EXIT_INTERRUPTED, EXIT_PIPE, Group, never_fail_to_encode, say
from .errors import asks_for_json, failure_of, report_failure

GROUPS = {
    "Calibrate": ("calibrate", "watch", "site", "fleet"),
    "Look at recordings": ("info", "view", "detect"),
    "Plan and rehearse": ("plan", "simulate"),
    "Check": ("check", "certify", "evaluate"),
    "Share the result": ("report", "export", "level", "merge"),
}
"""Every command, by the name of its module, as the help groups them."""

COMMANDS = tuple(sorted(name for names in GROUPS.values() for name in names))


class LazyCommands(UserDict[str, Any]):
    """Modules by the names of their commands, which are imported when they are needed.

    So a command pays only for its imports.
    """

    def __getitem__(self, key: str) -> Any:
        """Import a command."""
        return getattr(import_module(self.data[key], __name__), key)


class Grouped(Group):
    """The commands under the headings of `GROUPS`."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List each with the begin of its first sentence, in one line."""
        width = max(map(len, COMMANDS))
        limit = formatter.width - width - 6
        for title, names in GROUPS.items():
            with formatter.section(title):
                commands = [(name, self.commands[name]) for name in names]
                formatter.write_dl(
                    [(f"{n:{width}}", c.get_short_help_str(limit)) for n, c in commands]
                )


@click.group(
    cls=Grouped, context_settings=CONTEXT, commands=LazyCommands({n: f".{n}" for n in COMMANDS})
)
@click.version_option(package_name="retropole")
def cli() -> None:
    """Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

    Put two (or more) taped poles, not parallel, about 5 m away where both LiDARs see them, record
    a moment on each, and calibrate. The answer maps points of the source LiDAR into the frame of
    the target LiDAR.

    \b
    Examples:
      retropole calibrate target.pcd source.pcd
      retropole view target.pcd source.pcd
      retropole simulate street --seed 1 --out s
    """


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit code; every error of retropole ends here.

    Parameters
    ----------
    arguments
        What follows ``retropole``; None takes it from `sys.argv`.
    """
    args = sys.argv[1:] if arguments is None else list(arguments)
    never_fail_to_encode()
    try:
        code = cli.main(args, prog_name="retropole", standalone_mode=False)
    except (click.ClickException, RetropoleError, OSError, MemoryError) as error:
        name, command = _command_of(args)
        if isinstance(error, click.ClickException):
            from .out import set_older_aside

            set_older_aside(command, args)
        refused = isinstance(error, Refusal)
        return report_failure(failure_of(error, name), refused=refused, as_json=asks_for_json(args))
    except SystemExit as error:
        # click and rich raise it when the reader of a pipe has gone; here 1 has another meaning.
        if error.code == 1:
            return EXIT_PIPE
        raise
    except (KeyboardInterrupt, click.Abort):
        say("retropole: interrupted")
        return EXIT_INTERRUPTED
    return int(code or 0)


def _command_of(arguments: Sequence[str]) -> tuple[str, click.Command]:
    """Find the command that was called, of a group which of it, and its name."""
    name: str = "retropole"
    command: click.Command = cli
    named = next((k for k, word in enumerate(arguments) if word in COMMANDS), len(arguments))
    for word in arguments[named : named + 2]:
        inner = command.commands if isinstance(command, click.Group) else {}
        if word in inner:
            name, command = f"{name} {word}", inner[word]
    return name, command
