"""Write a result and its clouds to one HTML file that needs no network: of a pair, or of a site."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from ..base.datatypes import Scan
from ..base.quantities import counted
from ..result import ResultDoc
from ..result.site import LIDARS, SiteDoc, found_document, input_names
from . import listings
from .curves import curve_sentence, error_curve, sways
from .hypotheses import hypotheses
from .listings import (
    POLE_COLUMNS,
    REJECTED_COLUMNS,
    Listing,
    columns,
    pole_row,
    rejected_mark,
    rejected_row,
)
from .map import pairs, site_map
from .page import EMPTY, Html, fill, fill_page, folded, join, listed, share_styles
from .plan import plan_of
from .poses import certainty, certificate, poses, transform
from .recorded import missing_poles, poles, run
from .subject import Recorded, as_subject, colour_class
from .surface_distances import distances_of_surfaces
from .verdict import next_steps, verdict
from .view import MAX_CLOUD_POINTS, PageView, embed_json, page_view, recordings_view
from .walk import walk

HEADING = re.compile(r'<h2 id="([\w-]+)">(.*?)</h2>')
"""Of a part of the page: its id, and its title."""


def render_report(
    document: ResultDoc | SiteDoc,
    recorded: Recorded = (),
    *,
    notes: Sequence[str] = (),
    max_points: int = MAX_CLOUD_POINTS,
    site: str = "",
    serials: Mapping[str, str] | None = None,
) -> str:
    """Render a run as one HTML page.

    Parameters
    ----------
    document
        The result document, of a pair or of a site.
    recorded
        What was recorded and found, each cloud in the frame of its LiDAR: of a pair in each
        placement of the poles, of a site by each LiDAR, None if it is not shown. The first
        placement of a pair is the one whose poles the result lists; of several, the page lets its
        reader choose. A detection brings the rejected clusters and the points on the poles into the
        page; leave it out where its poles are not those of the result. Without any, the page of a
        site has no view of clouds.
    notes
        What a reader has to know before all else, for example that an input is not the file that
        the run read.
    max_points
        At most this many points of each cloud are put into the page, which states how many it
        shows.
    site, serials
        Where it was calibrated, and serial numbers by the names of LiDARs, those of a pair
        ``target`` and ``source``, for the certificate; without, those of the document, or a line
        to fill in.

    Returns
    -------
    str
        The page. It contains its style, code and points, loads nothing from any other address, and
        works from a file.

    Raises
    ------
    ValueError
        Of a pair, without a placement; of a site, where there are not as many LiDARs and placements
        of scans as of the document.
    UsageError
        If a serial number is given of a LiDAR that is none of the site.
    """
    if isinstance(document, ResultDoc) and not recorded:
        raise ValueError("a report shows at least one placement of the poles")
    subject = as_subject(document, recorded, serials)
    answer, plan = subject.site, plan_of(subject.site)
    view = page_view(subject, plan, max_points)
    # Of a carried pole nothing is listed as stationary.
    carried = answer.config.carried
    found = EMPTY if carried else poles(subject)
    refused, heading = answer.status == "refused", answer.name or "Site"
    if subject.pair is not None:
        named = input_names(subject.pair)
        target, source = named[:2] if len(named) > 1 else LIDARS
        heading = fill("pair-heading", target=target, source=source)
    curve = error_curve(subject)
    parts = [
        EMPTY if carried else missing_poles(subject),
        transform(subject, curve),
        poses(subject, curve),
        site_map(subject, plan),
        viewer(view),
        next_steps(subject),
        walk(subject),
        hypotheses(subject.pair),
        certainty(subject),
        distances_of_surfaces(subject),
        sways(subject),
        # What was found comes first where it is all there is.
        found if refused else EMPTY,
        pairs(answer),
        _checked("loops", listings.loops(answer)),
        _checked("tests", listings.tests(answer)),
        _checked("placements", listings.changes(subject)),
        EMPTY if refused else found,
        run(subject),
    ]
    return render_page(
        "calibration report",
        heading,
        f"{answer.created} · {subject.size}",
        answer.status,
        verdict(subject, notes, curve_sentence(curve)),
        parts,
        title=answer.name or "Site",
        view=view,
        sheet=certificate(subject, site),
    )


def render_recordings(
    names: Sequence[str], scans: Sequence[Scan], texts: Sequence[str] = ()
) -> str:
    """Render recordings as one HTML page: each cloud, and the points from a threshold up.

    Parameters
    ----------
    names
        What each recording is called.
    scans
        What was recorded, and what was found or why nothing could be; without either it was not
        searched for poles.
    texts
        The text of each, line by line.

    Returns
    -------
    str
        The page, as of `render_report`.
    """
    view = recordings_view(names, scans)
    sections = [
        fill("recording", k=k, name=name, body=join(_recorded(k, name, scan, text)))
        for k, (name, scan, text) in enumerate(
            zip(names, scans, texts or [""] * len(names), strict=True)
        )
    ]
    heading = names[0] if len(names) == 1 else f"{len(names)} recordings"
    parts = [viewer(view), *sections]
    return render_page("recordings", heading, "", "", EMPTY, parts, view=view)


def _recorded(k: int, name: str, scan: Scan, text: str) -> Iterator[Html]:
    """Describe what was found in a recording."""
    detection, found = scan.detection, found_document(scan)
    if scan.refusal is not None:
        yield fill("alert", value=f"{scan.refusal.code}: {scan.refusal.message}.")
    if detection is not None and found is not None:
        bright = counted(detection.retro_points, "retro-reflective point")
        where = f"{detection.threshold:g} up ({detection.threshold_source})"
        yield fill("p", text=f"{counted(len(found.poles), 'pole')} in {bright} from {where}.")
        rows = [pole_row(f"pole {i}", pole) for i, pole in enumerate(found.poles)]
        yield listed(Listing(f"Poles in {name}", columns(POLE_COLUMNS), rows))
        rows = [rejected_row(rejected_mark(k, i), each) for i, each in enumerate(found.rejected)]
        yield listed(
            Listing(f"Rejected clusters in {name}", columns(REJECTED_COLUMNS), rows, (1, 2))
        )
    if text:
        yield fill("text-block", name=name, text=text)


def _checked(piece: str, listing: Listing) -> Html:
    """Show what was checked, a table for surveyors, folded; nothing if nothing was."""
    rows = folded(f"{listing.caption}: {len(listing.rows)}", listed(listing))
    return fill(piece, table=rows) if listing.rows else EMPTY


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
    """Arrange a page: its head, the verdict, links to every part that there is, and the parts.

    Parameters
    ----------
    brand, heading, created
        What kind of page it is, what of, and when that was made.
    status, verdict
        Of what it is of.
    parts
        Sections under a heading each, empty if there is nothing to say.
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
    places: dict[str, object] = {
        "title": title or heading,
        **{"brand": brand, "heading": heading, "created": created, "status": status},
        "certificate": sheet,
        "certificate_button": fill("certificate-button") if sheet else EMPTY,
        **{"verdict": verdict, "links": links, "parts": body, "data": embed_json(view)},
    }
    escaped = {name: fill("text", value=value) for name, value in places.items()}
    return fill_page("report.html", ("style.css",), code, escaped, share_styles())


def viewer(view: PageView | None) -> Html:
    """Write the view of the clouds, with a button for each LiDAR and each of several placements."""
    if view is None:
        return EMPTY
    pair, recordings = view.kind == "pair", view.kind == "recordings"
    title = "Recordings" if recordings else "LiDARs"
    keys_of = view.kind if pair or recordings else "site"
    lidars, keys = EMPTY, list("ts" if pair else "123456789") + [""] * len(view.lidars)
    for k, lidar in enumerate(view.lidars):
        key = fill("key", key=keys[k]) if keys[k] else EMPTY
        name = lidar.name.capitalize() if pair else lidar.name
        button = fill("lidar-button", k=k, key=key, colour=colour_class(lidar.colour), name=name)
        lidars = join((lidars, button))
    places = [
        fill("placement-button", j=j, key=fill("key", key=f"Shift+{j + 1}"), name=name)
        for j, name in enumerate(view.placements)
    ]
    return fill(
        "viewer",
        modes=fill("modes") if pair else EMPTY,
        threshold=fill("threshold") if recordings else EMPTY,
        picked=fill("picked") if recordings else EMPTY,
        lidars=EMPTY
        if recordings and len(view.lidars) == 1
        else fill("lidar-buttons", title=title, buttons=lidars),
        placements=fill("placement-buttons", buttons=join(places)) if places[1:] else EMPTY,
        keys=fill(f"keys-of-{keys_of}"),
        shown=view.shown,
    )
