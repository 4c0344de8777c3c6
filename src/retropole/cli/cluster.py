"""Options of commands whose work a Dask cluster does."""

from __future__ import annotations

from collections.abc import Callable

import click

from ..fleet import TIME_LIMIT
from .options import Number


def cluster_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --scheduler, --workers and --time-limit."""
    for option in (
        click.option(
            "--time-limit",
            type=Number(min=1, max=1e6),
            default=TIME_LIMIT,
            metavar="SECONDS",
            help="Of one site.",
        ),
        click.option(
            "--workers",
            type=click.IntRange(min=1, max=1024),
            help="Number of local processes, where there is no --scheduler.  "
            "[default: one per processor]",
        ),
        click.option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster: tcp://host:8786."),
    ):
        command = option(command)
    return command


def check_cluster(scheduler: str | None, workers: int | None) -> None:
    """Refuse a number of local processes for a cluster that is elsewhere."""
    if scheduler is not None and workers is not None:
        raise click.UsageError("--workers is for local processes: give it or --scheduler, not both")
