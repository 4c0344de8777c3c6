"""The returns on every pole, looking along it: how well both LiDARs agree, in one picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..alignment.solver import Solution, Step, gauss_newton
from ..base import se3
from ..base.datatypes import Array
from .page import EMPTY, Html, fill, join
from .subject import LIDARS, Subject, colour_class, pair_name

HALF_PICTURE = 110.0
"""Half the side of a picture, in its own units; `pieces.html` has the same."""

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


def cross_sections(subject: Subject) -> Html:
    """Draw the returns of both LiDARs of a pair on each of its poles, in the plane across it."""
    pair = subject.pair
    target, source = (of_lidar[0] for of_lidar in subject.scans)
    if pair is None or pair.chosen is None or pair.T_target_source is None:
        return EMPTY
    if target is None or source is None or target.detection is None or source.detection is None:
        return EMPTY
    T, figures = pair.T_target_source, []
    for i, j in pair.chosen.pairs:
        points = target.poles[i].xyz, se3.apply(T, source.poles[j].xyz)
        figures.append(_figure(pair_name((i, j)), *points, T[:3, 3], pair.config.radius_m))
    return fill("sections", figures=join(figures))


def across(points: Array) -> tuple[Array, Array]:
    """Find the plane across the line that points (N, 3) lie along: centre (3,), axes (2, 3)."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    return centre, axes[1:]


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Gradient (2,) and Gauss–Newton matrix (2, 2) of the distances from a circle."""

    gradient: Array
    curvature: Array


def fit_circle(flat: Array, radius: float, start: Array) -> Solution[Array]:
    """Fit a circle of a given radius to points (N, 2), with weights against strays.

    Parameters
    ----------
    flat
        (N, 2) points in a plane, metres.
    radius
        Of the circle, metres; no step is longer.
    start
        (2,) centre to start from.

    Returns
    -------
    Solution
        Its point is the centre (2,), in the plane and the units of the points.
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
    return found


def _figure(name: str, target: Array, source: Array, origin: Array, radius: float) -> Html:
    """Draw one pair: points (N, 3) and (M, 3), the source's origin (3,), in the target frame."""
    centre, axes = across(np.concatenate([target, source]))
    flat = [(points - centre) @ axes.T for points in (target, source)]
    # Returns lie in front of the axis: it is to be found on the far side of them.
    sensors = [-(axes @ centre), axes @ (origin - centre)]
    towards = [s / max(float(np.linalg.norm(s)), 1e-9) for s in sensors]
    start = -np.mean(towards, axis=0) * radius * np.pi / 4
    circle = fit_circle(np.concatenate(flat), radius, start)
    distances = np.linalg.norm(np.concatenate(flat) - circle.point, axis=1)
    rms = float(np.sqrt(np.mean((distances - radius) ** 2)))
    half_width = float(max(3 * radius, np.quantile(distances, SHOWN_RETURNS)))
    scale = (HALF_PICTURE - 14) / half_width
    colours = [colour_class(k) for k in range(len(LIDARS))]
    dots = join(
        fill("return", colour=colour, x=x, y=y)
        for colour, points in zip(colours, flat, strict=True)
        for x, y in ((points - circle.point) * scale * [1, -1])
        if max(abs(x), abs(y)) < HALF_PICTURE
    )
    inner, outer = HALF_PICTURE - 12, HALF_PICTURE - 2
    rim = join(
        fill("rim", colour=colour, x1=x * inner, y1=-y * inner, x2=x * outer, y2=-y * outer)
        for colour, (x, y) in zip(colours, towards, strict=True)
    )
    bar = 10.0 ** np.floor(np.log10(half_width))
    words, kind = f"{1000 * rms:.1f} mm rms from the surface", ""
    if not circle.converged:
        words, kind = f"{words} (the fit of the circle did not converge)", " unconverged"
    return fill(
        "section",
        name=name,
        words=words,
        returns=f"{len(target)} + {len(source)} returns",
        dots=dots,
        rim=rim,
        kind=kind,
        radius=radius * scale,
        bar=bar * scale,
        cm=f"{100 * bar:g}",
    )
