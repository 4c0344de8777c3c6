"""Put a result and its clouds into one HTML file that needs no network: of a pair, or of a site."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..base.datatypes import Placement
from ..base.files import write_atomically
from ..result import ResultDoc
from ..result.site import SiteDoc
from ..site.answer import SiteCalibration
from . import listings
from .certificate import certificate
from .hypotheses import hypotheses
from .listings import Listing
from .map import site_map
from .markup import listed, share_styles
from .missing import missing_poles
from .page import EMPTY, Html, fill, fill_page, join
from .pairs import pairs
from .plan import plan_of
from .poses import poses
from .recorded import poles, run
from .subject import LIDARS, Subject, colour_class, input_names, of_pair, of_site
from .verdict import verdict
from .view import MAX_CLOUD_POINTS, PageView, embed_json, page_view

HEADING = re.compile(r'<h2 id="([\w-]+)">(.*?)</h2>')
"""Of a part of the page: its id, and its title."""


def render_report(
    result: ResultDoc,
    placements: Sequence[Placement],
    *,
    notes: Sequence[str] = (),
    max_points: int = MAX_CLOUD_POINTS,
    site: str = "",
    serials: Sequence[str] = ("", ""),
) -> str:
    """Render a run as one HTML page.

    Parameters
    ----------
    result
        The result document.
    placements
        What was recorded and found in each placement of the poles, each cloud in its own frame.
        The first is the one whose poles the result lists; of several, the page lets its reader
        choose. A detection brings the rejected clusters and the points on the poles into the page;
        leave it out where its poles are not those of the result.
    notes
        What a reader has to know before all else, for example that an input is not the file that
        the run read.
    max_points
        At most this many points of each cloud are put into the page, which says how many it shows.
    site, serials
        Where it was calibrated, and the serial numbers of the target and the source LiDAR, for the
        certificate; what is empty is a line to fill in.

    Returns
    -------
    str
        The page. It holds its style, code and points, asks no other address for anything, and
        works from a file.

    Raises
    ------
    ValueError
        Without a placement.
    """
    if not placements:
        raise ValueError("a report shows at least one placement of the poles")
    subject = of_pair(result, placements, serials)
    names = input_names(result)[:2]
    heading = fill(
        "pair-heading",
        target=names[0] if len(names) > 1 else LIDARS[0],
        source=names[1] if len(names) > 1 else LIDARS[1],
    )
    return _render(subject, notes, max_points, heading, certificate(subject, site))


def render_site(
    document: SiteDoc, calibration: SiteCalibration | None = None, *, notes: Sequence[str] = ()
) -> str:
    """Render the result of a site as one HTML page.

    Parameters
    ----------
    document
        The result document.
    calibration
        What it is of: its clouds are shown. Without it, the page has no view of them.
    notes
        What a reader has to know before all else, for example that a recording was not found.

    Returns
    -------
    str
        The page. It holds its style, code and points, asks no other address for anything, and
        works from a file.

    Raises
    ------
    ValueError
        Where the document is of other LiDARs or placements than the calibration.
    """
    subject = of_site(document, calibration)
    return _render(subject, notes, MAX_CLOUD_POINTS, document.name or "Site", EMPTY)


def _render(
    subject: Subject, notes: Sequence[str], max_points: int, heading: str, sheet: Html
) -> str:
    site, plan = subject.site, plan_of(subject.site)
    view = page_view(subject, plan, max_points)
    found = poles(subject)
    parts = [
        missing_poles(subject),
        site_map(subject, plan),
        viewer(subject, view),
        hypotheses(subject.pair),
        # What was found comes first where it is all there is.
        *([found] if site.status == "refused" else []),
        pairs(site),
        _checked("loops", listings.loops(site)),
        _checked("tests", listings.tests(site)),
        _checked("placements", listings.changes(subject)),
        poses(subject),
        *([] if site.status == "refused" else [found]),
        run(subject),
    ]
    return render_page(
        "calibration report",
        heading,
        f"{site.created} · {subject.size}",
        site.status,
        verdict(subject, notes),
        parts,
        title=site.name or "Site",
        view=view,
        sheet=sheet,
    )


def _checked(piece: str, listing: Listing) -> Html:
    """Show what was checked; nothing where nothing was."""
    return fill(piece, table=listed(listing)) if listing.rows else EMPTY


def render_page(
    brand: str,
    heading: str,
    created: str,
    status: str,
    verdict: Html,
    parts: Sequence[Html],
    *,
    title: str = "",
    view: PageView | None = None,
    sheet: Html = EMPTY,
) -> str:
    """Lay out a page: its head, the verdict, links to every part that there is, and the parts.

    Parameters
    ----------
    brand, heading, created
        What kind of page it is, what of, and when that was made.
    status, verdict
        Of what it is of.
    parts
        Sections under a heading each, empty where there is nothing to say.
    title
        Of the page in a browser; the heading where empty.
    view
        What the page's code draws.
    sheet
        A certificate, before all else on paper.
    """
    body = join(parts)
    links = join(fill("a", to=f"#{name}", text=Html(text)) for name, text in HEADING.findall(body))
    code = ("three.min.js", "page.js", "view.js", "app.js") if view else ("page.js", "app.js")
    places = {
        "title": fill("text", value=title or heading),
        "brand": fill("text", value=brand),
        "heading": fill("text", value=heading),
        "created": fill("text", value=created),
        "status": fill("text", value=status),
        "certificate": sheet,
        "certificate_button": fill("certificate-button") if sheet else "",
        "verdict": verdict,
        "links": links,
        "parts": body,
        "data": embed_json(view),
    }
    return fill_page("report.html", ("style.css",), code, places, share_styles())


def viewer(subject: Subject, view: PageView | None) -> Html:
    """Write the view of the clouds, with a button for each LiDAR and each of several placements."""
    if view is None:
        return EMPTY
    pair = subject.pair is not None
    lidars = join(
        fill(
            "lidar-button",
            k=k,
            key=_key("ts"[k] if pair else str(k + 1)),
            colour=colour_class(k),
            name=lidar.name.capitalize() if pair else lidar.name,
        )
        for k, lidar in enumerate(view.lidars)
    )
    places = join(
        fill("placement-button", j=j, key=_key(f"Shift+{j + 1}"), name=name)
        for j, name in enumerate(view.placements)
    )
    group = fill("placement-buttons", buttons=places) if len(view.placements) > 1 else ""
    modes = fill("modes") if pair else ""
    keys = fill("keys-of-pair" if pair else "keys-of-site")
    return fill("viewer", modes=modes, lidars=lidars, placements=group, keys=keys, shown=view.shown)


def _key(key: str) -> Html:
    """Name the key of a button; only nine of a kind have one."""
    return fill("key", key=key) if len(key.removeprefix("Shift+")) == 1 else EMPTY


def write_report(
    path: Path,
    result: ResultDoc,
    placements: Sequence[Placement],
    *,
    notes: Sequence[str] = (),
    max_points: int = MAX_CLOUD_POINTS,
    site: str = "",
    serials: Sequence[str] = ("", ""),
) -> None:
    """Write `render_report`'s page to a file, whole or not at all."""
    page = render_report(
        result, placements, notes=notes, max_points=max_points, site=site, serials=serials
    )
    write_atomically(path, page.encode("utf-8"))


def write_site_report(
    path: Path,
    document: SiteDoc,
    calibration: SiteCalibration | None = None,
    *,
    notes: Sequence[str] = (),
) -> None:
    """Write `render_site`'s page to a file, whole or not at all."""
    write_atomically(path, render_site(document, calibration, notes=notes).encode("utf-8"))
