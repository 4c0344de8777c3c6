"""The commands ``retropole fleet …``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from .common import EXIT_WARNED, Group, json_text, progress_on_terminal, say, show, show_written
from .fleet_check import check_cluster, cluster_options, fleet_check, protocol_option
from .fleet_network import fleet_export, fleet_network
from .options import SENSORS, Brief, more_option, run_options

if TYPE_CHECKING:
    from ..fleet.batch import FleetSummary

FLEET_SCHEMA = "retropole/fleet-run/1"


@click.group(cls=Group)
def fleet() -> None:
    """Calibrate thousands of sites into one dataset, and watch them over time.

    \b
    Examples:
      retropole fleet calibrate recordings/ --out fleet
      retropole fleet calibrate sites.csv --out s3://city/fleet --scheduler tls://head:8786
      retropole fleet report fleet --out fleet.html
      retropole fleet check sites.csv --history history
      retropole fleet network fleet --nodes nodes.csv --out network.parquet
      retropole fleet export fleet --nodes nodes.csv --to g2o --out network.g2o
    """


fleet.add_command(fleet_check)
fleet.add_command(fleet_network)
fleet.add_command(fleet_export)


@fleet.command(cls=Brief)
@click.argument("sites", nargs=-1, required=True, metavar="SITES...")
@click.option("--out", required=True, metavar="DATASET", help="Folder or URL of the dataset.")
@cluster_options
@protocol_option
@click.option("--reports", metavar="DIR", help="Folder or URL for result and report of each site.")
@click.option("--report", metavar="FILE", help="Write the report of the fleet, one HTML page.")
@click.option("--retry", is_flag=True, help="Try sites that ended in an error again.")
@more_option("--drop-others", is_flag=True, help="Remove rows of sites that are not in SITES.")
@run_options("radius_m", SENSORS[0])
@run_options(SENSORS[1], "mast_sway_deg", more=True)
@click.option("--strict", is_flag=True, help="Exit with 1 if a site is not ok.")
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def calibrate(
    sites: tuple[str, ...],
    out: str,
    scheduler: str | None,
    workers: int | None,
    time_limit: float,
    reports: str | None,
    report: str | None,
    retry: bool,
    drop_others: bool,
    strict: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Calibrate every site of SITES, and write a row of each to DATASET.

    SITES are site files (.toml), lists (.csv, .parquet), folders and globs of these, as paths or
    as URLs (s3://, gs://). In a folder, at any depth, every .toml is a site file, and each folder
    with a target and a source, of any suffix, is a pair. A list has a column id, and target and
    source or site; more columns are options of the pair: radius_m, sensor_target, unit. The options
    below hold for pairs whose list does not say otherwise.

    What is wrong with one site is in its row, and ends nothing. What was calibrated from the same
    files by the same version is not done again: a run that was interrupted goes on.

    \b
    Examples:
      retropole fleet calibrate recordings/ --out fleet --report fleet.html
      retropole fleet calibrate 'posts/*/site.toml' --out fleet --reports reports --workers 8
      retropole fleet calibrate sites.csv --out s3://city/fleet --scheduler tls://head:8786

    \b
    Exit code:
      0    every site has its row
      1    with --strict: the verdict of a site is not ok
      2    a list, an option or the dataset is wrong, or there is no room
      130  interrupted; the partitions that are there are whole
    """
    from ..fleet.batch import calibrate_fleet
    from ..fleet.engine import connected, outcomes
    from ..fleet.overview import overview_of
    from ..fleet.report import write_fleet_report
    from ..fleet.sites import find_sites
    from ..result import RunConfig

    check_cluster(scheduler, workers)
    with progress_on_terminal(quiet or as_json) as progress:
        progress("find the sites")
        found = find_sites(sites, RunConfig(**options))
        progress("start the workers")
        with connected(scheduler, workers) as client:
            summary = calibrate_fleet(
                found,
                out,
                lambda tasks: outcomes(client, tasks),
                retry=retry,
                drop_others=drop_others,
                reports=reports,
                time_limit=time_limit,
                progress=progress,
            )
        if report is not None:
            progress("write the report")
            write_fleet_report(report, overview_of(out), reports)
    if as_json:
        counts = {
            "sites": summary.sites,
            "calibrated": summary.done,
            "others": summary.others,
            "statuses": dict(sorted(summary.statuses.items())),
            "codes": dict(sorted(summary.codes.items())),
        }
        show(json_text({"schema": FLEET_SCHEMA, "out": out, **counts}))
    elif not quiet:
        show(_in_words(summary, out, *([] if report is None else [report])))
    return EXIT_WARNED if strict and set(summary.statuses) - {"ok"} else 0


@fleet.command(cls=Brief)
@click.argument("dataset", metavar="DATASET")
@click.option("--out", required=True, metavar="FILE", help="File or URL to write.")
@click.option(
    "--reports",
    metavar="DIR",
    help="Folder or URL to which 'fleet calibrate --reports' wrote; the page links to it.",
)
@click.option(
    "--history",
    metavar="DIR",
    help="Folder or URL of the history of 'fleet check': changes are listed first. "
    "[default: history in DATASET, if there is one]",
)
@protocol_option
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def report(dataset: str, out: str, reports: str | None, history: str | None, quiet: bool) -> int:
    """Show the outcome of a fleet as one HTML page, from the DATASET of 'fleet calibrate'.

    The page begins with what needs action: sites that changed since their calibration, were
    refused, or ended in an error, each with what to do next. It has a map of all sites, how many
    ended how and why, how large the predicted errors are, and the worst twenty. It works without a
    network.

    \b
    Examples:
      retropole fleet report fleet --out fleet.html
      retropole fleet report fleet --history history --out fleet.html

    \b
    Exit code:
      0    written
      2    DATASET cannot be read, or the page not be written
    """
    from ..fleet.overview import overview_of
    from ..fleet.report import write_fleet_report

    with progress_on_terminal(quiet) as progress:
        progress("read the dataset")
        overview = overview_of(dataset, history)
        progress("write")
        write_fleet_report(out, overview, reports)
    for fault in overview.damaged:
        say(f"retropole: left out of the history: {fault}")
    if not quiet:
        show_written(out)
    return 0


def _in_words(summary: FleetSummary, *written: str) -> str:
    """Report the outcome of a fleet: counts, the most frequent codes, the path of the dataset."""
    from ..base.errors import printable
    from ..base.quantities import counted

    order = ("ok", "warn", "refused", "error")
    verdicts = ", ".join(f"{summary.statuses[s]} {s}" for s in order if s in summary.statuses)
    lines = [f"{counted(summary.sites, 'site')}: {verdicts or 'nothing to do'}"]
    lines.append(f"calibrated now: {summary.done}, as before: {summary.sites - summary.done}")
    for code, count in sorted(summary.codes.items(), key=lambda each: (-each[1], each[0])):
        lines.append(f"  {count:6d}  {code}")
    if summary.statuses.get("error"):
        lines.append("errors are tried again with --retry, or when their files have changed")
    if summary.others:
        others = counted(summary.others, "site")
        lines.append(f"in the dataset, and its report, besides: {others} not in SITES")
    lines += [f"written: {printable(place)}" for place in written]
    return "\n".join(lines)
