"""What of a fleet needs action: which sites, what is wrong with each, and what to do next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..api import explain, quantities
from ..api.pages import EMPTY, Html, fill, folded, inline, join, table
from ..base.errors import printable
from .dataset import Status
from .overview import Overview, Seen

SHOWN = 20
"""So many sites of a list are shown at once; the page unfolds the others."""

MOST_FAILED = 500
"""So many refusals, and errors, are listed with their messages; a DuckDB query tells of more."""


class Part(NamedTuple):
    """A part of the page: where links find it, its title, and the caption of its table."""

    name: str
    title: str
    caption: str


FIRST: dict[Status, Part] = {
    "refused": Part("refused", "Refused", "Sites that were refused"),
    "error": Part("errors", "Errors", "Sites that ended in an error"),
    "warn": Part("warned", "With a warning", "Sites with a warning"),
}
"""The parts of the page with what needs action, in their order."""

CHANGED = Part(
    "changed", "Changed since the calibration", "Sites that changed since their calibration"
)
"""Comes before all others: what is in use there is wrong."""

MOVED = (
    "Do not use its transform any more. See what is loose or was hit, then record the poles and "
    "calibrate it again: `retropole fleet calibrate`."
)
DISAGREEING = (
    "See whether something new stands in view, or a LiDAR sways. Then record and check it again: "
    "`retropole fleet check`."
)
OUTDATED = (
    "It was checked against another calibration than that of this dataset. Check it again: "
    "`retropole fleet check`."
)
"""What to do next about a site that changed."""

ERRORS = {
    "unreadable": (
        "A file is absent, damaged or no recording",
        "`retropole info FILE` says what a recording holds.",
    ),
    "usage": (
        "An option or a line of the list is invalid",
        "Correct what the message names in the list, or in the site file.",
    ),
    "missing_extra": (
        "A recording needs an extra",
        "Install on every worker what the message names, then `--retry`.",
    ),
    "time_limit": (
        "It took longer than its time limit",
        "Read fewer frames, or give it longer: `--retry --time-limit SECONDS`.",
    ),
    "out_of_memory": (
        "It took more memory than its worker has",
        "Start fewer `--workers`, or set a smaller `max_points` in the list; then `--retry`.",
    ),
    "killed": (
        "Its process crashed or was ended, again and again",
        "`--retry` with fewer `--workers`; if that ends so too, a recording is damaged.",
    ),
    "worker_lost": ("Its workers died, again and again", "Look at the workers, then `--retry`."),
    "system": (
        "The worker's disk or system failed",
        "Make room, or mend what the message names, then `--retry`.",
    ),
    "internal": (
        "A fault of this program",
        "Report it, with the message and the files of one such site.",
    ),
}
"""What the code of a row that ended in an error means, in short, and what to do about it."""


def listed(overview: Overview, status: Status, link: Callable[[Seen], str]) -> Html:
    """List the sites of a status, with what to do next."""
    sites = [site for site in overview.sites if site.status == status]
    if not sites:
        return EMPTY
    shown = sites[:MOST_FAILED]
    rows = [(*_said(site), _next(site)) for site in shown]
    links = [link(site) for site in shown]
    parts = [fill("fleet-again")] if status == "error" else []
    parts.append(_table(FIRST[status].caption, ("codes", "what is wrong"), rows, links))
    if more_than := len(sites) - len(shown):
        parts.append(fill("fleet-more", count=f"{more_than:,}", status=status))
    return join(parts)


def _table(
    caption: str, said: tuple[str, str], rows: Sequence[Sequence[object]], links: Sequence[str]
) -> Html:
    """Lay out a list of sites, of a long one the first at once, the rest folded away."""
    header = ("site", *said, "what to do next")
    first = table(caption, header, rows[:SHOWN], (1, 2, 3), links=links[:SHOWN])
    if not (rest := rows[SHOWN:]):
        return first
    more = table(f"{caption}: the rest", header, rest, (1, 2, 3), links=links[SHOWN:])
    return join((first, folded(f"{len(rest):,} more", more)))


def listed_changes(overview: Overview, link: Callable[[Seen], str]) -> Html:
    """List what changed since it was calibrated, with what to do next."""
    rows = []
    for each in overview.changed:
        events = each.change.changes
        is_moved = any(event.kind != "unsettled" for event in events)
        to_do = (MOVED if is_moved else DISAGREEING) if each.is_current else OUTDATED
        kinds = ", ".join(dict.fromkeys(event.kind for event in events))
        words = "; ".join(map(each.change.words, events))
        rows.append((printable(each.change.id), kinds, words, inline(to_do)))
    links = [link(each.site) for each in overview.changed]
    return _table(CHANGED.caption, ("kind", "what changed"), rows, links) if rows else EMPTY


def _said(site: Seen) -> tuple[str, str, str]:
    """Name a site, its codes and what is wrong with it: its messages, or what its codes mean."""
    meant = "; ".join(explained(code)[0] for code in site.codes)
    words = (site.id, ", ".join(site.codes), " ".join(site.messages) or meant)
    return printable(words[0]), printable(words[1]), printable(words[2])


def _next(site: Seen) -> Html:
    """Say what to do next about the first code of a site."""
    known = explain(site.codes[0]) if site.codes else None
    if known is not None and known.advice:
        return inline(known.advice[0])
    return explained(site.codes[0])[1] if site.codes else inline(quantities.UNKNOWN)


def explained(code: str) -> tuple[str, Html]:
    """Say what a code means, and what to do about it."""
    known = explain(code)
    if known is not None:
        return known.title, inline(" ".join(known.advice))
    title, to_do = ERRORS.get(code, (quantities.UNKNOWN, quantities.UNKNOWN))
    return title, inline(to_do)
