"""Write the outcome of a fleet to one HTML file that needs no network."""

from __future__ import annotations

import math
import os.path
import posixpath
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ..api import explain, quantities
from ..api.pages import (
    EMPTY,
    Html,
    fill,
    fill_page,
    folded,
    inline,
    join,
    share_styles,
    table,
)
from ..base.errors import printable
from ..result import REPORT_FILE, SITE_REPORT_FILE
from .dataset import AT_RANGE, FLEET_SCHEMA, Status
from .overview import STATUSES, Overview, Seen
from .storage import absolute, below, exists, folder_of, is_url, write_bytes

WORST = 20
"""Number of the largest errors that are listed."""

EXAMPLES = 3
"""Number of sites that are named for each reason."""

SHOWN = 20
"""Number of sites of a list that are shown at once; the page unfolds the others."""

MOST_FAILED = 500
"""Number of refusals, and of errors, that are listed with messages; a DuckDB query finds more."""


FIRST: dict[Status, tuple[str, str, str]] = {
    "refused": ("refused", "Refused", "Sites that were refused"),
    "error": ("errors", "Errors", "Sites that ended in an error"),
    "warn": ("warned", "With a warning", "Sites with a warning"),
}
"""The parts of the page with what needs action, in their order: name, title, caption."""

CHANGED = "changed", "Changed since the calibration", "Sites that changed since their calibration"
"""Comes before all others: what is in use there is wrong."""

MOVED = (
    "Do not use its transform any more. Check what is loose or was hit, then record the poles and "
    "calibrate it again: `retropole fleet calibrate`."
)
DISAGREEING = (
    "Check whether there is a new object in view, or a LiDAR sways. Then record and check it "
    "again: `retropole fleet check`."
)
OUTDATED = (
    "It was checked against a calibration other than that of this dataset. Check it again: "
    "`retropole fleet check`."
)
"""What to do next about a site that changed."""

ERRORS = {
    "unreadable": (
        "A file is missing, damaged or not a recording",
        "`retropole info FILE` describes a recording.",
    ),
    "usage": (
        "An option or a line of the list is invalid",
        "Correct the entry given in the message, in the list or in the site file.",
    ),
    "missing_extra": (
        "A recording needs an extra",
        "Install the extra given in the message on every worker, then `--retry`.",
    ),
    "time_limit": (
        "It took longer than its time limit",
        "Read fewer frames, or allow more time: `--retry --time-limit SECONDS`.",
    ),
    "out_of_memory": (
        "It took more memory than its worker has",
        "Start fewer `--workers`, or set a smaller `max_points` in the list; then `--retry`.",
    ),
    "killed": (
        "Its process crashed or was ended repeatedly",
        "`--retry` with fewer `--workers`; if that also fails, a recording is damaged.",
    ),
    "worker_lost": ("Its workers died repeatedly", "Check the workers, then `--retry`."),
    "system": (
        "The worker's disk or system failed",
        "Free disk space, or repair what the message reports, then `--retry`.",
    ),
    "internal": (
        "An error of this program",
        "Report it, with the message and the files of one such site.",
    ),
}
"""What the code of a row that ended in an error means, in short, and what to do about it."""

EARTH = 6_371_009.0
"""Mean radius of the Earth, m (IUGG, Moritz 2000): a map of a city to 0.3 %."""

WIDTH, HEIGHTS = 520, (200.0, 560.0)
"""Of a picture in its units; the least and the greatest height of the map."""

MARGIN = 44
"""Around what is drawn."""

LEAST_SPAN = 200.0
"""A map shows at least this much, m."""

FLAT_BELOW = 500e3
"""So wide a map, m, is to scale everywhere within 1 % or so; a wider one in its middle."""

MOST_NAMED = 20_000
"""At most this many sites, the worst first, have their names in the map: a page of 2 MB."""

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


def render_fleet(overview: Overview, link: Callable[[Seen], str] = lambda site: "") -> str:
    """Render the outcome of a fleet as one HTML page.

    Parameters
    ----------
    overview
        As `overview.overview_of` gives it.
    link
        Where the report of a site is, as the page links to it; empty for nowhere.

    Returns
    -------
    str
        The page. It contains its style and code, loads nothing from any other address, and works
        from a file. The same dataset gives the same page.
    """
    link = cache(link)
    every = (
        (*CHANGED[:2], _listed_changes(overview, link)),
        *((*each[:2], _listed(overview, status, link)) for status, each in FIRST.items()),
        ("map", "Map", fleet_map(overview.sites, link)),
        ("reasons", "Reasons", _reasons(overview)),
        ("far", "Errors at 30 m", _far(overview)),
        ("worst", "Largest errors", _worst(overview, link)),
        ("run", "This dataset", _dataset(overview)),
    )
    parts = [{"part": part, "title": title, "body": body} for part, title, body in every if body]
    name = _named(overview)
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


def _named(overview: Overview) -> str:
    """Name the dataset by its folder alone: a page is passed on, and its path is private."""
    return printable(posixpath.basename(overview.place.rstrip("/\\")) or overview.place)


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
        If it cannot be written.
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
    """Write how one folder is reached from another; None if a link cannot."""
    if not is_url(folder) and not is_url(to):
        try:
            return Path(os.path.relpath(to, folder)).as_posix()
        except ValueError:  # On another drive.
            return None
    (scheme, _, here), (other, _, there) = folder.partition("://"), to.partition("://")
    # The first name is a bucket: no relative link goes from one to another.
    if scheme != other or here.split("/")[0] != there.split("/")[0]:
        return None
    return posixpath.relpath(f"/{there}", f"/{here}")


def _when(overview: Overview) -> str:
    text = quantities.counted(len(overview.sites), "site")
    if overview.first is None or overview.last is None:
        return text
    return (
        f"{text} · calibrated {overview.first:%Y-%m-%d %H:%M} to {overview.last:%Y-%m-%d %H:%M} UTC"
    )


def _counts(overview: Overview) -> Html:
    """State how many sites had which outcome, at the top."""
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
        text = f"{quantities.counted(count, 'site')} {needs} action"
        to_do = fill("fleet-to-do", said=text, name=first[0], title=first[1])
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
    return fill("fleet-far", table=listed)


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
        text, to_do = _explained(code)
        found = ", ".join(named) + more
        rows.append((printable(code), text, to_do, found, f"{len(sites):,}"))
        commonest = Counter(site.status for site in sites).most_common(1)[0][0]
        bars.append((commonest, len(sites) / len(overview.sites)))
    header = ("code", "what it says", "what to do", "for example", "sites")
    return table("Sites by reason", header, rows, (1, 2, 3), bars)


def _dataset(overview: Overview) -> Html:
    """State the content of the page."""
    rows = [("dataset", _named(overview)), ("schema", FLEET_SCHEMA)]
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


def _listed(overview: Overview, status: Status, link: Callable[[Seen], str]) -> Html:
    """List the sites of a status, with what to do next."""
    sites = [site for site in overview.sites if site.status == status]
    if not sites:
        return EMPTY
    shown = sites[:MOST_FAILED]
    rows = [(*_site_text(site), _next(site)) for site in shown]
    links = [link(site) for site in shown]
    parts = [fill("fleet-again")] if status == "error" else []
    parts.append(_table(FIRST[status][2], ("codes", "what is wrong"), rows, links))
    if more_than := len(sites) - len(shown):
        parts.append(fill("fleet-more", count=f"{more_than:,}", status=status))
    return join(parts)


def _table(
    caption: str, said: tuple[str, str], rows: Sequence[Sequence[object]], links: Sequence[str]
) -> Html:
    """Arrange a list of sites, of a long one the first at once, the rest folded away."""
    header = ("site", *said, "what to do next")
    first = table(caption, header, rows[:SHOWN], (1, 2, 3), links=links[:SHOWN])
    if not (rest := rows[SHOWN:]):
        return first
    more = table(f"{caption}: the rest", header, rest, (1, 2, 3), links=links[SHOWN:])
    return join((first, folded(f"{len(rest):,} more", more)))


def _listed_changes(overview: Overview, link: Callable[[Seen], str]) -> Html:
    """List what changed since it was calibrated, with what to do next."""
    rows = []
    for each in overview.changed:
        events = each.change.changes
        is_moved = any(event.kind != "unsettled" for event in events)
        to_do = (MOVED if is_moved else DISAGREEING) if each.is_current else OUTDATED
        kinds = ", ".join(dict.fromkeys(event.kind for event in events))
        changes = "; ".join(map(each.change.describe, events))
        rows.append((printable(each.change.id), kinds, changes, inline(to_do)))
    links = [link(each.site) for each in overview.changed]
    return _table(CHANGED[2], ("kind", "what changed"), rows, links) if rows else EMPTY


def _site_text(site: Seen) -> tuple[str, str, str]:
    """Name a site, its codes and what is wrong with it: its messages, or what its codes mean."""
    meant = "; ".join(_explained(code)[0] for code in site.codes)
    cells = (site.id, ", ".join(site.codes), " ".join(site.messages) or meant)
    return printable(cells[0]), printable(cells[1]), printable(cells[2])


def _next(site: Seen) -> Html:
    """Advise on the next step for the first code of a site."""
    known = explain(site.codes[0]) if site.codes else None
    if known is not None and known.advice:
        return inline(known.advice[0])
    return _explained(site.codes[0])[1] if site.codes else inline(quantities.UNKNOWN)


def _explained(code: str) -> tuple[str, Html]:
    """Explain a code, with advice."""
    known = explain(code)
    if known is not None:
        return known.title, inline(" ".join(known.advice))
    title, to_do = ERRORS.get(code, (quantities.UNKNOWN, quantities.UNKNOWN))
    return title, inline(to_do)


def _shape(status: Status, r: float) -> str:
    """Draw what marks a status next to its colour, from its middle: dot, triangle, square,
    cross."""
    if status == "ok":
        return "h.01"
    if status == "warn":
        return f"m0{-1.2 * r:.2g}l{1.2 * r:.2g} {2.2 * r:.2g}h{-2.4 * r:.2g}z"
    if status == "refused":
        return f"m{-r:.2g}{-r:.2g}h{2 * r:.2g}v{2 * r:.2g}h{-2 * r:.2g}z"
    return f"m{-r:.2g}{-r:.2g}l{2 * r:.2g} {2 * r:.2g}m0{-2 * r:.2g}l{-2 * r:.2g} {2 * r:.2g}"


def fleet_map(sites: Sequence[Seen], link: Callable[[Seen], str] = lambda site: "") -> Html:
    """Draw where the sites are whose place is known: a figure, or a sentence where none is.

    Those that need action lead to their reports, where there are any.
    """
    placed = [s for s in sites if s.latitude_rad is not None and s.longitude_rad is not None]
    if not placed:
        return fill("fleet-no-map")
    view = _View(placed)
    size = next(r for r, most in ((6.0, 50), (4.0, 1000), (2.5, math.inf)) if len(placed) <= most)
    named, marks, keys = MOST_NAMED, list[Html](), list[Html]()
    # The worst are drawn last, on top, and are the first to be named.
    for status in reversed(STATUSES):
        if of_status := [site for site in placed if site.status == status]:
            marks.append(_marks(status, of_status, view, size, named, link))
            shape, count = _shape(status, 5.0), f"{len(of_status):,}"
            keys.append(fill("fleet-key", status=status, shape=shape, count=count))
            named = max(0, named - len(of_status))
    return fill(
        "fleet-map",
        width=WIDTH,
        height=round(view.height),
        marks=join((*reversed(marks), view.scale_bar())),
        legend=join(reversed(keys)),
        said=_map_text(len(placed), len(sites), view),
    )


class _View:
    """From latitude and longitude to the picture: north is at the top, to scale in the middle."""

    def __init__(self, placed: Sequence[Seen]) -> None:
        longitudes = [site.longitude_rad or 0.0 for site in placed]
        # Longitudes count from their mean direction, so that a fleet may lie across 180°.
        self._from = math.atan2(sum(map(math.sin, longitudes)), sum(map(math.cos, longitudes)))
        x = [self._east(each) for each in longitudes]
        y = [site.latitude_rad or 0.0 for site in placed]
        self._x, self._y = (min(x) + max(x)) / 2, (min(y) + max(y)) / 2
        self._narrow = max(math.cos(self._y), 0.01)
        self.metres = (EARTH * self._narrow * (max(x) - min(x)), EARTH * (max(y) - min(y)))
        spans = [max(each, LEAST_SPAN) for each in self.metres]
        self._scale = min((WIDTH - 2 * MARGIN) / spans[0], (HEIGHTS[1] - 2 * MARGIN) / spans[1])
        self.height = min(max(self._scale * spans[1] + 2 * MARGIN, HEIGHTS[0]), HEIGHTS[1])

    def _east(self, longitude: float) -> float:
        return (longitude - self._from + math.pi) % (2 * math.pi) - math.pi

    def place(self, site: Seen) -> tuple[float, float]:
        """Give where a site is in the picture."""
        assert site.latitude_rad is not None
        assert site.longitude_rad is not None
        scale = self._scale * EARTH
        return (
            WIDTH / 2 + scale * self._narrow * (self._east(site.longitude_rad) - self._x),
            self.height / 2 - scale * (site.latitude_rad - self._y),
        )

    def scale_bar(self) -> Html:
        """Draw a round length."""
        metres = quantities.round_below(0.25 * WIDTH / self._scale)
        size, unit = (metres, "m") if metres < 1000 else (metres / 1000, "km")
        text = f"{quantities.large(size)} {unit}"
        y, above, length = self.height - 19, self.height - 24, metres * self._scale
        return fill("fleet-scale", y=y, above=above, length=length, size=text)


def _marks(
    status: Status,
    sites: Sequence[Seen],
    view: _View,
    size: float,
    named: int,
    link: Callable[[Seen], str],
) -> Html:
    """Draw sites of one status; those beyond the named ones only if there is none yet."""
    shape = _shape(status, size)
    drawn = []
    for site in sites[:named]:
        x, y = view.place(site)
        name = f"{site.id}: {status}"
        if site.sigma_30m_m is not None:
            name += f", {quantities.error(site.sigma_30m_m)} at 30 m"
        mark = fill("fleet-named", x=x, y=y, shape=shape, name=name)
        # What is ok is not in the way of who steps from link to link.
        to = "" if status == "ok" else link(site)
        drawn.append(fill("fleet-link", to=to, name=name, mark=mark) if to else mark)
    for at in sorted({(round(x), round(y)) for x, y in map(view.place, sites[named:])}):
        drawn.append(fill("fleet-mark", x=at[0], y=at[1], shape=shape))
    return fill("fleet-marks", status=status, size=round(10 * size), marks=join(drawn))


def _map_text(placed: int, sites: int, view: _View) -> str:
    """Describe the map, also for those who do not see it."""
    text = [
        f"{quantities.counted(placed, 'site')}. North is at the top; the worst are drawn on top."
    ]
    if max(view.metres) > FLAT_BELOW:
        text.append("The scale is valid in the middle.")
    if sites > placed:
        text.append(f"{quantities.counted(sites - placed, 'site')} of unknown position not drawn.")
    if placed > MOST_NAMED:
        text.append(f"{MOST_NAMED:,} show their names under the pointer, the worst first.")
    return " ".join(text)
