"""Put the outcome of a fleet into one HTML file that needs no network."""

from __future__ import annotations

import os.path
import posixpath
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ..api import quantities
from ..api.pages import EMPTY, Html, fill, fill_page, join, share_styles, table
from ..base.errors import printable
from ..result.folder import REPORT_FILE, SITE_REPORT_FILE
from .dataset import AT_RANGE, FLEET_SCHEMA
from .overview import Overview, Seen
from .pictures import fleet_map, histogram
from .storage import absolute, below, exists, folder_of, is_url, write_bytes
from .to_do import CHANGED, FIRST, explained, listed, listed_changes

WORST = 20
"""So many of the largest errors are listed."""

EXAMPLES = 3
"""So many sites are named for each reason."""

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


def render_fleet(overview: Overview, link: Callable[[Seen], str] = lambda site: "") -> str:
    """Render the outcome of a fleet as one HTML page.

    Parameters
    ----------
    overview
        As `overview.overview_of` gives it.
    link
        Where a site's own report is, as the page links to it; empty for nowhere.

    Returns
    -------
    str
        The page. It holds its style and code, asks no other address for anything, and works from a
        file. The same dataset gives the same page.
    """
    link = cache(link)
    every = (
        (CHANGED.name, CHANGED.title, listed_changes(overview, link)),
        *((one.name, one.title, listed(overview, status, link)) for status, one in FIRST.items()),
        ("map", "Map", fleet_map(overview.sites, link)),
        ("reasons", "Reasons", _reasons(overview)),
        ("far", "Errors at 30 m", _far(overview)),
        ("worst", "Largest errors", _worst(overview, link)),
        ("run", "This dataset", _dataset(overview)),
    )
    parts = [{"part": part, "title": title, "body": body} for part, title, body in every if body]
    name = printable(posixpath.basename(overview.place.rstrip("/\\")) or overview.place)
    return fill_page(
        "fleet.html",
        ("style.css", "fleet.css"),
        ("page.js", "fleet.js"),
        {
            "title": escape(name),
            "created": escape(_when(overview)),
            "counts": _counts(overview),
            "links": join(fill("fleet-part-link", **part) for part in parts),
            "parts": join(fill("fleet-part", **part) for part in parts),
        },
        share_styles(),
    )


def write_fleet_report(place: str, overview: Overview, reports: str | None = None) -> None:
    """Write `render_fleet`'s page to a file or a URL, whole or not at all.

    Parameters
    ----------
    place
        Path or URL of the page.
    overview
        What it shows.
    reports
        Path or URL of the folder with the reports of the sites, as ``fleet calibrate --reports``
        wrote them; those that are there are linked to.

    Raises
    ------
    OSError
        Where it cannot be written.
    """
    place = absolute(place)
    folder = None if reports is None else absolute(reports)
    root = None if folder is None else _from(folder_of(place), folder)

    def link(site: Seen) -> str:
        name = REPORT_FILE if site.kind == "pair" else SITE_REPORT_FILE
        if folder is None or root is None or not exists(below(folder, site.id, name)):
            return ""
        # A path that begins with a name and a colon would be taken for a URL.
        return quote(f"./{root}/{site.id}/{name}")

    write_bytes(place, render_fleet(overview, link).encode("utf-8"))


def _from(folder: str, to: str) -> str | None:
    """Write how one folder is reached from another; None where a link cannot."""
    if not is_url(folder) and not is_url(to):
        try:
            return Path(os.path.relpath(to, folder)).as_posix()
        except ValueError:  # On another drive.
            return None
    (scheme, _, here), (other, _, there) = folder.partition("://"), to.partition("://")
    # The first name is a bucket: no relative link leads from one to another.
    if scheme != other or here.split("/")[0] != there.split("/")[0]:
        return None
    return posixpath.relpath(f"/{there}", f"/{here}")


def _when(overview: Overview) -> str:
    said = quantities.counted(len(overview.sites), "site")
    if overview.first is None or overview.last is None:
        return said
    return (
        f"{said} · calibrated {overview.first:%Y-%m-%d %H:%M} to {overview.last:%Y-%m-%d %H:%M} UTC"
    )


def _counts(overview: Overview) -> Html:
    """Say how many sites ended how, before all else."""
    every = len(overview.sites)
    tiles = []
    for status, count in overview.statuses.items():
        share = quantities.percent(count / every).replace(" ", "\N{NO-BREAK SPACE}")
        tiles.append(fill("fleet-tile", status=status, count=f"{count:,}", share=share))
    stated = ""
    if errors := overview.errors_at_range:
        half, most = (quantities.error(_quantile(errors, level)) for level in (0.5, 0.95))
        stated = (
            f"Half of the {quantities.counted(len(errors), 'site')} with an answer have a "
            f"predicted error of at most {half} at {AT_RANGE:g} m (1 σ), 95 % of them of at most "
            f"{most}."
        )
    waiting = [one for status, one in FIRST.items() if status in overview.statuses]
    if overview.changed:
        waiting.insert(0, CHANGED)
    to_do = ""
    if waiting:
        # One that changed may have had a warning before.
        acting = {site.id for site in overview.sites if site.status in FIRST}
        first, count = waiting[0], len(acting | {each.site.id for each in overview.changed})
        needs = "needs" if count == 1 else "need"
        said = f"{quantities.counted(count, 'site')} {needs} action"
        to_do = fill("fleet-to-do", said=said, name=first.name, title=first.title)
    sites = quantities.counted(every, "site")
    return fill("fleet-counts", sites=sites, stated=stated, to_do=to_do, tiles=join(tiles))


def _quantile(values: Sequence[float], level: float) -> float:
    """Give the least of the values that so large a share of them does not exceed."""
    return float(np.quantile(values, level, method="inverted_cdf"))


def _far(overview: Overview) -> Html:
    """Show how large the predicted errors are."""
    errors = overview.errors_at_range
    if not errors:
        return fill("p", text="No site has an answer, so there is no predicted error.")
    inner = {f"{quantities.percent(level)} have at most": level for level in LEVELS}
    rows = [
        (what, quantities.error(_quantile(errors, level)))
        for what, level in {"least": 0.0, **inner, "largest": 1.0}.items()
    ]
    listed = table("Predicted error at 30 m", ("sites with an answer", "1 σ"), rows)
    return fill("fleet-far", histogram=histogram(errors), table=listed)


def _worst(overview: Overview, link: Callable[[Seen], str]) -> Html:
    """List the answers with the largest predicted errors."""
    sites = overview.worst(WORST)
    if not sites:
        return EMPTY
    rows = []
    for site in sites:
        codes = printable(", ".join(site.codes)) or quantities.UNKNOWN
        rows.append((printable(site.id), site.status, quantities.error(site.sigma_30m_m), codes))
    links = [link(site) for site in sites]
    caption = f"The {len(rows)} largest predicted errors"
    header = ("site", "status", "error at 30 m, 1 σ", "codes")
    listed = table(caption, header, rows, (1, 3), links=links)
    return listed if any(links) else join((listed, fill("fleet-not-linked")))


def _reasons(overview: Overview) -> Html:
    """Count the codes, with a few sites of each."""
    having: dict[str, list[Seen]] = {}
    for site in overview.sites:
        for code in dict.fromkeys(site.codes):
            having.setdefault(code, []).append(site)
    if not having:
        return fill("p", text="No site has a reason: all are ok.")
    rows, bars = list[tuple[object, ...]](), []
    for code, sites in sorted(having.items(), key=lambda each: (-len(each[1]), each[0])):
        named = [printable(site.id) for site in sites[:EXAMPLES]]
        more = ", …" if len(sites) > EXAMPLES else ""
        said, to_do = explained(code)
        found = ", ".join(named) + more
        rows.append((printable(code), said, to_do, found, f"{len(sites):,}"))
        commonest = Counter(site.status for site in sites).most_common(1)[0][0]
        bars.append((commonest, len(sites) / len(overview.sites)))
    header = ("code", "what it says", "what to do", "for example", "sites")
    return table("Sites by reason", header, rows, (1, 2, 3), bars)


def _dataset(overview: Overview) -> Html:
    """Say what the page is of."""
    rows = [("dataset", printable(overview.place)), ("schema", FLEET_SCHEMA)]
    for what, counts in (("made by", overview.made_by), ("done on", overview.hosts)):
        # The ten commonest.
        for name, n in sorted(counts.items(), key=lambda each: (-each[1], each[0]))[:10]:
            rows.append((f"{what} ({quantities.counted(n, 'site')})", printable(name)))
    if seconds := sorted(overview.seconds):
        for what, level in (("median", 0.5), ("95 % at most", 0.95), ("longest", 1.0)):
            value = quantities.duration(_quantile(seconds, level))
            rows.append((f"time of one site, {what}", value))
        rows.append(("of all together", quantities.duration(sum(seconds))))
    return table("What this page shows", ("what", "value"), rows, (1,))
