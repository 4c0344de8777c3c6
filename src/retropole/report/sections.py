"""What the report answers: verdict, transform, hypotheses; from the result document to HTML."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..datatypes import Array
from ..export import FORMATS, export_lines
from .advice import ADVICE

Result = Mapping[str, Any]

FRAMES = "lidar_target", "lidar_source"
"""Frame names in the lines to copy, until the reader types others into the page."""

OPEN = ("ros2", "matrix", "quaternion")
"""The forms that are shown at once; the page unfolds the others."""

VERDICTS = {
    "ok": ("Calibrated", "The transform below maps source points into the target frame."),
    "warn": (
        "Calibrated, with a warning",
        "There is a transform, and a reason to look twice before you use it.",
    ),
    "refused": (
        "Refused: no transform",
        "The data carry no answer that could be trusted, so none is given.",
    ),
}


def number(value: Any, digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Write a number with fixed digits, or a dash where there is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    return f"{value * scale:.{digits}f}{unit}"


def centimetres(sigma_m: Any) -> str:
    """Write a length as ``± … cm`` with two figures that mean something, or a dash."""
    digits = 2 if isinstance(sigma_m, int | float) and abs(sigma_m) < 0.00995 else 1
    text = number(sigma_m, digits, 100)
    return text if text == "–" else f"± {text} cm"


def table(
    caption: str,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    text: Collection[int] = (),
) -> str:
    """Lay out a table that scrolls sideways on narrow screens; every cell is escaped.

    The columns in ``text`` are words, set from the left; all but the first are else numbers.
    """
    kind = ["" if k not in text else ' class="text"' for k in range(len(header))]
    head = "".join(
        f'<th scope="col"{c}>{escape(name)}</th>' for c, name in zip(kind, header, strict=True)
    )
    body = "".join(
        f'<tr><th scope="row">{escape(str(row[0]))}</th>'
        + "".join(
            f"<td{c}>{escape(str(cell))}</td>" for c, cell in zip(kind[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in rows
    )
    name = escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{name}"><table>'
        f"<caption>{name}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
        "</table></div>"
    )


def verdict(result: Result, notes: Sequence[str] = ()) -> str:
    """Say ok, warn or refused in plain words, and every reason with what to do.

    The notes are what a reader has to know of the page itself before all else.
    """
    status = str(result.get("status"))
    title, words = VERDICTS.get(status, (status, ""))
    mark = {"ok": "✓", "warn": "!", "refused": "✕"}.get(status, "?")
    items = [_reason(reason) for reason in result.get("reasons") or []]
    kind = status if status in VERDICTS else "refused"
    alerts = "".join(f'<p class="alert" role="note">{escape(note)}</p>' for note in notes)
    return (
        f'{alerts}<section class="verdict {kind}" aria-labelledby="verdict">'
        f'<div class="mark" aria-hidden="true">{mark}</div><div>'
        f'<h2 id="verdict">{escape(title)}</h2><p>{escape(words + _how_sure(result))}</p>'
        + (f'<ul class="reasons">{"".join(items)}</ul>' if items else "")
        + f"</div>{_figures(result)}</section>"
    )


def _reason(reason: Mapping[str, Any]) -> str:
    code, message = str(reason.get("code", "")), escape(str(reason.get("message", "")))
    known = ADVICE.get(code)
    if known is None:
        return f'<li><p><code>{escape(code)}</code></p><p class="said">{message}</p></li>'
    return (
        f"<li><h3>{escape(known.title)} <code>{escape(code)}</code></h3>"
        f'<p class="said">{message}</p>'
        f'<p class="advice"><b>What to do:</b> {escape(known.help)}</p></li>'
    )


def _how_sure(result: Result) -> str:
    """Say in a sentence how far off a point may land, and where the pose is least sure."""
    if result.get("T_target_source") is None:
        return ""
    sentence = ""
    errors = result.get("predicted_error") or []
    if errors:
        far = max(errors, key=lambda e: e["range_m"])
        sentence = (
            f" A point {far['range_m']:g} m away is expected to land within "
            f"{centimetres(far['sigma_m'])} (1 σ) of its true place."
        )
    weakest = result.get("weakest") or {}
    if weakest.get("words"):
        sentence += f" Least sure, at the poles, 1 σ: {weakest['words']}."
    return sentence


def _figures(result: Result) -> str:
    """Predicted error at each range, and the margin, as tiles."""
    tiles = [
        (centimetres(e.get("sigma_m")), f"at {e.get('range_m'):g} m, 1 σ")
        for e in result.get("predicted_error") or []
    ]
    if result.get("margin") is not None:
        tiles.append((number(result["margin"], 3), "margin over the next"))
    cells = "".join(f"<div><dt>{escape(b)}</dt><dd>{escape(a)}</dd></div>" for a, b in tiles)
    return f'<dl class="tiles">{cells}</dl>' if tiles else ""


def _named_pose(T: Array) -> tuple[Array, Array, Array]:
    rotation = Rotation.from_matrix(T[:3, :3])
    return T[:3, 3], np.asarray(rotation.as_quat()), np.degrees(rotation.as_euler("xyz"))


def transform(result: Result) -> str:
    """Show the pose as matrix, translation, quaternion and angles, and the lines to copy."""
    if result.get("T_target_source") is None:
        return ""
    T = np.asarray(result["T_target_source"], dtype=float)
    t, q, rpy = _named_pose(T)
    cells = "".join(
        "<tr>" + "".join(f"<td>{value:.6f}</td>" for value in row) + "</tr>" for row in T
    )
    parts = (
        ("translation", "xyz", t, ".4f", " m"),
        ("quaternion", "xyzw", q, ".6f", ""),
        ("angles", ("roll", "pitch", "yaw"), rpy, ".3f", "°"),
    )
    named = "".join(
        f"<dt>{part}</dt><dd>"
        + "".join(
            f"<span><b>{n}</b> {v:{form}}{unit}</span>" for n, v in zip(names, values, strict=True)
        )
        + "</dd>"
        for part, names, values, form, unit in parts
    )
    fields = "".join(
        f'<label>{which} frame <input name="{which}" value="{name}" data-frame="{name}" '
        'spellcheck="false" autocomplete="off"></label>'
        for which, name in zip(("target", "source"), FRAMES, strict=True)
    )
    lines = export_lines(T, *FRAMES)
    first, more = (
        "".join(_to_copy(key, text) for key, text in lines.items() if (key in OPEN) is wanted)
        for wanted in (True, False)
    )
    if more:
        more = f"<details><summary>More formats</summary>{more}</details>"
    return (
        '<section aria-labelledby="transform"><h2 id="transform">Transform</h2>'
        "<p><code>T_target_source</code> maps points of the source LiDAR into the frame of the "
        "target LiDAR: <i>p</i><sub>target</sub> = <i>T</i> <i>p</i><sub>source</sub>. Angles turn "
        "about the fixed axes x, then y, then z.</p>"
        f'<div class="columns"><div class="scroll" tabindex="0" role="region" aria-label="matrix">'
        f'<table class="matrix"><caption>T_target_source</caption>{cells}</table></div>'
        f'<dl class="parts">{named}</dl></div><h3>To copy</h3>'
        f'<div class="frames">{fields}</div>{first}{more}</section>'
    )


def _to_copy(key: str, text: str) -> str:
    title = escape(FORMATS[key].title)
    return (
        f'<figure class="copy"><figcaption>{title}'
        f'<button type="button" class="copy-button" aria-label="Copy: {title}">Copy</button>'
        f'</figcaption><pre tabindex="0" data-export="{escape(key)}">{escape(text.strip())}</pre>'
        "</figure>"
    )


def letter(k: int) -> str:
    """Name of a hypothesis: a, b, c, … as in the paper's Fig. 4."""
    return chr(ord("a") + k) if k < 26 else f"h{k}"


def _mark(hypothesis: Mapping[str, Any]) -> str:
    return " chosen" if hypothesis.get("chosen") else ""


def hypotheses(result: Result) -> str:
    """Show all hypotheses as panels (drawn by the page's code) and as a table."""
    found = result.get("hypotheses") or []
    if not found:
        return ""
    panels = "".join(
        f'<button type="button" class="panel{_mark(h)}" '
        f'data-pose="{letter(k)}" aria-pressed="false">'
        '<canvas width="10" height="10" aria-hidden="true"></canvas>'
        f"<span><b>{letter(k)}</b>{' · chosen' if h.get('chosen') else ''}"
        f"<small>overlap {number(h.get('overlap'), 0, 100, ' %')}</small>"
        f"<small>score {number(h.get('score'), 3)}</small>"
        "</span></button>"
        for k, h in enumerate(found)
    )
    rows = [
        (
            letter(k) + (" · chosen" if h.get("chosen") else ""),
            " ".join(f"T{i}–S{j}" for i, j in h.get("pairs") or []),
            {True: "yes", False: "no"}.get(h.get("exact", ""), "–"),
            number(h.get("pole_rms_m"), 1, 1000),
            number(h.get("icp_rotation_rad"), 4),
            number(h.get("icp_translation_m"), 4),
            number(h.get("overlap"), 1, 100, " %"),
            number(h.get("free_space"), 1, 100, " %"),
            number(h.get("score"), 3),
        )
        for k, h in enumerate(found)
    ]
    header = (
        "hypothesis",
        "pairs",
        "exact",
        "pole rms, mm",
        "e_r, rad",
        "e_t, m",
        "overlap",
        "against free space",
        "score",
    )
    return (
        '<section aria-labelledby="hypotheses"><h2 id="hypotheses">Hypotheses</h2>'
        "<p>The poles alone cannot say which pole is which, nor which end is up; each way of "
        "laying them on each other is a hypothesis, and the scene decides. Press one to see it in "
        "the view above. In the right one walls and ground of both clouds coincide.</p>"
        f'<div class="panels">{panels}</div>{table("Hypotheses, best first", header, rows, (1,))}'
        '<p class="note">Exact: the lines themselves fit. e_r, e_t: how far ICP on the whole '
        "clouds moves from here. Overlap: share of the points with a neighbour in the other cloud. "
        "Against free space: share of the points that lie where the other LiDAR looked through. "
        "The largest score is chosen. T0, S1: pole 0 of the target, pole 1 of the source.</p>"
        "</section>"
    )
