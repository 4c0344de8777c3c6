"""The command line: files and printing at the edge of the method."""

from __future__ import annotations

import sys

import click

from ..errors import RetropoleError
from .calibrate import calibrate
from .check import check
from .common import CONTEXT, EXIT_INTERRUPTED, EXIT_USAGE
from .compare import compare
from .detect import detect
from .evaluate import evaluate
from .export import export
from .info import info
from .paper import paper
from .report import report
from .simulate import simulate
from .view import view


@click.group(context_settings=CONTEXT)
@click.version_option(package_name="retropole")
def cli() -> None:
    """Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

    Put two (or more) taped poles, not parallel, about 5 m away where both LiDARs see them, record
    a moment on each, and run

    \b
        retropole calibrate target.pcd source.pcd

    The answer maps points of the source LiDAR into the frame of the target LiDAR.
    """


for command in (
    *(calibrate, check, compare, detect, evaluate, export),
    *(info, paper, report, simulate, view),
):
    cli.add_command(command)


def main() -> None:
    """Run the command line; every error of retropole ends here."""
    try:
        code = cli.main(prog_name="retropole", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        code = EXIT_USAGE
    except RetropoleError as error:
        click.echo(f"retropole: {error}", err=True)
        code = EXIT_USAGE
    except (KeyboardInterrupt, click.Abort):
        click.echo("retropole: interrupted", err=True)
        code = EXIT_INTERRUPTED
    except OSError as error:
        click.echo(f"retropole: {error}", err=True)
        code = EXIT_USAGE
    sys.exit(code or 0)
