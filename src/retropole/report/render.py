"""Put a result and its clouds into one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from ..base.datatypes import Placement
from ..base.files import write_atomically
from ..result import ResultDoc
from . import evidence, sections
from .certificate import certificate
from .markup import share_styles
from .missing import missing_poles
from .names import LIDARS, input_names
from .page import fill_page
from .uncertainty import uncertainty
from .view_data import embed_json, page_view

MAX_PAGE_POINTS = 100_000
"""Points of each cloud in the page, about 0.9 MB; of a single placement."""

MAX_PAGE_POINTS_TOGETHER = 600_000
"""Points of all clouds together where there are many placements: the page stays under 8 MB."""

SCRIPTS = ("three.min.js", "page.js", "view.js", "app.js")

CERTIFICATE_BUTTON = '<button type="button" id="print-certificate">Print certificate</button>'


def render_report(
    result: ResultDoc,
    placements: Sequence[Placement],
    *,
    notes: Sequence[str] = (),
    max_points: int = MAX_PAGE_POINTS,
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
    names = input_names(result)
    target_name, source_name = names[:2] if len(names) >= 2 else LIDARS
    budget = min(max_points, MAX_PAGE_POINTS_TOGETHER // (2 * len(placements)))
    view = page_view(result, placements, names, budget)
    several = f" (and {len(placements) - 1} more)" if len(placements) > 1 else ""
    sheet = certificate(result, site, serials)
    lacking = missing_poles(result, placements)
    parts = {
        "missing": lacking,
        "hypotheses": sections.hypotheses(result),
        "transform": sections.transform(result),
        "poles": evidence.poles(result, placements[0]),
        "uncertainty": uncertainty(result),
        "placements": evidence.placements(result),
        "run": evidence.provenance(result),
    }
    parts |= {
        "title": escape(f"{target_name} ← {source_name}{several}"),
        "several": escape(several),
        "status": escape(result.status),
        "target_name": escape(target_name),
        "source_name": escape(source_name),
        "created": escape(result.created),
        "certificate": sheet,
        "certificate_button": CERTIFICATE_BUTTON if sheet else "",
        "verdict": sections.verdict(result, notes),
        "links": _links(parts),
        "shown": escape(view.placements[0].shown),
        "data": embed_json(view),
    }
    return fill_page("template.html", ("style.css",), SCRIPTS, parts, share_styles())


def write_report(
    path: Path,
    result: ResultDoc,
    placements: Sequence[Placement],
    *,
    notes: Sequence[str] = (),
    max_points: int = MAX_PAGE_POINTS,
    site: str = "",
    serials: Sequence[str] = ("", ""),
) -> None:
    """Write `render_report`'s page to a file, whole or not at all."""
    page = render_report(
        result, placements, notes=notes, max_points=max_points, site=site, serials=serials
    )
    write_atomically(path, page.encode("utf-8"))


def _links(parts: Mapping[str, str]) -> str:
    """Link to every part of the page that there is."""
    names = {"missing": "Missing poles", "view-title": "Clouds", "run": "This run"}
    there = [part for part, html in parts.items() if html]
    there.insert(1 if "missing" in there else 0, "view-title")
    return "".join(f'<a href="#{part}">{names.get(part, part.capitalize())}</a>' for part in there)
