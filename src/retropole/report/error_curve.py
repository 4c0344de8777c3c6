"""The predicted error over the distance: 1 σ, what 95 % are below, and what was asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..base.quantities import MILLIMETRES_BELOW, error, round_below
from ..base.uncertainty import predicted_error
from ..base.uncertainty.purpose import CONFIDENCE, Need, displacement_bounds
from ..result import chance_wrong
from .certainty import BUDGET_RANGE, worst_lidar
from .page import EMPTY, Html, fill, join
from .subject import LIDARS, Subject

RANGES = (1.0, *(5.0 * k for k in range(1, 13)))
"""Where the curves have their corners, metres: both are nearly straight beyond the first."""

WIDTH, HEIGHT = 520.0, 300.0
"""Of the picture, in its own units."""

LEFT, RIGHT, TOP, BOTTOM = 58.0, 462.0, 34.0, 246.0
"""Edges of what is plotted."""

LEAST_GAP = 20.0
"""Names of two curves are at least so far from each other."""

MOST_ABOVE = 4.0
"""A need beyond so many times the largest error is told in words alone: its line would press the
curves flat."""


class ErrorCurve(NamedTuple):
    """The error of a point of a LiDAR at `RANGES`, metres.

    `bounds` hold for all points up to there with a probability of `CONFIDENCE`, as a need does;
    None where nothing holds with it, since the pose may be another one.
    """

    sigmas: Sequence[float]
    bounds: Sequence[float] | None
    need: Need | None
    wrong: float
    whose: str

    def at_range(self, values: Sequence[float]) -> str:
        """Write one of the errors at `BUDGET_RANGE`."""
        return error(values[RANGES.index(BUDGET_RANGE)])


def error_curve(subject: Subject) -> ErrorCurve | None:
    """Work out the error over the distance, of a site that of the LiDAR with the largest.

    None where no covariance is stated, and where refused.
    """
    pair, lidar = subject.pair, worst_lidar(subject.site.lidars)
    if pair is not None:
        lidar = subject.site.lidars[1]
    if not subject.answered or lidar is None or lidar.covariance is None:
        return None
    covariance = np.asarray(lidar.covariance)
    found, asked = None if pair is None else pair.confirmation, lidar.fitness
    wrong = (found.probability_wrong or 0.0) if found and not found.trusted else 0.0
    if pair is None:
        wrong = chance_wrong(subject.site.reasons)
    # As in `fitness`: what is left of the confidence once the pose may be another one.
    probability = CONFIDENCE / max(1.0 - wrong, CONFIDENCE)
    bounds = displacement_bounds(covariance, RANGES, probability).tolist()
    return ErrorCurve(
        [each.sigma_m for each in predicted_error(covariance, RANGES)],
        bounds if 1.0 - wrong > CONFIDENCE else None,
        Need(asked.within_m, asked.at_m) if asked else None,
        wrong,
        f"the {LIDARS[1]}" if pair is not None else lidar.name,
    )


def curve_sentence(curve: ErrorCurve | None) -> str:
    """Say how far off a point is, in one sentence; empty where no probability can be given."""
    if curve is None or curve.bounds is None:
        return ""
    of = "" if curve.whose == f"the {LIDARS[1]}" else f"of {curve.whose}, the least certain LiDAR, "
    return (
        f"Points {of}up to {BUDGET_RANGE:g} m away are within {curve.at_range(curve.bounds)} of "
        f"their true place, {CONFIDENCE:.0%} sure.".replace("%", " %")
    )


def curve_figure(curve: ErrorCurve | None) -> Html:
    """Draw the error over the distance, with what was asked for; nothing where none is stated."""
    if curve is None:
        return EMPTY
    most = max([*curve.sigmas, *(curve.bounds or ())])
    need = curve.need if curve.need and curve.need.within <= MOST_ABOVE * most else None
    step = _step(1.05 * max(most, need.within if need else 0.0))
    count = math.ceil(1.05 * max(most, need.within if need else 0.0) / step)
    plot = _Plot(RANGES[-1], count * step)
    marks = [*_axes(plot, step, count), *_curves(plot, curve)]
    if need is not None:
        marks += _need(plot, need)
    return fill(
        "curve-figure",
        width=f"{WIDTH:g}",
        height=f"{HEIGHT:g}",
        marks=join(marks),
        said=_caption(curve, is_drawn=need is not None),
    )


class _Plot(NamedTuple):
    """From metres of distance and of error to the picture."""

    far: float
    top: float

    def at(self, distance: float, size: float) -> tuple[float, float]:
        x = LEFT + (RIGHT - LEFT) * distance / self.far
        return x, BOTTOM - (BOTTOM - TOP) * size / self.top


def _step(top: float) -> float:
    """Choose the distance of the lines across the picture: 1, 2 or 5, four or five of them."""
    least = round_below(top / 5)
    return next(k * least for k in (1.0, 2.0, 2.5, 5.0) if k * least >= top / 5 * (1 - 1e-9))


def _axes(plot: _Plot, step: float, count: int) -> Iterator[Html]:
    scale, unit = (1000.0, "mm") if plot.top < MILLIMETRES_BELOW else (1.0, "m")
    for k in range(count + 1):
        _, y = plot.at(0.0, k * step)
        value = f"{scale * k * step:g}"
        yield fill("curve-level", x=LEFT, y=y, right=RIGHT, at=LEFT - 8, below=y + 5, value=value)
    for k in range(0, int(plot.far) + 1, 10):
        x, y = plot.at(float(k), 0.0)
        yield fill("curve-distance", x=x, y=y, below=y + 22, value=k)
    yield fill("curve-names", left=LEFT, above=TOP - 16, unit=unit, x=(LEFT + RIGHT) / 2, y=290.0)


def _curves(plot: _Plot, curve: ErrorCurve) -> Iterator[Html]:
    """Draw the curves and name each at its end, the names apart from each other."""
    lines = [("one-sigma", "1 σ", curve.sigmas)]
    if curve.bounds is not None:
        lines.append(("bound", f"{100 * CONFIDENCE:.0f} %", curve.bounds))
    last = HEIGHT
    for kind, name, values in lines:
        corners = [plot.at(*each) for each in zip(RANGES, values, strict=True)]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in corners)
        last = min(corners[-1][1] + 5, last - LEAST_GAP)
        yield fill("curve-line", kind=kind, path=path, x=RIGHT + 8, y=last, name=name)


def _need(plot: _Plot, need: Need) -> Iterator[Html]:
    """Draw what was asked for, as far as it was asked for."""
    x, y = plot.at(min(need.at, plot.far), need.within)
    beside = y + 20 if y < TOP + 20 else y - 8
    name = f"needed: {100 * need.within:g} cm up to {need.at:g} m"
    yield fill("curve-need", left=LEFT, x=x, y=y, text=LEFT + 8, beside=beside, name=name)


def _caption(curve: ErrorCurve, *, is_drawn: bool) -> str:
    """Say what the picture shows, also for those who do not see it."""
    far = f"{BUDGET_RANGE:g} m"
    said = [f"Predicted error of a point of {curve.whose} by its distance from that LiDAR."]
    said.append(f"1 σ, the mean over all directions: {curve.at_range(curve.sigmas)} at {far}.")
    if curve.bounds is not None:
        bound = curve.at_range(curve.bounds)
        said.append(f"With 95 % probability no point up to {far} away is off by more than {bound}.")
    else:
        said.append(
            f"No 95 % line: the pose itself is wrong with a probability of {curve.wrong:.0%}, "
            "which 1 σ does not count.".replace("%,", " %,")
        )
    if curve.need is not None:
        outside = "" if is_drawn else ", far above this picture"
        said.append(f"Needed: {curve.need.words}{outside}.")
    return " ".join(said)
