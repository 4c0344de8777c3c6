"""What the report answers: verdict, transform, hypotheses; from the result document to HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.reasons import explain
from ..export import FORMATS, export_lines
from ..result import HypothesisDoc, ReasonDoc, ResultDoc
from .certainty import largest_error, scene_words
from .hypotheses_text import deciding, pose_numbers, relative_words, standing
from .markup import inline, number, plus_minus, table
from .names import LIDARS, hypothesis_name, pair_name

FRAMES = ("lidar_target", "lidar_source")
"""Frame names in the lines to copy, until the reader types others into the page."""

UNFOLDED = ("ros2", "matrix", "quaternion")
"""Formats that are shown at once; the page unfolds the others."""

VERDICTS = {
    "ok": ("Calibrated", "The transform below maps source points into the target frame."),
    "warn": (
        "Calibrated, with a warning",
        "There is a transform, and a reason to look twice before you use it.",
    ),
    "refused": (
        "Refused: no transform",
        "The data do not support an answer that could be trusted, so none is given.",
    ),
}

SYMBOLS = {"ok": "✓", "warn": "!", "refused": "✕"}


def verdict(result: ResultDoc, notes: Sequence[str] = ()) -> str:
    """Say ok, warn or refused in plain words, and every reason with what to do.

    Parameters
    ----------
    result
        The result document.
    notes
        What a reader has to know of the page itself before all else.
    """
    status = result.status
    title, words = VERDICTS.get(status, (status, ""))
    paths = tuple(item.path for item in result.inputs)
    items = "".join(reason_item(reason, paths) for reason in result.reasons)
    kind = status if status in VERDICTS else "refused"
    alerts = "".join(f'<p class="alert" role="note">{escape(note)}</p>' for note in notes)
    return (
        f'{alerts}<section class="verdict {kind}" aria-labelledby="verdict">'
        f'<div class="mark" aria-hidden="true">{SYMBOLS.get(status, "?")}</div><div>'
        f'<h2 id="verdict">{escape(title)}</h2>{_fitness(result)}'
        f"<p>{escape(words + _certainty(result))}</p>"
        + (f'<ul class="reasons">{items}</ul>' if items else "")
        + f"{_next_steps(result)}</div>{_figures(result)}</section>"
    )


def _fitness(result: ResultDoc) -> str:
    """Answer whether the transform is as accurate as was asked for; nothing where nothing was."""
    if result.fitness is None:
        return ""
    words = result.fitness.words
    return f"<p><b>{escape(words[:1].upper() + words[1:])}.</b></p>"


def _next_steps(result: ResultDoc) -> str:
    """Say what to do with an answer; what to do about a refusal is said with its reasons."""
    if result.T_target_source is None:
        return ""
    first = "Settle the warning first, as written above. " if result.status == "warn" else ""
    steps = (
        f"{first}Look at the clouds below: walls and ground of both must coincide, far away too.",
        "Take the transform along: copy its lines below, or have them written: "
        "`retropole export . --to ros2`, typed where `result.json` lies.",
        "Print this page: a certificate of one page to sign comes first.",
        "Later, or after a jolt, record again: `retropole check . TARGET SOURCE` tells whether "
        "both LiDARs stand where they stood.",
    )
    items = "".join(f"<li>{inline(step)}</li>" for step in steps)
    return f'<div class="advice next"><b>What to do next</b><ol>{items}</ol></div>'


def reason_item(reason: ReasonDoc, paths: tuple[str, ...] = ()) -> str:
    """Show a reason: what happened here, what its code means, and what to do about it."""
    # A path keeps its small letter, also at the start.
    kind = "said" if reason.message.startswith(paths) else "said sentence"
    code, message = escape(reason.code), f'<p class="{kind}">{escape(reason.message)}</p>'
    known = explain(reason.code)
    if known is None:
        return f"<li><h3><code>{code}</code></h3>{message}</li>"
    actions = "".join(f"<li>{inline(action)}</li>" for action in known.advice)
    advice = f'<div class="advice"><b>What to do</b><ul>{actions}</ul></div>' if actions else ""
    return (
        f"<li><h3>{escape(known.title)} <code>{code}</code></h3>{message}"
        f'<p class="meaning">{inline(known.help)}</p>{advice}</li>'
    )


def _certainty(result: ResultDoc) -> str:
    """Say how far off a point may land and mostly by what, and what the scene says of the pose."""
    scene = scene_words(result)
    said = "" if scene is None else f" What stands in the scene: {scene}."
    if result.T_target_source is None:
        return said
    sentence = ""
    if result.predicted_error:
        far = max(result.predicted_error, key=lambda error: error.range_m)
        sentence = (
            f" A point {far.range_m:g} m away is expected to land within "
            f"{plus_minus(far.sigma_m)} (1 σ) of its true place."
        )
    largest = largest_error(result)
    if largest is not None:
        sentence += f" Largest source of error, {largest}."
    if result.weakest is not None:
        sentence += f" Least certain, at the poles, 1 σ: {result.weakest.words}."
    return sentence + said


def _figures(result: ResultDoc) -> str:
    """Show the predicted error at each range, and the margin, as tiles."""
    tiles = [
        (plus_minus(error.sigma_m), f"at {error.range_m:g} m, 1 σ")
        for error in result.predicted_error or []
    ]
    if result.margin is not None:
        tiles.append((number(result.margin, 3), "margin over the next"))
    cells = "".join(f"<div><dt>{escape(b)}</dt><dd>{escape(a)}</dd></div>" for a, b in tiles)
    return f'<dl class="tiles">{cells}</dl>' if tiles else ""


def transform(result: ResultDoc) -> str:
    """Show the pose as matrix, translation, quaternion and angles, and the lines to copy."""
    if result.T_target_source is None:
        return ""
    T = np.array(result.T_target_source)
    fields = "".join(
        f'<label>{lidar} frame <input name="{lidar}" value="{name}" data-frame="{name}" '
        'spellcheck="false" autocomplete="off"></label>'
        for lidar, name in zip(LIDARS, FRAMES, strict=True)
    )
    lines = export_lines(T, *FRAMES)
    first, more = (
        "".join(to_copy(key, text) for key, text in lines.items() if (key in UNFOLDED) is wanted)
        for wanted in (True, False)
    )
    if more:
        more = f"<details><summary>More formats</summary>{more}</details>"
    return (
        '<section aria-labelledby="transform"><h2 id="transform">Transform</h2>'
        "<p><code>T_target_source</code> maps points of the source LiDAR into the frame of the "
        "target LiDAR: <i>p</i><sub>target</sub> = <i>T</i> <i>p</i><sub>source</sub>. Roll, pitch "
        "and yaw are rotations about the fixed axes x, then y, then z.</p>"
        f'<div class="columns">{transform_matrix(T)}{pose_parts(T)}</div>'
        '<div class="to-copy"><h3>To copy</h3>'
        f'<div class="frames">{fields}</div>{first}{more}</div></section>'
    )


def transform_matrix(T: Array, name: str = "T_target_source") -> str:
    """Lay out a transform (4, 4) as a matrix under its name."""
    cells = "".join(
        "<tr>" + "".join(f"<td>{value:.6f}</td>" for value in row) + "</tr>" for row in T
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(name)}">'
        f'<table class="matrix"><caption>{escape(name)}</caption>{cells}</table></div>'
    )


def pose_parts(T: Array) -> str:
    """Write a transform (4, 4) as translation, quaternion and angles."""
    parts = (
        ("translation", "xyz", T[:3, 3], 4, " m"),
        ("quaternion", "xyzw", se3.quaternion_xyzw(T[:3, :3]), 6, ""),
        (
            "angles",
            ("roll", "pitch", "yaw"),
            np.degrees(se3.rpy_from_rotation(T[:3, :3])),
            3,
            "°",
        ),
    )
    named = "".join(
        f"<dt>{part}</dt><dd>"
        + "".join(
            # What is rounded to nothing is no negative zero.
            f"<span><b>{name}</b> {round(value, digits) + 0.0:.{digits}f}{unit}</span>"
            for name, value in zip(names, values.tolist(), strict=True)
        )
        + "</dd>"
        for part, names, values, digits, unit in parts
    )
    return f'<dl class="parts">{named}</dl>'


def to_copy(key: str, text: str, whose: str = "") -> str:
    """Show a transform in one format with a button that copies it, and say aloud whose it is."""
    title = escape(FORMATS[key].title)
    return (
        f'<figure class="copy"><figcaption>{title}<button type="button" class="copy-button" '
        f'aria-label="Copy: {title}{escape(whose)}">Copy</button>'
        f'</figcaption><pre tabindex="0" data-export="{escape(key)}">{escape(text.strip())}</pre>'
        "</figure>"
    )


def hypotheses(result: ResultDoc) -> str:
    """Show all hypotheses as panels (drawn by the page's code) and as a table."""
    if not result.hypotheses:
        return ""
    panels = "".join(_panel(k, each) for k, each in enumerate(result.hypotheses))
    rows = [
        (
            hypothesis_name(k) + (" · chosen" if each.chosen else ""),
            " ".join(map(pair_name, each.pairs)),
            "yes" if each.exact else "no",
            number(each.pole_rms_m, 1, 1000),
            number(each.icp_rotation_rad, 4),
            number(each.icp_translation_m, 4),
            number(each.overlap, 1, 100, " %"),
            number(each.free_space_violation, 1, 100, " %"),
            number(each.score, 3),
        )
        for k, each in enumerate(result.hypotheses)
    ]
    header = (
        "hypothesis",
        "pairs",
        "exact",
        "pole rms, mm",
        "e_r, rad",
        "e_t, m",
        "overlap",
        "free-space violation",
        "score",
    )
    return (
        '<section aria-labelledby="hypotheses"><h2 id="hypotheses">Hypotheses</h2>'
        "<p>The poles alone cannot say which pole is which, nor which end is up. Each way of "
        "laying them on each other is a hypothesis, and the scene decides. Press one to see it in "
        "the view above: under the right one, walls and ground of both clouds coincide.</p>"
        f"{_standing(result)}"
        f'<div class="panels">{panels}</div>{table("Hypotheses, best first", header, rows, (1,))}'
        '<p class="note">Exact: the lines themselves fit. e_r, e_t: rotation and translation by '
        "which ICP on the whole clouds moves away from the hypothesis. Overlap: share of the "
        "points with a neighbour in the other cloud. Free-space violation: share of the points "
        "that stand where the other LiDAR looked through. The largest score is chosen, unless by "
        "hand. T0, S1: "
        "pole 0 of the target, pole 1 of the source.</p></section>"
    )


def _standing(result: ResultDoc) -> str:
    """List the hypotheses between which a person may decide, and the options that would."""
    named = standing(result)
    if not named:
        return ""
    rows = [
        (
            name + (" · chosen" if each.chosen else ""),
            *pose_numbers(each),
            "" if each is result.hypotheses[0] else relative_words(result, each),
        )
        for name, each in named
    ]
    header = ("hypothesis", "roll, deg", "pitch, deg", "yaw, deg", "x, m", "y, m", "z, m")
    listed = table("Hypotheses that stand", (*header, "as against a"), rows, (7,))
    items = "".join(f"<li>{inline(words)}</li>" for words in deciding(result, named))
    options = f'<div class="advice"><b>What decides</b><ul>{items}</ul></div>' if items else ""
    return (
        "<p>The scene does not rule these out. Roll, pitch and yaw are those of the source in the "
        f"target's frame. Which is right, you may know from where the LiDARs are.</p>{listed}"
        f"{options}"
    )


def _panel(k: int, hypothesis: HypothesisDoc) -> str:
    name, chosen = hypothesis_name(k), hypothesis.chosen
    return (
        f'<button type="button" class="panel{" chosen" if chosen else ""}" data-pose="{name}" '
        'aria-pressed="false"><canvas width="10" height="10" aria-hidden="true"></canvas>'
        f"<span><b>{name}</b>{' · chosen' if chosen else ''}"
        f"<small>overlap {number(hypothesis.overlap, 0, 100, ' %')}</small>"
        f"<small>score {number(hypothesis.score, 3)}</small></span></button>"
    )
