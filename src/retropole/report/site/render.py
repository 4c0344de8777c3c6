"""Put the result of a site and its clouds into one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from ...base.files import write_atomically
from ...base.quantities import counted
from ...result.site import SiteDoc
from ...site.answer import SiteCalibration
from ..markup import share_styles
from ..page import fill_page
from ..view_data import embed_json
from .checks import loops, tests, without
from .map import site_map
from .pairs import pairs
from .plan import plan_of
from .poses import poses
from .recorded import found, run
from .svg import colour_class
from .verdict import verdict
from .view import SiteView, site_view

NAMES = {"view-title": "Clouds", "found": "What was found", "run": "This run"}
"""Of the links to the parts of the page, where they are not those of the parts."""


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
    plan = plan_of(document)
    view = None
    if calibration is not None:
        _check_same(document, calibration)
        view = site_view(document, calibration, plan)
    head = {"map": site_map(document, plan), "view": _viewer(view)}
    parts = {
        "pairs": pairs(document),
        "loops": loops(document),
        "tests": tests(document),
        "placements": without(document),
        "poses": poses(document),
    }
    # What was found comes first where it is all there is.
    recorded = {"found": found(document)}
    parts = recorded | parts if document.status == "refused" else parts | recorded
    parts["run"] = run(document)
    scripts = ("three.min.js", "page.js", "view.js", "site.js") if view else ("page.js", "site.js")
    count = counted(len(document.lidars), "LiDAR")
    return fill_page(
        "site.html",
        ("style.css", "site.css"),
        scripts,
        {
            "title": escape(document.name or "Site"),
            "status": escape(document.status),
            "created": escape(f"{document.created} · {count}, {_placements(document)}"),
            "verdict": verdict(document, notes),
            "links": _links(head | parts),
            "map": head["map"],
            "viewer": head["view"],
            "parts": "".join(parts.values()),
            "data": embed_json(view),
        },
        share_styles(),
    )


def write_site_report(
    path: Path,
    document: SiteDoc,
    calibration: SiteCalibration | None = None,
    *,
    notes: Sequence[str] = (),
) -> None:
    """Write `render_site`'s page to a file, whole or not at all."""
    write_atomically(path, render_site(document, calibration, notes=notes).encode("utf-8"))


def _check_same(document: SiteDoc, calibration: SiteCalibration) -> None:
    names = [lidar.name for lidar in calibration.site.lidars]
    if names != [lidar.name for lidar in document.lidars]:
        raise ValueError("the document is of other LiDARs than the calibration")
    if list(calibration.site.placements) != document.placements:
        raise ValueError("the document is of other placements than the calibration")


def _placements(document: SiteDoc) -> str:
    return counted(len(document.placements), "placement")


def _links(parts: Mapping[str, str]) -> str:
    """Link to every part of the page that there is."""
    named = {("view-title" if part == "view" else part): html for part, html in parts.items()}
    return "".join(
        f'<a href="#{part}">{NAMES.get(part, part.capitalize())}</a>'
        for part, html in named.items()
        if html
    )


def _viewer(view: SiteView | None) -> str:
    """Write the view of the clouds with a button for each LiDAR and each placement."""
    if view is None:
        return ""
    lidars = "".join(
        f'<button type="button" data-lidar="{k}" aria-pressed="true"{_key(k)}>'
        f'<i class="dot {colour_class(k)}" aria-hidden="true"></i>{escape(lidar.name)}</button>'
        for k, lidar in enumerate(view.lidars)
    )
    placements = "".join(
        f'<button type="button" data-place="{j}" aria-pressed="false"{_key(j, "Shift+")}>'
        f"{escape(name)}</button>"
        for j, name in enumerate(view.placements)
    )
    template = (files("retropole.report") / "assets" / "site-viewer.html").read_text("utf-8")
    return Template(template).substitute(
        lidars=lidars, placements=placements, shown=escape(view.shown)
    )


def _key(k: int, before: str = "") -> str:
    """Name the key of the k-th button; only nine have one."""
    return f' aria-keyshortcuts="{before}{k + 1}"' if k < 9 else ""
