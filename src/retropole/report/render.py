"""Put a result and its two clouds into one HTML file that needs no network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..datatypes import Array, Detection, Placement, PointCloud
from ..files import write_atomically
from . import evidence, sections
from .points import MAX_SHOWN_RANGE, pack_cloud

MAX_PAGE_POINTS = 100_000
"""Points of each cloud in the page, about 0.9 MB; of a single placement."""

MAX_PAGE_POINTS_TOGETHER = 600_000
"""Points of all clouds together where there are many placements: the page stays under 8 MB."""

SIDES = ("target", "source")


def render_report(
    result: Mapping[str, Any],
    target: PointCloud,
    source: PointCloud,
    detections: tuple[Detection | None, Detection | None] | None = None,
    *,
    more: Sequence[Placement] = (),
    notes: Sequence[str] = (),
    max_points: int = MAX_PAGE_POINTS,
) -> str:
    """Render a run as one HTML page.

    Parameters
    ----------
    result
        The result document (schema ``retropole/result/1``) as plain dicts and lists. What may be
        null there may be null here; lists may be empty.
    target, source
        The clouds of the run, each in its own frame; of several placements, those of the first.
    detections
        What was found in the target and in the source; brings the rejected clusters and the
        points on the poles into the page.
    more
        The further placements of a run that had several; the page lets its reader switch.
    notes
        What a reader has to know before all else, for example that an input is not the file that
        the run read.
    max_points
        At most this many points of each cloud are put into the page, which says how many it shows.

    Returns
    -------
    str
        The page. It holds its style, code and points, asks no other address for anything, and
        works from a file.
    """
    found = detections or (None, None)
    inputs = _input_names(result)
    names = [*inputs[:2], "target", "source"][:2] if len(inputs) < 2 else inputs[:2]
    every = [Placement(target, source, found), *more]
    budget = min(max_points, MAX_PAGE_POINTS_TOGETHER // (2 * len(every)))
    stands = [
        _placement(result if k == 0 else {}, placement, inputs[2 * k : 2 * k + 2], budget)
        for k, placement in enumerate(every)
    ]
    view = {
        "status": result.get("status"),
        "placements": stands,
        "poses": _poses(result),
        "ellipsoid": _ellipsoid(result),
    }
    several = f" (and {len(every) - 1} more)" if more else ""
    assets = files(__package__) / "assets"
    page = Template((assets / "template.html").read_text(encoding="utf-8"))
    parts = {
        "hypotheses": sections.hypotheses(result),
        "transform": sections.transform(result),
        "poles": evidence.poles(result, detections),
        "uncertainty": evidence.uncertainty(result),
        "placements": evidence.placements(result),
        "run": evidence.provenance(result),
    }
    return page.substitute(
        title=escape(f"{names[0]} ← {names[1]}{several}"),
        several=escape(several),
        status=escape(str(result.get("status"))),
        target_name=escape(names[0]),
        source_name=escape(names[1]),
        created=escape(str(result.get("created", ""))),
        verdict=sections.verdict(result, notes),
        links=_links(parts),
        shown=escape(stands[0]["shown"]),
        style=(assets / "style.css").read_text(encoding="utf-8"),
        data=embed_json(view),
        three=(assets / "three.min.js").read_text(encoding="utf-8"),
        view_js=(assets / "view.js").read_text(encoding="utf-8"),
        app_js=(assets / "app.js").read_text(encoding="utf-8"),
        **parts,
    )


def _input_names(result: Mapping[str, Any]) -> list[str]:
    """Name the inputs by their files, and by their topics where they are in bags."""
    config = result.get("config") or {}
    topics = [config.get(f"{side}_topic") for side in SIDES]
    return [
        " ".join([Path(str(item.get("path", ""))).name, str(topics[k % 2] or "")]).strip()
        for k, item in enumerate(result.get("inputs") or [])
    ]


def _links(parts: Mapping[str, str]) -> str:
    """Link to every part of the page that there is."""
    names = {"view-title": "Clouds", "run": "This run"}
    there = ["view-title", *(part for part, html in parts.items() if html)]
    return "".join(f'<a href="#{part}">{names.get(part, part.capitalize())}</a>' for part in there)


def write_report(
    path: Path,
    result: Mapping[str, Any],
    target: PointCloud,
    source: PointCloud,
    detections: tuple[Detection | None, Detection | None] | None = None,
    *,
    more: Sequence[Placement] = (),
    notes: Sequence[str] = (),
    max_points: int = MAX_PAGE_POINTS,
) -> None:
    """Write `render_report`'s page to a file, whole or not at all."""
    page = render_report(
        result, target, source, detections, more=more, notes=notes, max_points=max_points
    )
    write_atomically(path, page.encode("utf-8"))


def embed_json(value: object) -> str:
    """Write JSON that no content can lead out of its script element; not-a-number becomes null."""
    try:
        text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(value), allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _shown(which: str, cloud: Mapping[str, Any]) -> str:
    count, total = cloud["counts"][2], cloud["total"]
    text = f"{which}: showing {count:,} of {total:,} points"
    return text + (
        f", {cloud['far']:,} beyond {MAX_SHOWN_RANGE:g} m left out" if cloud["far"] else ""
    )


def _placement(
    result: Mapping[str, Any], placement: Placement, files: Sequence[str], max_points: int
) -> dict[str, Any]:
    """Pack what the view shows of one placement; the poles are the result's where it has them."""
    clouds = [
        pack_cloud(cloud, detection, max_points=max_points)
        for cloud, detection in zip(
            (placement.target, placement.source), placement.found, strict=True
        )
    ]
    shown = [_shown(which, cloud) for which, cloud in zip(SIDES, clouds, strict=True)]
    return {
        "files": " ← ".join(files),
        "shown": "; ".join(shown),
        "clouds": clouds,
        "poles": [
            _pole_lines(which, (result.get("poles") or {}).get(which), detection)
            for which, detection in zip(SIDES, placement.found, strict=True)
        ],
        "rejected": [
            [{"at": r.centre.tolist(), "label": str(k)} for k, r in enumerate(d.rejected)]
            if d
            else []
            for d in placement.found
        ],
    }


def _pole_lines(
    which: str, listed: Sequence[Mapping[str, Any]] | None, detection: Detection | None
) -> list[dict[str, Any]]:
    """Both ends of every pole of one LiDAR, in its frame."""
    if listed is None:
        listed = [
            {"point_m": p.point, "direction": p.direction, "length_m": p.length}
            for p in (detection.poles if detection else ())
        ]
    lines = []
    for k, pole in enumerate(listed):
        point = np.asarray(pole["point_m"], dtype=float)
        half = 0.5 * pole["length_m"] * np.asarray(pole["direction"], dtype=float)
        ends = {"a": (point - half).tolist(), "b": (point + half).tolist()}
        lines.append({**ends, "label": f"{which[0].upper()}{k}"})
    return lines


def _poses(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every pose the view can show: the result, the stage before it, and the hypotheses."""
    poses = []
    if result.get("T_target_source") is not None:
        poses.append({"id": "result", "label": "result", "T": result["T_target_source"]})
    for k, hypothesis in enumerate(result.get("hypotheses") or []):
        name = sections.letter(k)
        label = f"hypothesis {name}" + (" (chosen, poles only)" if hypothesis.get("chosen") else "")
        poses.append({"id": name, "label": label, "T": hypothesis["T_target_source"]})
    return poses


def _ellipsoid(result: Mapping[str, Any]) -> dict[str, Any] | None:
    """1 σ ellipsoid of the source origin in the target frame, enlarged until it can be seen."""
    if result.get("covariance") is None or result.get("T_target_source") is None:
        return None
    covariance: Array = np.asarray(result["covariance"], dtype=float)[3:, 3:]
    values, vectors = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(values, 0.0))
    if not sigma[-1] > 0:
        return None
    factor = 10.0 ** max(0, round(float(np.log10(0.7 / sigma[-1]))))
    centre = np.asarray(result["T_target_source"], dtype=float)[:3, 3]
    return {
        "centre": centre.tolist(),
        "axes": (vectors * sigma * factor).T.tolist(),
        "factor": factor,
        "sigma_m": sigma.tolist(),
    }
