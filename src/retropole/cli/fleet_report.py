"""The command ``retropole fleet report``."""

from __future__ import annotations

import click

from .common import CONTEXT, progress_on_terminal, show


@click.command("report", context_settings=CONTEXT)
@click.argument("dataset", metavar="DATASET")
@click.option("--out", required=True, metavar="FILE", help="File or URL to write.")
@click.option(
    "--reports",
    metavar="DIR",
    help="Folder or URL to which 'fleet calibrate --reports' wrote: the page links there.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def fleet_report(dataset: str, out: str, reports: str | None, quiet: bool) -> int:
    """Show what became of a fleet as one HTML page, from the DATASET of 'fleet calibrate'.

    The page has a map of all sites, how many ended how and why, how large the predicted errors
    are, the worst twenty, and every error with its message. It works without a network.

    \b
    Examples:
      retropole fleet report fleet --out fleet.html
      retropole fleet report fleet --reports reports --out fleet.html
      retropole fleet report s3://city/fleet --out fleet.html

    \b
    Exit code:
      0    written
      2    DATASET cannot be read, or the page not be written
      130  interrupted
    """
    from ..base.errors import printable
    from ..fleet.overview import overview_of
    from ..fleet.report import write_fleet_report

    with progress_on_terminal(quiet) as progress:
        progress("read the dataset")
        overview = overview_of(dataset)
        progress("write")
        write_fleet_report(out, overview, reports)
    if not quiet:
        show(f"written: {printable(out)}")
    return 0
