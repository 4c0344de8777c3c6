"""The report's text: pure functions from the result document to HTML, everything escaped."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import se3
from ..datatypes import Array, Detection

Result = Mapping[str, Any]
Detections = tuple[Detection | None, Detection | None]

FRAMES = "lidar_target", "lidar_source"
"""Frame names in the lines to copy, until the reader types others into the page."""

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

ADVICE = {
    "too_few_poles": "Find the poles in the view below. If one is among the rejected clusters, its "
    "reason says which limit it missed; if it is not marked at all, lower the threshold of that "
    "LiDAR, or stand the pole about 5 m away where its beams hit it.",
    "pole_count": "Compare the poles marked in both clouds; cover or remove other retro-reflective "
    "objects, or leave out --poles.",
    "no_match": "Check that the marked poles are the same objects in both clouds and that nothing "
    "moved between the two recordings.",
    "ambiguous": "Look at the hypotheses side by side: if a person cannot tell them apart either, "
    "the scene has to change, not a setting.",
    "no_overlap": "Look at both clouds: they must show the same place at the same time. Then check "
    "that the marked poles are the taped ones and not signs or posts.",
    "small_margin": "Choose hypothesis after hypothesis below: walls and ground must coincide in "
    "one only.",
    "parallel_poles": "Lean one pole by 15° or more against the other and record again.",
    "nearly_parallel_poles": "Lean one pole by 15° or more against the other and record again.",
    "degenerate_poles": "Lean one pole by 15° or more against the other and record again.",
    "few_points": "Stand the pole nearer, or record some seconds and give a folder of frames.",
    "too_few_points": "Record a place with walls, kerbs or parked cars around the poles.",
}


def number(value: Any, digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Write a number with fixed digits, or a dash where there is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    return f"{value * scale:.{digits}f}{unit}"


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a table that scrolls sideways on narrow screens; every cell is escaped."""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    body = "".join(
        f'<tr><th scope="row">{escape(str(row[0]))}</th>'
        + "".join(f"<td>{escape(str(cell))}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    name = escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{name}"><table>'
        f"<caption>{name}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
        "</table></div>"
    )


def verdict(result: Result) -> str:
    """Say ok, warn or refused in plain words, and every reason with what to do."""
    status = str(result.get("status"))
    title, words = VERDICTS.get(status, (status, ""))
    mark = {"ok": "✓", "warn": "!", "refused": "✕"}.get(status, "?")
    items = []
    for reason in result.get("reasons") or []:
        code = str(reason.get("code", ""))
        advice = reason.get("advice") or ADVICE.get(code)
        items.append(
            f"<li><code>{escape(code)}</code><p>{escape(str(reason.get('message', '')))}</p>"
            + (f'<p class="advice"><b>What to do:</b> {escape(str(advice))}</p>' if advice else "")
            + "</li>"
        )
    kind = status if status in VERDICTS else "refused"
    return (
        f'<section class="verdict {kind}" aria-labelledby="verdict">'
        f'<div class="mark" aria-hidden="true">{mark}</div><div>'
        f'<h2 id="verdict">{escape(title)}</h2><p>{escape(words)}</p>'
        + (f'<ul class="reasons">{"".join(items)}</ul>' if items else "")
        + f"</div>{_figures(result)}</section>"
    )


def _figures(result: Result) -> str:
    """Predicted error at each range, and the margin, as tiles."""
    tiles = [
        (f"± {number(e.get('sigma_m'), 1, 100)} cm", f"at {e.get('range_m'):g} m, 1 σ")
        for e in result.get("predicted_error") or []
    ]
    if result.get("margin") is not None:
        tiles.append((number(result["margin"], 3), "margin over the next hypothesis"))
    cells = "".join(f"<div><dd>{escape(a)}</dd><dt>{escape(b)}</dt></div>" for a, b in tiles)
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
    rows = [
        ("translation, m", *(f"{n} {v:.4f}" for n, v in zip("xyz", t, strict=True)), ""),
        ("quaternion", *(f"{n} {v:.6f}" for n, v in zip("xyzw", q, strict=True))),
        (
            "angles, deg",
            *(f"{n} {v:.3f}" for n, v in zip(("roll", "pitch", "yaw"), rpy, strict=True)),
            "",
        ),
    ]
    named = table("T_target_source in parts", ("part", "", "", "", ""), rows)
    fields = "".join(
        f'<label>{which} frame <input name="{which}" value="{name}" data-frame="{name}" '
        'spellcheck="false" autocomplete="off"></label>'
        for which, name in zip(("target", "source"), FRAMES, strict=True)
    )
    copies = "".join(
        f'<figure class="copy"><figcaption>{escape(name)}'
        f'<button type="button" class="copy-button" aria-label="Copy: {escape(name)}">Copy'
        f'</button></figcaption><pre tabindex="0" data-export="{key}">{escape(text)}</pre></figure>'
        for key, name, text in export_lines(T)
    )
    return (
        '<section aria-labelledby="transform"><h2 id="transform">Transform</h2>'
        "<p><code>T_target_source</code> maps points of the source LiDAR into the frame of the "
        "target LiDAR: <i>p</i><sub>target</sub> = <i>T</i> <i>p</i><sub>source</sub>. Angles turn "
        "about the fixed axes x, then y, then z.</p>"
        f'<div class="columns"><div class="scroll" tabindex="0" role="region" aria-label="matrix">'
        f'<table class="matrix"><caption>T_target_source</caption>{cells}</table></div>'
        f'{named}</div><h3>To copy</h3><div class="frames">{fields}</div>{copies}</section>'
    )


def export_lines(T: Array) -> list[tuple[str, str, str]]:
    """Lines ready to copy: key, title and text of each.

    The child frame of a ROS static transform is the source: its pose in the target frame is
    ``T_target_source``.
    """
    t, q, _ = _named_pose(T)
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = [f"{value:.9f}" for value in (*t, *q)]
    named = " ".join(f"--{name} {value}" for name, value in zip(names, values, strict=True))
    document = {
        "target_frame": FRAMES[0],
        "source_frame": FRAMES[1],
        "T_target_source": T.tolist(),
        "translation_m": dict(zip("xyz", t.tolist(), strict=True)),
        "quaternion": dict(zip("xyzw", q.tolist(), strict=True)),
    }
    return [
        (
            "ros2",
            "ROS 2",
            f"ros2 run tf2_ros static_transform_publisher {named} "
            f"--frame-id {FRAMES[0]} --child-frame-id {FRAMES[1]}",
        ),
        (
            "ros1",
            "ROS 1",
            f"rosrun tf2_ros static_transform_publisher {' '.join(values)} {FRAMES[0]} {FRAMES[1]}",
        ),
        ("matrix", "Matrix", "\n".join(" ".join(f"{v:.12g}" for v in row) for row in T)),
        ("json", "JSON", json.dumps(document)),
    ]


def letter(k: int) -> str:
    """Name of a hypothesis: a, b, c, … as in the paper's Fig. 4."""
    return chr(ord("a") + k) if k < 26 else f"h{k}"


def hypotheses(result: Result) -> str:
    """Show all hypotheses as panels (drawn by the page's code) and as a table."""
    found = result.get("hypotheses") or []
    if not found:
        return ""
    panels = "".join(
        f'<button type="button" class="panel" data-pose="{letter(k)}" aria-pressed="false">'
        '<canvas width="10" height="10" aria-hidden="true"></canvas>'
        f"<span><b>{letter(k)}</b>{' · chosen' if h.get('chosen') else ''}"
        f"<small>overlap {number(h.get('overlap'), 2)}, score {number(h.get('score'), 3)}</small>"
        "</span></button>"
        for k, h in enumerate(found)
    )
    rows = [
        (
            letter(k),
            "chosen" if h.get("chosen") else "",
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
        "",
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
        "<p>The poles alone cannot say which pole is which, nor which end is up; each way of laying "
        "them on each other is a hypothesis, and the scene decides. Press one to see it in the "
        "view above. In the right one walls and ground of both clouds coincide.</p>"
        f'<div class="panels">{panels}</div>{table("Hypotheses, best first", header, rows)}'
        '<p class="note">Exact: the lines themselves fit. e_r, e_t: how far ICP on the whole '
        "clouds moves from here. Overlap: share of the points with a neighbour in the other cloud. "
        "Against free space: share of the points that lie where the other LiDAR looked through. "
        "The largest score is chosen. T0, S1: pole 0 of the target, pole 1 of the source.</p>"
        "</section>"
    )


def poles(result: Result, detections: Detections | None) -> str:
    """List the poles, their residuals under the transform, and the rejected clusters."""
    found = result.get("poles") or {}
    rows = [
        (
            f"{which} {which[0].upper()}{k}",
            *(number(value, 3) for value in pole["point_m"]),
            number(pole.get("length_m"), 2),
            pole.get("points", "–"),
            number(pole.get("rms_m"), 1, 1000),
        )
        for which in ("target", "source")
        for k, pole in enumerate(found.get(which) or [])
    ]
    header = ("pole", "x, m", "y, m", "z, m", "length, m", "points", "rms about its line, mm")
    parts = ['<section aria-labelledby="poles"><h2 id="poles">Poles</h2>']
    parts.append(
        table("Poles, each in its LiDAR's frame", header, rows)
        if rows
        else "<p>No pole was found in either cloud.</p>"
    )
    parts.append(_residuals(result, detections))
    for which, detection in zip(("target", "source"), detections or (None, None), strict=True):
        if detection is None:
            continue
        rejected = [
            (f"{which[0]}{k}", *(number(v, 2) for v in r.centre.tolist()), len(r.index), r.code)
            + (r.reason,)
            for k, r in enumerate(detection.rejected)
        ]
        if rejected:
            clusters = table(
                f"Rejected clusters of the {which}",
                ("mark", "x, m", "y, m", "z, m", "points", "code", "reason"),
                rejected,
            )
            count = f"{len(rejected)} rejected cluster{'s' * (len(rejected) != 1)} of the {which}"
            opened = " open" if result.get("status") == "refused" or len(rejected) <= 4 else ""
            parts.append(f"<details{opened}><summary>{count}</summary>{clusters}</details>")
    return "".join([*parts, "</section>"])


def _residuals(result: Result, detections: Detections | None) -> str:
    """Distance of each source pole from its target pole's line, under the transform."""
    chosen = next((h for h in result.get("hypotheses") or [] if h.get("chosen")), None)
    if chosen is None or result.get("T_target_source") is None:
        return ""
    T = np.asarray(result["T_target_source"], dtype=float)
    rows = []
    for i, j in chosen.get("pairs") or []:
        a, b = result["poles"]["target"][i], result["poles"]["source"][j]
        n = np.asarray(a["direction"], dtype=float)
        full = detections is not None and detections[1] is not None
        points = detections[1].poles[j].xyz if full else np.array([b["point_m"]])  # type: ignore[index,union-attr]
        away = se3.apply(T, points) - np.asarray(a["point_m"])
        off = away - (away @ n)[:, None] * n
        distance = np.linalg.norm(off, axis=1)
        turned = T[:3, :3] @ np.asarray(b["direction"], dtype=float)
        rows.append(
            (
                f"T{i}–S{j}",
                number(
                    float(np.degrees(np.arcsin(min(1, np.linalg.norm(np.cross(turned, n)))))), 2
                ),
                number(float(np.linalg.norm(off.mean(axis=0))), 1, 1000),
                number(float(np.sqrt(np.mean(distance**2))), 1, 1000) if full else "–",
                number(float(distance.max()), 1, 1000) if full else "–",
            )
        )
    radius = (result.get("config") or {}).get("radius_m")
    note = (
        f'<p class="note">Returns lie on the side of the pole that faces their LiDAR: at a radius '
        f"of {1000 * radius:g} mm two LiDARs may see lines up to {1000 * radius * np.pi / 2:.0f} mm "
        "apart though the transform is exact.</p>"
        if isinstance(radius, int | float)
        else ""
    )
    header = ("pair", "angle, deg", "mean offset, mm", "rms, mm", "largest, mm")
    return table("Source pole from the target pole's line, with the transform", header, rows) + note


def uncertainty(result: Result) -> str:
    """Show the covariance and what it means at each range."""
    if result.get("T_target_source") is None:
        return ""
    parts = ['<section aria-labelledby="uncertainty"><h2 id="uncertainty">Uncertainty</h2>']
    if result.get("covariance") is None:
        parts.append("<p>This run gives no covariance.</p>")
    else:
        covariance = np.asarray(result["covariance"], dtype=float)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        order = [str(name) for name in result.get("covariance_order") or range(6)]
        rows = [
            (
                name,
                number(float(s), 4, 180 / math.pi, " deg")
                if k < 3
                else number(float(s), 2, 100, " cm"),
            )
            for k, (name, s) in enumerate(zip(order, sigma, strict=True))
        ]
        full = [(n, *(f"{v:.3e}" for v in row)) for n, row in zip(order, covariance, strict=True)]
        parts.append(f"<p>{escape(str(result.get('covariance_frame', '')))}</p>")
        parts.append('<div class="columns">' + table("1 σ of the pose", ("state", "1 σ"), rows))
        errors = [
            (f"{e.get('range_m'):g} m", f"± {number(e.get('sigma_m'), 2, 100)} cm")
            for e in result.get("predicted_error") or []
        ]
        if errors:
            parts.append(table("Predicted error of a point, 1 σ", ("range", "error"), errors))
        parts.append("</div><details><summary>Covariance matrix</summary>")
        parts.append(table("Covariance, rad and m", ("", *order), full) + "</details>")
    stages = result.get("stages") or {}
    rows = [
        (name, number(stage.get("rms_m"), 1, 1000))
        for name, stage in stages.items()
        if stage is not None
    ]
    if rows:
        parts.append(table("Stages", ("stage", "rms residual, mm"), rows))
    return "".join([*parts, "</section>"])


def provenance(result: Result) -> str:
    """List inputs, options, version and times."""
    inputs = [
        (
            which,
            item.get("path", "–"),
            f"{item.get('points', 0):,}",
            f"{item.get('dropped', 0):,}",
            item.get("sensor") or "–",
            "–" if item.get("threshold") is None else f"{item['threshold']:g}",
            item.get("sha256", "–"),
        )
        for which, item in zip(("target", "source"), result.get("inputs") or [], strict=False)
    ]
    header = ("input", "path", "points", "dropped", "sensor", "threshold", "sha256")
    config = [(k, "default" if v is None else v) for k, v in (result.get("config") or {}).items()]
    seconds = dict(result.get("seconds") or {})
    times = [(k, number(v, 3)) for k, v in seconds.items()]
    times.append(("sum", number(float(sum(seconds.values())), 3)))
    return (
        '<section aria-labelledby="run"><h2 id="run">This run</h2>'
        f"<p>retropole {escape(str(result.get('version', '?')))}, "
        f"{escape(str(result.get('created', 'time unknown')))}</p>"
        + table("Inputs", header, inputs)
        + '<div class="columns">'
        + table("Options", ("option", "value"), config)
        + table("Time", ("step", "seconds"), times)
        + "</div></section>"
    )
