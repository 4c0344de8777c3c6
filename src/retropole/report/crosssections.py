"""The returns on every pole, looking along it: how well both LiDARs agree, in one picture."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from ..alignment.solver import Step, gauss_newton
from ..base import se3
from ..base.datatypes import Array, Placement
from ..result import ResultDoc
from .names import LIDARS, pair_name

HALF_PICTURE = 110.0
"""Half the side of a picture, in its own units."""

MAX_CIRCLE_ITERATIONS = 500
"""Returns on a pole need about ten; a hundred where they scatter so that no surface is seen."""

CIRCLE_STEP_TOLERANCE = 1e-6
"""A step of the circle's centre shorter than this, metres, is the last: no picture shows less than
a tenth of a millimetre."""

CIRCLE_DAMPING = 1e-6
"""Part of the mean curvature that is added in every direction: returns in one direction from the
centre leave the other free."""

RESIDUAL_SCALE = 0.01
"""Returns further than this from the surface, metres, count for less and less in its place."""

SHOWN_RETURNS = 0.98
"""Share of the returns that a picture holds; strays are cut off."""


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle of known radius fitted to points.

    Attributes
    ----------
    centre
        (2,) in the plane and the units of the points.
    converged
        Whether the solver came to rest.
    """

    centre: Array
    converged: bool


def cross_sections(result: ResultDoc, first: Placement) -> str:
    """Draw the returns of both LiDARs on each pair of poles in the plane across the pole.

    Parameters
    ----------
    result
        The result document.
    first
        The first placement of the poles, whose poles the result lists.
    """
    target, source = first.target.detection, first.source.detection
    chosen = result.chosen
    if target is None or source is None or chosen is None or result.T_target_source is None:
        return ""
    T = np.array(result.T_target_source)
    figures = [
        _figure(
            pair_name((i, j)),
            target.poles[i].xyz,
            se3.apply(T, source.poles[j].xyz),
            T[:3, 3],
            result.config.radius_m,
        )
        for i, j in chosen.pairs
    ]
    return (
        '<h3>Returns, looking along each pole</h3><div class="sections">'
        + "".join(figures)
        + '</div><p class="note">Every return of both LiDARs with the transform, seen along the '
        "pole. The circle is a pole of the given radius where it fits all returns best; the "
        "strokes at the rim point to the LiDARs. Returns scatter towards and away from their own "
        "LiDAR; two clusters beside each other would be an error of the transform.</p>"
    )


class Across(NamedTuple):
    """Centre (3,) of points along a line, and two unit vectors (2, 3) across it."""

    centre: Array
    axes: Array


def across(points: Array) -> Across:
    """Find the plane across the line that points (N, 3) lie along."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    return Across(centre, axes[1:])


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Gradient (2,) and Gauss–Newton matrix (2, 2) of the distances from a circle."""

    gradient: Array
    curvature: Array


def fit_circle(flat: Array, radius: float, start: Array) -> Circle:
    """Fit a circle of a given radius to points (N, 2), with weights against strays.

    Parameters
    ----------
    flat
        (N, 2) points in a plane, metres.
    radius
        Of the circle, metres; no step is longer.
    start
        (2,) centre to start from.
    """

    def linearise(centre: Array) -> _Residuals:
        away = flat - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        outward, residual = away / distance[:, None], distance - radius
        weighted = outward / np.sqrt(1.0 + (residual / RESIDUAL_SCALE) ** 2)[:, None]
        H = weighted.T @ outward
        damped = H + CIRCLE_DAMPING * np.trace(H) * np.eye(2)
        return _Residuals(-weighted.T @ residual, damped)

    def move(centre: Array, _: _Residuals, step: Array) -> Array:
        length = float(np.linalg.norm(step))
        return np.asarray(centre + step * min(1.0, radius / max(length, 1e-12)))

    def small(step: Step) -> bool:
        return float(np.linalg.norm(step.step)) < CIRCLE_STEP_TOLERANCE

    found = gauss_newton(start, linearise, move, small, max_iterations=MAX_CIRCLE_ITERATIONS)
    assert found is not None
    return Circle(found.point, found.converged)


def _figure(name: str, target: Array, source: Array, origin: Array, radius: float) -> str:
    """Draw one pair: points (N, 3) and (M, 3), the source's origin (3,), in the target frame."""
    centre, axes = across(np.concatenate([target, source]))
    flat = [(points - centre) @ axes.T for points in (target, source)]
    # Returns lie in front of the axis: it is to be found on the far side of them.
    sensors = [-(axes @ centre), axes @ (origin - centre)]
    towards = [s / max(float(np.linalg.norm(s)), 1e-9) for s in sensors]
    start = -np.mean(towards, axis=0) * radius * np.pi / 4
    circle = fit_circle(np.concatenate(flat), radius, start)
    distances = np.linalg.norm(np.concatenate(flat) - circle.centre, axis=1)
    rms = float(np.sqrt(np.mean((distances - radius) ** 2)))
    half_width = float(max(3 * radius, np.quantile(distances, SHOWN_RETURNS)))
    scale = (HALF_PICTURE - 14) / half_width
    dots = "".join(
        f'<circle class="{lidar}" cx="{x:.1f}" cy="{y:.1f}" r="1.9"/>'
        for lidar, points in zip(LIDARS, flat, strict=True)
        for x, y in ((points - circle.centre) * scale * [1, -1])
        if max(abs(x), abs(y)) < HALF_PICTURE
    )
    inner, outer = HALF_PICTURE - 12, HALF_PICTURE - 2
    rim = "".join(
        f'<line class="{lidar}" x1="{x * inner:.1f}" y1="{-y * inner:.1f}" '
        f'x2="{x * outer:.1f}" y2="{-y * outer:.1f}"/>'
        for lidar, (x, y) in zip(LIDARS, towards, strict=True)
    )
    bar = 10.0 ** np.floor(np.log10(half_width))
    words, kind = f"{1000 * rms:.1f} mm rms from the surface", "pole"
    if not circle.converged:
        words, kind = f"{words} (the fit of the circle did not converge)", "pole unconverged"
    side = f"{2 * HALF_PICTURE:g}"
    left, bottom = 8 - HALF_PICTURE, HALF_PICTURE - 8
    return (
        f'<figure><svg viewBox="{-HALF_PICTURE:g} {-HALF_PICTURE:g} {side} {side}" role="img" '
        f'aria-label="{escape(f"{name}: {words}")}">{dots}'
        f'<circle class="{kind}" r="{radius * scale:.1f}"/>'
        f'{rim}<path class="bar" d="M{left:g} {bottom:g}h{bar * scale:.1f}"/>'
        f'<text x="{left:g}" y="{bottom - 5:g}">{100 * bar:g} cm</text></svg>'
        f"<figcaption><b>{escape(name)}</b> {words}, "
        f"{len(target)} + {len(source)} returns</figcaption></figure>"
    )
