"""The returns on every pole, looking along it: how well both LiDARs agree, in one picture."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from .. import se3
from ..datatypes import Array, Detection

HALF = 110.0
"""Half the side of a picture, in its own units."""

MAX_ITERATIONS = 50

RESIDUAL_SCALE = 0.01
"""Returns further than this from the surface, metres, count for less and less in its place."""


def cross_sections(
    result: Mapping[str, Any], detections: tuple[Detection | None, Detection | None] | None
) -> str:
    """Draw the returns of both LiDARs on each pair of poles in the plane across the pole."""
    target, source = detections or (None, None)
    chosen = next((h for h in result.get("hypotheses") or [] if h.get("chosen")), None)
    radius = (result.get("config") or {}).get("radius_m")
    if target is None or source is None or chosen is None or not isinstance(radius, int | float):
        return ""
    if result.get("T_target_source") is None:
        return ""
    T = np.asarray(result["T_target_source"], dtype=float)
    figures = [
        _figure(
            f"T{i}–S{j}",
            target.poles[i].xyz,
            se3.apply(T, source.poles[j].xyz),
            T[:3, 3],
            float(radius),
        )
        for i, j in chosen.get("pairs") or []
    ]
    return (
        '<h3>Returns, looking along each pole</h3><div class="sections">'
        + "".join(figures)
        + '</div><p class="note">Every return of both LiDARs with the transform, seen along the '
        "pole. The circle is a pole of the given radius where it fits all returns best; the "
        "strokes at the rim point to the LiDARs. Returns scatter towards and away from their own "
        "LiDAR; two clusters beside each other would be an error of the transform.</p>"
    )


def across(points: Array) -> tuple[Array, Array]:
    """Centre (3,) of points (N, 3) along a line, and two unit vectors (2, 3) across it."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    return centre, axes[1:]


def fit_circle(flat: Array, radius: float, start: Array) -> Array:
    """Centre (2,) of the circle of a given radius that runs nearest to points (N, 2).

    Gauss–Newton with weights; scipy's optimisers would take a tenth of a second to import.
    """
    centre = start
    for _ in range(MAX_ITERATIONS):
        away = flat - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        outward, residual = away / distance[:, None], distance - radius
        weighted = outward / np.sqrt(1.0 + (residual / RESIDUAL_SCALE) ** 2)[:, None]
        H = weighted.T @ outward
        step = np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(2), weighted.T @ residual)
        step *= min(1.0, radius / max(float(np.linalg.norm(step)), 1e-12))
        centre = centre + step
        if np.linalg.norm(step) < 1e-6:
            break
    return np.asarray(centre)


def _figure(name: str, target: Array, source: Array, origin: Array, radius: float) -> str:
    """Draw one pair: points (N, 3) and (M, 3), the source's origin (3,), in the target frame."""
    centre, axes = across(np.concatenate([target, source]))
    flat = [(points - centre) @ axes.T for points in (target, source)]
    # Returns lie in front of the axis: it is to be found on the far side of them.
    sensors = [-(axes @ centre), axes @ (origin - centre)]
    towards = [s / max(float(np.linalg.norm(s)), 1e-9) for s in sensors]
    start = -np.mean(towards, axis=0) * radius * np.pi / 4
    middle = fit_circle(np.concatenate(flat), radius, start)
    away = np.concatenate(flat) - middle
    rms = float(np.sqrt(np.mean((np.linalg.norm(away, axis=1) - radius) ** 2)))
    reach = float(max(3 * radius, np.quantile(np.linalg.norm(away, axis=1), 0.98)))
    scale = (HALF - 14) / reach
    dots = "".join(
        f'<circle class="{which}" cx="{x:.1f}" cy="{y:.1f}" r="1.9"/>'
        for which, points in zip(("target", "source"), flat, strict=True)
        for x, y in ((points - middle) * scale * [1, -1])
        if max(abs(x), abs(y)) < HALF
    )
    rim = "".join(
        f'<line class="{which}" x1="{x * (HALF - 12):.1f}" y1="{-y * (HALF - 12):.1f}" '
        f'x2="{x * (HALF - 2):.1f}" y2="{-y * (HALF - 2):.1f}"/>'
        for which, (x, y) in zip(("target", "source"), towards, strict=True)
    )
    bar = 10.0 ** np.floor(np.log10(reach))
    said = f"{name}: {1000 * rms:.1f} mm rms from the surface"
    return (
        f'<figure><svg viewBox="{-HALF:g} {-HALF:g} {2 * HALF:g} {2 * HALF:g}" role="img" '
        f'aria-label="{escape(said)}">{dots}<circle class="pole" r="{radius * scale:.1f}"/>{rim}'
        f'<path class="bar" d="M{8 - HALF:g} {HALF - 8:g}h{bar * scale:.1f}"/>'
        f'<text x="{8 - HALF:g}" y="{HALF - 13:g}">{100 * bar:g} cm</text></svg>'
        f"<figcaption><b>{escape(name)}</b> {1000 * rms:.1f} mm rms from the surface, "
        f"{len(target)} + {len(source)} returns</figcaption></figure>"
    )
