"""The command ``retropole fleet check``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..monitoring.tolerance import DEFAULT_TOLERANCE
from .check import EXIT_MOVED
from .common import CONTEXT, DEGREES, EXIT_REFUSED, METRES, progress_on_terminal, show

if TYPE_CHECKING:
    from ..fleet.history.events import Event
    from ..fleet.history.run import FleetCheck, SiteChange

SCHEMA = "retropole/fleet-check/1"


@click.command("check", context_settings=CONTEXT)
@click.argument("sites", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--history",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder of the history (Parquet), which is appended to; made where there is none.",
)
@click.option(
    "--processes",
    type=click.IntRange(1, 256),
    default=1,
    show_default=True,
    help="How many sites to check at a time.",
)
@click.option(
    "--tolerance-deg",
    type=DEGREES,
    default=math.degrees(DEFAULT_TOLERANCE.rotation),
    show_default=True,
    help="As for 'retropole check'.",
)
@click.option(
    "--tolerance-m",
    type=METRES,
    default=DEFAULT_TOLERANCE.translation,
    show_default=True,
    help="As for 'retropole check'.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def fleet_check(
    sites: Path,
    history: Path,
    processes: int,
    tolerance_deg: float,
    tolerance_m: float,
    as_json: bool,
    quiet: bool,
) -> int:
    """Check SITES against their stored results, append to a history, and tell what changed.

    SITES is a list, CSV or Parquet, with the columns id, target, source, result and, if known, time
    (ISO 8601; otherwise when the recordings were written), paths relative to the list. Or a folder
    of folders, one for each site, with result.json and recordings named target and source.

    Of each site all checks since it was calibrated count: a step is told when a second check
    confirms it, a trend when enough have shown it. A single check that is off is no change.
    What the history has already is not checked again.

    \b
    Examples:
      retropole fleet check sites.csv --history history
      retropole fleet check sites.csv --history history --processes 8 --json

    \b
    Exit code:
      0    no site has changed since it was calibrated
      2    a file or an option is wrong
      3    no site could be told
      4    a site has changed
      130  interrupted
    """
    from ..fleet.history.check import find_sites
    from ..fleet.history.run import check_fleet
    from ..monitoring.tolerance import Tolerance

    with progress_on_terminal(quiet or as_json) as progress:
        found = check_fleet(
            find_sites(sites),
            history,
            tolerance=Tolerance(math.radians(tolerance_deg), tolerance_m),
            processes=processes,
            progress=progress,
        )
    if as_json:
        show(json_line(found))
    elif not quiet:
        show(in_words(found))
    if any(site.changes for site in found.sites):
        return EXIT_MOVED
    return 0 if any(site.is_told for site in found.sites) else EXIT_REFUSED


def json_line(found: FleetCheck) -> str:
    """Write what was found as one line of JSON; what is not known is null."""
    return json.dumps(
        {
            "schema": SCHEMA,
            "sites": len(found.sites),
            "appended": found.appended,
            "changed": [
                {"id": site.id, **_plain(site, event)}
                for site in found.sites
                for event in site.changes
            ],
            "not_confirmed": [
                {"id": site.id, "since": site.rows[site.watched.waiting[0]].time.isoformat()}
                for site in found.sites
                if site.watched.waiting
            ],
            "not_told": [
                {
                    "id": site.id,
                    "status": site.newest.status,
                    "codes": list(site.newest.codes),
                    "message": site.newest.message,
                }
                for site in found.sites
                if not site.is_told
            ],
        }
    )


def _plain(site: SiteChange, event: Event) -> dict[str, Any]:
    size, covariance = event.size, event.covariance
    return {
        "kind": event.kind,
        "since": site.rows[event.onset].time.isoformat(),
        "found": site.rows[event.found].time.isoformat(),
        "new": site.is_new(event),
        "clear": event.is_clear,
        "statistic": event.statistic,
        "size": None if size is None else size.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }


def in_words(found: FleetCheck) -> str:
    """Write what was found as a person reads it: a line for each site that has something to say."""
    from ..errors import printable

    lines = []
    for site in found.sites:
        said = [_said(site, event) for event in site.changes]
        if site.watched.waiting:
            since = site.rows[site.watched.waiting[0]].time
            said.append(f"off since {since:%Y-%m-%d}, not confirmed")
        if not site.is_told:
            why = ", ".join(site.newest.codes) or site.newest.message or ""
            said.append(f"{site.newest.status.replace('_', ' ')} ({why})")
        if said:
            lines.append(printable(f"{site.id}: {'; '.join(said)}"))
    changed = sum(bool(site.changes) for site in found.sites)
    untold = sum(not site.is_told for site in found.sites)
    lines.append(
        f"{len(found.sites)} sites, {found.appended} new checks: {changed} changed since they were "
        f"calibrated, {untold} not told"
    )
    return "\n".join(lines)


def _said(site: SiteChange, event: Event) -> str:
    from ..quantities import value_and_error

    since = f"{site.rows[event.onset].time:%Y-%m-%d}"
    new = ", new" if site.is_new(event) else ""
    if event.size is None or event.covariance is None:
        return f"checks that do not agree since {since}{new}"
    words: list[str] = []
    words.append(value_and_error(*lengths(event, slice(0, 3)), "rad"))
    words.append(value_and_error(*lengths(event, slice(3, 6))))
    per = " a year" if event.kind == "trend" else ""
    unclear = "" if event.is_clear else ", or the other of step and trend"
    return f"{event.kind} since {since}: {words[0]}, {words[1]}{per} (1 σ{unclear}{new})"


def lengths(event: Event, part: slice) -> tuple[float, float]:
    """Give the length of a part of a change, and 1 σ of it along its own direction."""
    import numpy as np

    assert event.size is not None
    assert event.covariance is not None
    vector = event.size[part]
    length = float(np.linalg.norm(vector))
    unit = vector / max(length, 1e-12)
    return length, float(np.sqrt(unit @ event.covariance[part, part] @ unit))
