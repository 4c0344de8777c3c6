"""The certificate: one sheet of paper that says what was calibrated, how well, and from what."""

from __future__ import annotations

import numpy as np

from ..base.quantities import UNKNOWN, counted, percent
from ..base.uncertainty import RANGES
from ..result import BudgetEntry, ResultDoc
from ..result.site import LidarDoc, SiteDoc
from . import listings
from .listings import checks_of_site, columns, fitness_words, radius_words, scene_words
from .page import EMPTY, Html, fill, join, listed, plus_minus, table
from .poses import covariances, pose_parts, ranges, sources, states, transform_matrix
from .subject import Subject
from .verdict import VERDICTS

LISTED_SOURCES = 8
"""So many sources of error are listed one by one, the largest first: the sheet stays one page."""


def certificate(subject: Subject, place: str = "") -> Html:
    """Write the certificate of a pair or of a site; a refusal has none, nor an unusable answer.

    Parameters
    ----------
    subject
        What the page is of, with the serial numbers of its LiDARs; a line to fill in where empty.
    place
        Where it was calibrated; likewise. Of a site, its name where empty.
    """
    site, pair = subject.site, subject.pair
    if not subject.answered or subject.chance_wrong is not None:
        return EMPTY
    several = len(site.placements) > 1
    recordings = [
        (site.lidars[each.lidar].name + f" {each.placement + 1}" * several, each.path, each.sha256)
        for each in site.inputs
    ]
    lidars = [
        (each.name, _given("" if each.sensor == "auto" else each.sensor), _given(each.serial))
        for each in site.lidars
    ]
    return fill(
        "certificate",
        facts=_facts(subject, place),
        lidars=table("LiDARs", columns("LiDAR; sensor; serial number"), lidars, (1, 2)),
        answer=_of_site(site) if pair is None else _of_pair(pair, site.lidars[1]),
        recordings=table("Recordings", ("input", "path", "SHA-256"), recordings, (1, 2)),
    )


def _of_pair(pair: ResultDoc, source: LidarDoc) -> Html:
    """Give the transform, how certain it is, and what its error is made of."""
    T = np.array(pair.T_target_source)
    return fill(
        "certificate-of-pair",
        matrix=transform_matrix(T),
        parts=pose_parts(T),
        ranges=listed(ranges(source, pair.uncertainty, "Where a source point lands, 1 σ")),
        states=listed(states(covariances(source, None), "The pose, target axes")),
        budget=_budget(pair.budget or []),
    )


def _of_site(site: SiteDoc) -> Html:
    """Give the pose of every LiDAR, and where a point of it lands by its range."""
    at = [f"{each:g} m" for each in RANGES]
    rows = [
        (lidar.name, *(plus_minus(each.sigma_m) for each in lidar.predicted_error))
        for lidar in site.lidars
        if lidar.predicted_error and len(lidar.predicted_error) == len(at)
    ]
    errors = (
        table("Where a point lands, 1 σ, by its range", ("LiDAR", *at), rows) if rows else EMPTY
    )
    return fill("certificate-of-site", poses=table(*listings.poses(site)), ranges=errors)


def _given(text: str) -> str:
    """Write what was given, or leave a line to write on."""
    return text or fill("to-fill")


def _facts(subject: Subject, place: str) -> Html:
    """Say where, when, how well and with what."""
    site, pair = subject.site, subject.pair
    warned = ", ".join(reason.code for reason in site.reasons)
    title = VERDICTS.get(site.status, ("", site.status))[1]
    asked = fitness_words(subject)
    facts = [
        ("Site", _given(place or ("" if pair else site.name))),
        ("Calibrated", f"{site.created}, by retropole {site.version}"),
        ("Verdict", fill("bold", text=title + (f": {warned}" if warned else ""))),
        ("Tolerance", f"{asked[:1].upper()}{asked[1:]}" if asked else fill("tolerance")),
    ]
    if pair is None:
        facts += [("Frame", site.datum), ("Checks", "; ".join(checks_of_site(site)))]
    else:
        facts += [("Poles", _poles(pair)), ("Scene", scene_words(pair) or "")]
    return join(fill("fact", name=name, value=value) for name, value in facts if value)


def _poles(pair: ResultDoc) -> str:
    """Say how many poles were used, and of which radius."""
    placements, radius = len(pair.inputs) // 2, radius_words(pair)
    pairs = 0 if pair.chosen is None else len(pair.chosen.pairs)
    words = (
        counted(pairs, "pair of poles", "pairs of poles") if pairs else "",
        counted(placements, "placement") if placements > 1 else "",
        "" if radius is None else f"radius {radius} (1 σ)",
    )
    return ", ".join(each for each in words if each)


def _budget(budget: list[BudgetEntry]) -> Html:
    """List the largest sources of error, and what all others come to."""
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    caption, header, rows, words = sources("Uncertainty budget", entries[:LISTED_SOURCES])
    rest = entries[LISTED_SOURCES:]
    if rest:
        together = percent(sum(entry.share_at_30m for entry in rest))
        rows = [*rows, [f"{len(rest)} smaller", *[UNKNOWN] * (len(header) - 2), together]]
    return table(caption, header, rows, words) if rows else EMPTY
