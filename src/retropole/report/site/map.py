"""The site seen from above: LiDARs with how certain they stand there, poles, control points."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ...base.datatypes import Array
from ...base.quantities import error, large, round_below
from ...result.site import SiteDoc
from ..markup import MISSING, number, table
from .names import pole_labels
from .plan import Plan
from .svg import FONT, Labels, colour_class, short

WIDTH = 520.0
"""Of the picture, in its own units."""

HEIGHTS = 260.0, 560.0
"""Least and greatest height of the picture."""

MARGIN = 60.0
"""Around all that stands there: room for names."""

LEAST_SPAN = 2.0
"""A site is drawn as at least so wide, metres."""

SEEN_ELLIPSE = 34.0
"""The largest half axis is at most so long in the picture."""

CORNERS = 33
"""Points of an ellipse."""


def site_map(document: SiteDoc, plan: Plan) -> str:
    """Draw the site from above and list where its LiDARs stand; nothing of a refused one."""
    if document.status == "refused":
        return ""
    return (
        '<section aria-labelledby="map"><h2 id="map">Map</h2><div class="columns">'
        f"{_figure(document, plan)}{_places(document)}</div>{_poles(document)}</section>"
    )


def _figure(document: SiteDoc, plan: Plan) -> str:
    R = plan.R_plan_site
    lidars = np.array([np.array(each.T_site_lidar)[:3, 3] for each in document.lidars]) @ R.T
    ends = (
        np.array(
            [[p.point + s * p.length * p.direction for s in (-0.5, 0.5)] for p in document.poles]
        ).reshape(-1, 2, 3)
        @ R.T
    )
    points = np.array([each.at for each in document.control_points]).reshape(-1, 3) @ R.T
    scale, height, to_picture = _fit(np.concatenate([lidars, *ends, points])[:, :2])
    labels = Labels(WIDTH, height)
    for x, y in [*to_picture(lidars), *to_picture(points), *to_picture(ends.mean(axis=1))]:
        labels.keep_free(x, y, 6.0)
    # The corners of the scale bar and of north.
    labels.keep_free(40.0, height - 10.0, 40.0)
    labels.keep_free(WIDTH - 35.0, 30.0, 35.0)
    factor, ellipses = _ellipses(document, R, to_picture(lidars), scale)
    bar = round_below(0.3 * (WIDTH - 2 * MARGIN) / scale)
    marks = [
        *ellipses,
        *_pole_marks(pole_labels(document), to_picture, ends, labels),
        *_point_marks([each.name for each in document.control_points], to_picture(points), labels),
        *_lidar_marks([each.name for each in document.lidars], to_picture(lidars), labels),
        _scale_bar(bar, scale, height),
        _direction(plan),
    ]
    said = _caption(document, plan, factor)
    return (
        '<figure class="picture map">'
        f'<svg viewBox="0 0 {WIDTH:g} {height:.0f}" role="img" aria-labelledby="map-said">'
        f'{"".join(marks)}</svg><figcaption id="map-said">{escape(said)}</figcaption></figure>'
    )


class _ToPicture:
    """From the plan, metres, to the picture: y points up in the one and down in the other."""

    def __init__(self, middle: Array, scale: float, height: float) -> None:
        self.middle, self.scale, self.height = middle, scale, height

    def __call__(self, points: Array) -> list[tuple[float, float]]:
        away = (np.asarray(points)[:, :2] - self.middle) * self.scale
        return [(WIDTH / 2 + float(x), self.height / 2 - float(y)) for x, y in away]


def _fit(points: Array) -> tuple[float, float, _ToPicture]:
    """Choose units per metre and the height of the picture so that all points are in it."""
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, LEAST_SPAN)
    scale = float(min((WIDTH - 2 * MARGIN) / span[0], (HEIGHTS[1] - 2 * MARGIN) / span[1]))
    height = float(np.clip(scale * span[1] + 2 * MARGIN, *HEIGHTS))
    return scale, height, _ToPicture((low + high) / 2, scale, height)


def _ellipses(
    document: SiteDoc, R: Array, places: Sequence[tuple[float, float]], scale: float
) -> tuple[float | None, list[str]]:
    """Draw 1 σ of where each LiDAR stands, enlarged, and say how many times."""
    horizontal = [(R @ np.array(each.covariance)[3:, 3:] @ R.T)[:2, :2] for each in document.lidars]
    half_axes = []
    for covariance in horizontal:
        values, vectors = np.linalg.eigh(covariance)
        half_axes.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    largest = max(float(np.linalg.norm(each, axis=0).max()) for each in half_axes)
    if largest <= 0:
        return None, []
    factor = round_below(SEEN_ELLIPSE / (scale * largest))
    angle = np.linspace(0, 2 * np.pi, CORNERS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    paths = []
    for k, (axes, (x, y)) in enumerate(zip(half_axes, places, strict=True)):
        if not axes.any():
            continue
        corners = factor * scale * (axes @ circle)
        line = " ".join(f"{x + a:.1f},{y - b:.1f}" for a, b in corners.T)
        paths.append(f'<polygon class="ellipse {colour_class(k)}" points="{line}"/>')
    return factor, paths


def _lidar_marks(
    names: Sequence[str], places: Sequence[tuple[float, float]], labels: Labels
) -> list[str]:
    return [
        f'<circle class="place {colour_class(k)}" cx="{x:.1f}" cy="{y:.1f}" r="6"/>'
        + labels.place(short(name), x, y, 11.0, f"name {colour_class(k)}")
        for k, (name, (x, y)) in enumerate(zip(names, places, strict=True))
    ]


def _pole_marks(
    names: Sequence[str], to_picture: _ToPicture, ends: Array, labels: Labels
) -> list[str]:
    """Draw each pole as the line that it covers from above, and a ring in its middle."""
    marks = []
    for name, pole in zip(names, ends, strict=True):
        (ax, ay), (bx, by) = to_picture(pole)
        x, y = (ax + bx) / 2, (ay + by) / 2
        marks.append(
            f'<path class="lean" d="M{ax:.1f} {ay:.1f}L{bx:.1f} {by:.1f}"/>'
            f'<circle class="pole" cx="{x:.1f}" cy="{y:.1f}" r="4"/>'
            + labels.place(name, x, y, 8.0, "soft", FONT - 2)
        )
    return marks


def _point_marks(
    names: Sequence[str], places: Sequence[tuple[float, float]], labels: Labels
) -> list[str]:
    return [
        f'<path class="control" d="M{x:.1f} {y - 6:.1f}l6 11h-12z"/>'
        + labels.place(short(name), x, y, 10.0, "soft", FONT - 2)
        for name, (x, y) in zip(names, places, strict=True)
    ]


def _scale_bar(metres: float, scale: float, height: float) -> str:
    x, y = 14.0, height - 14.0
    return (
        f'<path class="bar" d="M{x} {y - 5}v5h{metres * scale:.1f}v-5"/>'
        f'<text x="{x}" y="{y - 10}">{large(metres)} m</text>'
    )


def _direction(plan: Plan) -> str:
    """Draw where north is, or else the level axes of the frame."""
    x = WIDTH - 40.0
    if plan.north is not None:
        return (
            f'<path class="north" d="M{x} 14l7 26l-7 -6l-7 6z"/>'
            f'<text x="{x}" y="56" text-anchor="middle">N</text>'
        )
    ends = [(plan.R_plan_site @ axis)[:2] * 24 for axis in np.eye(3)[:2]]
    return "".join(
        f'<path class="bar" d="M{x - 6} 50l{a:.1f} {-b:.1f}"/>'
        f'<text x="{x - 6 + 1.4 * a:.1f}" y="{55 - 1.4 * b:.1f}" text-anchor="middle">{name}</text>'
        for name, (a, b) in zip("xy", ends, strict=True)
    )


def _caption(document: SiteDoc, plan: Plan, factor: float | None) -> str:
    """Say what the picture shows, also for those who do not see it."""
    up = f"Seen from above, taking for up {plan.words}."
    north = f" {plan.north.capitalize()} is at the top." if plan.north else ""
    ellipses = (
        " No LiDAR has an ellipse: where it stands is without error."
        if factor is None
        else f" Ellipses: 1 σ of where each LiDAR stands, enlarged {large(factor)} times."
    )
    if any(not np.any(each.covariance) for each in document.lidars) and factor is not None:
        fixed = next(each.name for each in document.lidars if not np.any(each.covariance))
        ellipses += f" {fixed} has none: its frame is the site's."
    poles = ""
    if document.poles:
        poles = " Rings: poles, 2.1 being the first of placement 2, with the way each leans."
    points = " Triangles: control points." if document.control_points else ""
    return f"{up}{north}{ellipses}{poles}{points}"


def _places(document: SiteDoc) -> str:
    """List where each LiDAR stands in the frame's own coordinates, each with its 1 σ."""
    offset = document.frame.offset
    rows = []
    for lidar in document.lidars:
        at = np.array(lidar.T_site_lidar)[:3, 3] + offset
        sigma = np.sqrt(np.maximum(np.diag(np.array(lidar.covariance))[3:], 0.0))
        rows.append(
            (
                lidar.name,
                *(number(float(v), 3) for v in at),
                ", ".join(error(float(s)) for s in sigma) if sigma.any() else MISSING,
            )
        )
    caption = f"Where the LiDARs stand, {document.frame.name}"
    return table(caption, ("LiDAR", "x, m", "y, m", "z, m", "1 σ of x, y, z"), rows)


def _poles(document: SiteDoc) -> str:
    if not document.poles:
        return ""
    offset = document.frame.offset
    rows = [
        (
            label,
            pole.name,
            *(number(v, 3) for v in (pole.point + offset).tolist()),
            number(pole.length, 2),
            ", ".join(document.lidars[k].name for k in pole.seen_by),
        )
        for label, pole in zip(pole_labels(document), document.poles, strict=True)
    ]
    header = ("pole", "name", "x, m", "y, m", "z, m", "length, m", "seen by")
    listed = table("Poles, the middle of the tape", header, rows, (1, 6))
    return f"<details><summary>Poles: {len(rows)}</summary>{listed}</details>"
