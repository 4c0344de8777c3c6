"""The certificate: one sheet of paper that says what was calibrated, how well, and from what."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ..base.quantities import counted, error, percent
from ..result import BudgetEntry, ResultDoc
from .certainty import BUDGET_RANGE, error_parts, radius_words, scene_words
from .markup import MISSING, plus_minus, table
from .names import LIDARS
from .sections import VERDICTS, pose_parts, transform_matrix

LISTED_SOURCES = 8
"""So many sources of error are listed one by one, the largest first: the sheet stays one page."""

TO_FILL = '<span class="fill"></span>'
"""A line to write on, where nothing was given."""

STATES = tuple(
    f"{kind} {axis}" for kind in ("rotation about", "translation along") for axis in "xyz"
)
"""The six directions of the covariance, in its order."""


def certificate(result: ResultDoc, site: str = "", serials: Sequence[str] = ("", "")) -> str:
    """Write the certificate of an answer; a refused run has none.

    Parameters
    ----------
    result
        The result document.
    site
        Where it was calibrated; a line to fill in where empty.
    serials
        Serial numbers of the target and the source LiDAR; likewise.
    """
    if result.T_target_source is None:
        return ""
    T = np.array(result.T_target_source)
    return (
        '<section class="certificate" aria-labelledby="certificate">'
        '<h2 id="certificate">Calibration certificate</h2>'
        f"{_facts(result, site)}{_lidars(result, serials)}"
        f'<div class="columns">{transform_matrix(T)}{pose_parts(T)}</div>'
        "<p><code>T_target_source</code> maps points of the source into the frame of the target, "
        "metres.</p>"
        f'<div class="columns">{_ranges(result)}{_states(result)}</div>'
        f"{_budget(result)}{_inputs(result)}"
        '<p class="sign"><span>Place and date</span><span>Name</span><span>Signature</span></p>'
        "</section>"
    )


def _facts(result: ResultDoc, site: str) -> str:
    warned = ", ".join(reason.code for reason in result.reasons)
    title = VERDICTS.get(result.status, (result.status, ""))[0]
    facts = [
        ("Site", escape(site) or TO_FILL),
        ("Calibrated", f"{escape(result.created)}, by retropole {escape(result.version)}"),
        ("Verdict", f"<b>{escape(title + (f': {warned}' if warned else ''))}</b>"),
        ("Tolerance", _tolerance(result)),
    ]
    said = (("Poles", _poles(result)), ("Scene", scene_words(result)))
    facts += [(name, escape(words)) for name, words in said if words]
    rows = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in facts)
    return f'<dl class="facts">{rows}</dl>'


def _tolerance(result: ResultDoc) -> str:
    """Say how accurate it had to be, and whether it is; or leave room for it."""
    asked = result.fitness
    if asked is None:
        return f"{TO_FILL} cm up to {TO_FILL} m"
    return escape(asked.words[:1].upper() + asked.words[1:])


def _poles(result: ResultDoc) -> str:
    """Say how many poles were used, and of which radius."""
    placements = len(result.inputs) // 2
    pairs = (
        ""
        if result.chosen is None
        else counted(len(result.chosen.pairs), "pair of poles", "pairs of poles")
    )
    placed = counted(placements, "placement") if placements > 1 else ""
    radius = radius_words(result)
    words = (pairs, placed, "" if radius is None else f"radius {radius} (1 σ)")
    return ", ".join(each for each in words if each)


def _lidars(result: ResultDoc, serials: Sequence[str]) -> str:
    models = [item.sensor for item in result.inputs[:2]]
    rows = "".join(
        f'<tr><th scope="row">{lidar}</th>'
        f'<td class="text">{TO_FILL if model == "auto" else escape(model)}</td>'
        f'<td class="text">{escape(serial) or TO_FILL}</td></tr>'
        for lidar, model, serial in zip(LIDARS, models, serials, strict=False)
    )
    head = "".join(
        f'<th scope="col"{kind}>{name}</th>'
        for name, kind in (
            ("LiDAR", ""),
            ("sensor", ' class="text"'),
            ("serial number", ' class="text"'),
        )
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>{rows}</table></div>'


def _ranges(result: ResultDoc) -> str:
    caption = "Where a source point lands, 1 σ"
    parts = error_parts(result)
    if parts:
        rows = [
            (f"{each.range_m:g} m", plus_minus(each.together), *map(error, each[2:]))
            for each in parts
        ]
        return table(caption, ("at range", "1 σ", "random", "systematic"), rows)
    stated = [(f"{e.range_m:g} m", plus_minus(e.sigma_m)) for e in result.predicted_error or []]
    return table(caption, ("at range", "1 σ"), stated) if stated else ""


def _states(result: ResultDoc) -> str:
    if result.covariance is None:
        return ""
    sigma = np.sqrt(np.maximum(np.diag(np.array(result.covariance)), 0.0)).tolist()
    rows = [
        (name, error(s, "rad" if k < 3 else "m"))
        for k, (name, s) in enumerate(zip(STATES, sigma, strict=True))
    ]
    return table("The pose, target axes", ("state", "1 σ"), rows)


def _budget(result: ResultDoc) -> str:
    """List the largest sources of error, and what all others come to."""
    if not result.budget:
        return ""
    entries = sorted(result.budget, key=lambda entry: -entry.share_at_30m)
    rows = [_source(entry) for entry in entries[:LISTED_SOURCES]]
    rest = entries[LISTED_SOURCES:]
    if rest:
        together = percent(sum(entry.share_at_30m for entry in rest))
        rows.append((f"{len(rest)} smaller", MISSING, MISSING, together))
    header = ("source of error", "LiDAR", "1 σ", f"share at {BUDGET_RANGE:g} m")
    return table("Uncertainty budget", header, rows, (1,))


def _source(entry: BudgetEntry) -> tuple[str, str, str, str]:
    sigma, share = error(entry.sigma, entry.unit), percent(entry.share_at_30m)
    return entry.name, entry.sensor or MISSING, sigma, share


def _inputs(result: ResultDoc) -> str:
    several = len(result.inputs) > 2
    rows = [
        (f"{LIDARS[k % 2]} {k // 2 + 1}" if several else LIDARS[k % 2], item.path, item.sha256)
        for k, item in enumerate(result.inputs)
    ]
    listed = table("Recordings", ("input", "path", "SHA-256"), rows, (1, 2))
    return f'<div class="hash">{listed}</div>' if rows else ""
