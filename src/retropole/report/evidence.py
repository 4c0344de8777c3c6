"""What the answer rests on: poles, residuals, covariance, inputs; from the result to HTML."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from .. import se3
from ..datatypes import Detection
from .sections import Result, number, table

Detections = tuple[Detection | None, Detection | None]


def poles(result: Result, detections: Detections | None) -> str:
    """List the poles, their residuals under the transform, and the rejected clusters."""
    found = result.get("poles") or {}
    rows = [
        (
            f"{which} {which[0].upper()}{k}",
            *(number(value, 3) for value in pole["point_m"]),
            number(pole.get("length_m"), 2),
            pole.get("points", "–"),
            pole.get("rings", "–"),
            number(pole.get("rms_m"), 1, 1000),
        )
        for which in ("target", "source")
        for k, pole in enumerate(found.get(which) or [])
    ]
    header = ("pole", "x, m", "y, m", "z, m", "length, m", "points", "rings", "rms, mm")
    parts = ['<section aria-labelledby="poles"><h2 id="poles">Poles</h2>']
    parts.append(
        table("Poles, each in its LiDAR's frame", header, rows)
        if rows
        else "<p>No pole was found in either cloud.</p>"
    )
    parts.append(_residuals(result, detections))
    for which, mark, detection in zip(
        ("target", "source"), "×+", detections or (None, None), strict=True
    ):
        if detection is None or not detection.rejected:
            continue
        count = f"{len(detection.rejected)} rejected of the {which}"
        clusters = [
            (
                f"{mark} {k}",
                r.code,
                r.reason,
                len(r.index),
                *(number(v, 2) for v in r.centre.tolist()),
            )
            for k, r in enumerate(detection.rejected)
        ]
        opened = " open" if result.get("status") == "refused" or len(clusters) <= 4 else ""
        columns = ("mark", "code", "reason", "points", "x, m", "y, m", "z, m")
        listed = table(f"Rejected clusters of the {which}", columns, clusters, (1, 2))
        parts.append(f"<details{opened}><summary>{count}</summary>{listed}</details>")
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
        seen = detections[1] if detections else None
        points = seen.poles[j].xyz if seen else np.array([b["point_m"]], dtype=float)
        away = se3.apply(T, points) - np.asarray(a["point_m"], dtype=float)
        off = away - (away @ n)[:, None] * n
        distance = np.linalg.norm(off, axis=1)
        sine = np.linalg.norm(np.cross(T[:3, :3] @ np.asarray(b["direction"], dtype=float), n))
        rows.append(
            (
                f"T{i}–S{j}",
                number(math.degrees(math.asin(min(1.0, float(sine)))), 2),
                number(float(np.linalg.norm(off.mean(axis=0))), 1, 1000),
                number(float(np.sqrt(np.mean(distance**2))), 1, 1000) if seen else "–",
                number(float(distance.max()), 1, 1000) if seen else "–",
            )
        )
    radius = (result.get("config") or {}).get("radius_m")
    note = ""
    if isinstance(radius, int | float):
        apart = 1000 * radius * math.pi / 2
        note = (
            '<p class="note">Returns lie on the side of the pole that faces their LiDAR: at a '
            f"radius of {1000 * radius:g} mm two LiDARs may see lines up to {apart:.0f} mm apart "
            "though the transform is exact.</p>"
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
        parts.append(table("1 σ of the pose", ("state", "1 σ"), rows))
        parts.append("<details><summary>Covariance matrix</summary>")
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
        + table("Inputs", header, inputs, (1, 4, 6))
        + '<div class="columns">'
        + table("Options", ("option", "value"), config, (1,))
        + table("Time", ("step", "seconds"), times)
        + "</div></section>"
    )
