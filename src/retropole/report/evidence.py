"""What the answer rests on: poles, residuals, covariance, inputs; from the result to HTML."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from .. import se3
from ..datatypes import Detection
from .crosssections import cross_sections
from .sections import Result, centimetres, number, table

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
    listed = table("Poles, each in its LiDAR's frame", header, rows)
    parts = [
        '<section aria-labelledby="poles"><h2 id="poles">Poles</h2>',
        "" if rows else "<p>No pole was found in either cloud.</p>",
        f'<div class="columns">{listed if rows else ""}{_residuals(result, detections)}</div>',
        _radius_note(result),
        cross_sections(result, detections),
    ]
    for which, mark, detection in zip(
        ("target", "source"), "×+", detections or (None, None), strict=True
    ):
        if detection is None or not detection.rejected:
            continue
        count = f"Rejected in the {which}: {len(detection.rejected)}"
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
        refused = table(f"Rejected clusters of the {which}", columns, clusters, (1, 2))
        parts.append(f"<details{opened}><summary>{count}</summary>{refused}</details>")
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
    header = ("pair", "angle, deg", "mean offset, mm", "rms, mm", "largest, mm")
    return table("Source pole from the target pole's line, with the transform", header, rows)


def _radius_note(result: Result) -> str:
    radius = (result.get("config") or {}).get("radius_m")
    if result.get("T_target_source") is None or not isinstance(radius, int | float):
        return ""
    return (
        '<p class="note">Returns lie on the side of the pole that faces their LiDAR: at a radius '
        f"of {1000 * radius:g} mm two LiDARs may see lines up to {1000 * radius * math.pi / 2:.0f} "
        "mm apart though the transform is exact.</p>"
    )


_STATE = {
    **{f"phi_{axis}": f"turn about {axis} (phi_{axis})" for axis in "xyz"},
    **{f"delta_{axis}": f"shift along {axis} (delta_{axis})" for axis in "xyz"},
}


def _option(value: object) -> str:
    """Write an option of the run as a person would."""
    if value is None:
        return "default"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return str(value)


def uncertainty(result: Result) -> str:
    """Show the covariance and what it means at each range."""
    if result.get("T_target_source") is None:
        return ""
    stages = (result.get("stages") or {}).items()
    rows = [(name, number(s.get("rms_m"), 1, 1000)) for name, s in stages if s is not None]
    tables = [table("Stages", ("stage", "rms residual, mm"), rows)] if rows else []
    matrix = "<p>This run gives no covariance.</p>"
    if result.get("covariance") is not None:
        covariance = np.asarray(result["covariance"], dtype=float)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
        order = [str(name) for name in result.get("covariance_order") or range(6)]
        turned = [number(s, 4, 180 / math.pi, " deg") for s in sigma[:3]]
        shifted = [number(s, 2, 100, " cm") for s in sigma[3:]]
        rows = [(_STATE.get(n, n), s) for n, s in zip(order, turned + shifted, strict=True)]
        tables.insert(0, table("1 σ of the pose", ("state", "1 σ"), rows))
        full = [(n, *(f"{v:.3e}" for v in row)) for n, row in zip(order, covariance, strict=True)]
        matrix = (
            f"<p>{escape(str(result.get('covariance_frame', '')))}</p>"
            "<details><summary>Covariance matrix</summary>"
            f"{table('Covariance, rad and m', ('', *order), full)}</details>"
        )
    ranges = [
        (f"{e['range_m']:g} m", centimetres(e.get("sigma_m")))
        for e in result.get("predicted_error") or []
    ]
    if ranges:
        tables.append(table("A source point in the target frame", ("at range", "1 σ"), ranges))
    weakest = result.get("weakest") or {}
    said = ""
    if weakest.get("words"):
        x, y, z = (number(v, 2) for v in weakest["direction"])
        said = (
            f"<p>Least sure, at the poles: {escape(str(weakest['words']))} (1 σ), along ({x}, {y}, "
            f"{z}) in the target frame. Ratio of the most to the least sure of the six directions "
            f"of the pose: {number(weakest.get('condition'), 1)}.</p>"
        )
    return (
        '<section aria-labelledby="uncertainty"><h2 id="uncertainty">Uncertainty</h2>'
        f'{said}<div class="columns">{"".join(tables)}</div>{matrix}</section>'
    )


def placements(result: Result) -> str:
    """Say of each of several placements how far the poles' pose lies from that without it."""
    listed = result.get("placements") or []
    if len(listed) < 2:
        return ""
    rows = [
        (
            f"placement {k}",
            f"{p.get('poles_target', '–')} + {p.get('poles_source', '–')}",
            number(p.get("left_out_rotation_rad"), 3, 180 / math.pi),
            number(p.get("left_out_translation_m"), 1, 1000),
        )
        for k, p in enumerate(listed, 1)
    ]
    header = ("placement", "poles, target + source", "turned, deg", "moved, mm")
    return (
        '<section aria-labelledby="placements"><h2 id="placements">Placements</h2>'
        f"<p>One pose was found for all {len(listed)} placements of the poles. Each was left out "
        "in turn: the figures say how far the poles' pose lies from the one without it. A "
        "placement that stands out from the others deserves a look; choose it above the view.</p>"
        + table("Pose without each placement", header, rows)
        + "</section>"
    )


def provenance(result: Result) -> str:
    """List inputs, options, version and times."""
    given = result.get("inputs") or []
    names = ["target", "source"]
    if len(given) > 2:
        names = [f"{name} {k}" for k in range(1, len(given) // 2 + 1) for name in names]
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
        for which, item in zip(names, given, strict=False)
    ]
    header = ("input", "path", "points", "dropped", "sensor", "threshold", "sha256")
    config = [
        (k, "default" if v is None else _option(v)) for k, v in (result.get("config") or {}).items()
    ]
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
