"""The certificate: one sheet of paper that says what was calibrated, how well, and from what."""

from __future__ import annotations

import numpy as np

from ..base.quantities import UNKNOWN, counted, percent
from ..result import BudgetEntry, ResultDoc
from .certainty import radius_words, scene_words
from .listings import columns
from .page import EMPTY, Html, fill, join, listed, table
from .poses import pose_parts, transform_matrix
from .subject import LIDARS, Subject
from .uncertainty import covariances, ranges, sources, states
from .verdict import VERDICTS

LISTED_SOURCES = 8
"""So many sources of error are listed one by one, the largest first: the sheet stays one page."""


def certificate(subject: Subject, place: str = "") -> Html:
    """Write the certificate of a pair; a refusal has none, nor an unusable answer, nor a site.

    Parameters
    ----------
    subject
        What the page is of, with the serial numbers of its LiDARs; a line to fill in where empty.
    place
        Where it was calibrated; likewise.
    """
    site, pair = subject.site, subject.pair
    if pair is None or pair.T_target_source is None or subject.chance_wrong is not None:
        return EMPTY
    T, source = np.array(pair.T_target_source), site.lidars[1]
    several = len(site.placements) > 1
    recordings = [
        (LIDARS[each.lidar] + f" {each.placement + 1}" * several, each.path, each.sha256)
        for each in site.inputs
    ]
    lidars = [
        (each.name, _given("" if each.sensor == "auto" else each.sensor), _given(each.serial))
        for each in site.lidars
    ]
    return fill(
        "certificate",
        facts=_facts(pair, place),
        lidars=table("LiDARs", columns("LiDAR; sensor; serial number"), lidars, (1, 2)),
        matrix=transform_matrix(T),
        parts=pose_parts(T),
        ranges=listed(ranges(source, pair.uncertainty, "Where a source point lands, 1 σ")),
        states=listed(states(covariances(source, None), "The pose, target axes")),
        budget=_budget(pair.budget or []),
        recordings=table("Recordings", ("input", "path", "SHA-256"), recordings, (1, 2)),
    )


def _given(text: str) -> str:
    """Write what was given, or leave a line to write on."""
    return text or fill("to-fill")


def _facts(pair: ResultDoc, place: str) -> Html:
    """Say where, when, how well and with what."""
    warned = ", ".join(reason.code for reason in pair.reasons)
    title = VERDICTS.get(pair.status, ("", pair.status))[1]
    asked = pair.fitness
    facts = (
        ("Site", _given(place)),
        ("Calibrated", f"{pair.created}, by retropole {pair.version}"),
        ("Verdict", fill("bold", text=title + (f": {warned}" if warned else ""))),
        (
            "Tolerance",
            f"{asked.words[:1].upper()}{asked.words[1:]}" if asked else fill("tolerance"),
        ),
        ("Poles", _poles(pair)),
        ("Scene", scene_words(pair)),
    )
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
