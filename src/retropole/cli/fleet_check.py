"""The command ``retropole fleet check``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import click

from ..base.errors import printable
from ..base.quantities import counted
from ..fleet import TIME_LIMIT
from .check import tolerance_options
from .common import EXIT_MOVED, EXIT_REFUSED, json_text, progress_on_terminal, show
from .options import Brief, Command, Number, Whole, more_option

if TYPE_CHECKING:
    from ..fleet.history.run import FleetCheck, SiteChange
    from ..fleet.history.store import CheckRow
    from ..fleet.history.watch import Event

SCHEMA = "retropole/fleet-check/1"


def cluster_options(command: Command) -> Command:
    """Give a command --scheduler, --workers and --time-limit, for work that a Dask cluster does."""
    scheduler = click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a Dask cluster: tls://host:8786, or tcp:// in a private network.",
    )
    workers = click.option(
        "--workers",
        type=Whole(1, 1024),
        help="Number of local processes, without --scheduler.  [default: one per processor]",
    )
    kind = Number(min=1, max=1e6)
    time_limit = more_option(
        "--time-limit", type=kind, default=TIME_LIMIT, metavar="SECONDS", help="For one site."
    )
    return scheduler(workers(time_limit(command)))


def protocol_option(command: Command) -> Command:
    """Give a command --protocol: URLs that it follows in addition to those of every command."""

    def follow(context: click.Context, option: click.Parameter, names: tuple[str, ...]) -> None:
        from ..fleet.storage import also_following

        context.with_resource(also_following(names))

    return more_option(
        "--protocol",
        multiple=True,
        expose_value=False,
        callback=follow,
        metavar="NAME",
        help="Follow URLs of this protocol of fsspec too, as ftp, wherever they appear, also "
        "in SITES.  [always: s3, gs, abfs, memory]",
    )(command)


def check_cluster(scheduler: str | None, workers: int | None) -> None:
    """Refuse a number of local processes for a remote cluster."""
    if scheduler is not None and workers is not None:
        raise click.UsageError("--workers is for local processes: give it or --scheduler, not both")


@click.command("check", cls=Brief)
@click.argument("sites", nargs=-1, required=True, metavar="SITES...")
@click.option(
    "--history",
    required=True,
    metavar="DIR",
    help="Folder or URL of the history (Parquet), which is extended, or created if there is none.",
)
@click.option(
    "--answers",
    metavar="DATASET",
    help="Dataset of 'retropole fleet calibrate' with the stored results, by the ids of the sites.",
)
@cluster_options
@protocol_option
@tolerance_options
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def fleet_check(
    sites: tuple[str, ...],
    history: str,
    answers: str | None,
    scheduler: str | None,
    workers: int | None,
    time_limit: float,
    rotation: float | None,
    translation: float | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Check SITES against their stored results, append to a history, and report what changed.

    SITES are lists (.csv, .parquet), folders and globs of these, as paths or URLs (s3://, gs://),
    as 'retropole fleet calibrate' takes them: of each pair a new target and a new source, of each
    site of many LiDARs a site file with the new recordings, whose pairs are checked. What each is
    compared with is in DATASET, or else in the column result of the list, or else in result.json
    next to the target, or site-result.json next to the site file. The column time (ISO 8601) says
    when it was recorded; otherwise that is when the later of the two was written.

    Of each site all checks since it was calibrated count: a step is reported when a second check
    confirms it, a trend when enough have shown it, and that the site moved when two checks in a row
    say so. A single check that is off is not a change. What the history has already is not checked
    again. What is wrong with one site is in its row, and ends nothing; what is damaged of the
    history is named and left out.

    \b
    Examples:
      retropole fleet check tonight.csv --answers fleet --history history
      retropole fleet check sites.csv --history s3://city/history --scheduler tls://head:8786

    \b
    Exit code:
      0    no site has changed since it was calibrated
      2    a list, an option or the dataset is wrong, or there is no room
      3    of no site could it be said
      4    a site has changed
      130  interrupted; what was checked is in the history
    """
    from ..fleet.engine import connected, mapped, outcomes
    from ..fleet.history.run import check_fleet
    from ..fleet.sites import find_sites

    check_cluster(scheduler, workers)
    with progress_on_terminal(quiet or as_json) as progress:
        progress("find the sites")
        sites_found = find_sites(sites)
        progress("start the workers")
        with connected(scheduler, workers) as client:
            found = check_fleet(
                sites_found,
                history,
                lambda tasks: outcomes(client, tasks),
                answers=answers,
                tolerance=(rotation, translation),
                time_limit=time_limit,
                progress=progress,
                replaying=partial(mapped, client),
            )
    if as_json:
        show(json_line(found, len(sites_found)))
    elif not quiet:
        show(in_words(found, len(sites_found)))
    if any(site.changes for site in found.sites):
        return EXIT_MOVED
    return 0 if any(site.is_decided for site in found.sites) else EXIT_REFUSED


def json_line(found: FleetCheck, sites: int) -> str:
    """Write what was found at the sites as one line of JSON; null if not known."""
    return json_text(
        {
            "schema": SCHEMA,
            "sites": sites,
            "pairs": len(found.sites),
            "appended": found.appended,
            "changed": [
                {"id": site.id, **_plain(site, event)}
                for site in found.sites
                for event in site.changes
            ],
            "not_confirmed": [
                {"id": site.id, "since": site.times[site.watched.waiting[0]].isoformat()}
                for site in found.sites
                if site.watched.waiting
            ],
            "not_told": [
                {
                    "id": site.id,
                    "status": site.newest.status,
                    "codes": site.newest.codes,
                    "message": site.newest.message,
                }
                for site in found.sites
                if not site.is_decided
            ],
            "damaged": found.damaged,
        }
    )


def _plain(site: SiteChange, event: Event) -> dict[str, Any]:
    return {
        "kind": event.kind,
        "since": site.times[event.onset].isoformat(),
        "found": site.times[event.found].isoformat(),
        "new": site.is_new(event),
        "clear": event.is_clear,
        "statistic": event.statistic,
        "size": event.size,
        "covariance": event.covariance,
    }


def in_words(found: FleetCheck, sites: int) -> str:
    """Write what was found at the sites: a line for each pair with news."""
    lines = []
    for site in found.sites:
        text = [site.describe(event) for event in site.changes]
        if site.watched.waiting:
            since = site.times[site.watched.waiting[0]]
            text.append(f"off since {since:%Y-%m-%d}, not confirmed yet: another check decides")
        if not site.is_decided:
            text.append(_undecided(site.newest))
        if text:
            lines.append(printable(f"{site.id}: {'; '.join(text)}"))
    lines += [printable(f"left out of the history: {fault}") for fault in found.damaged]
    changed = sum(bool(site.changes) for site in found.sites)
    undecided = sum(not site.is_decided for site in found.sites)
    pairs = "" if len(found.sites) == sites else f"{counted(len(found.sites), 'pair')} of "
    lines.append(
        f"{pairs}{counted(sites, 'site')}, {counted(found.appended, 'new check')}; changed "
        f"since their calibration: {changed}, undecided: {undecided}"
    )
    return "\n".join(lines)


def _undecided(newest: CheckRow) -> str:
    """Give the reason why a check gave no answer; by codes where it cannot be determined."""
    codes = ", ".join(newest.codes)
    if newest.status == "error":
        return f"error ({codes}: {newest.message})"
    return f"{newest.status.replace('_', ' ')} ({codes})"
