"""Charts: the predicted error over the distance, and how each LiDAR swayed while it recorded."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..base.quantities import MILLIMETRES_BELOW, error, round_below
from ..base.uncertainty import BUDGET_RANGE, predicted_error
from ..base.uncertainty.purpose import CONFIDENCE, Need, displacement_bounds
from ..result import SwayDoc, chance_wrong
from ..result.site import LIDARS
from .listings import worst_lidar
from .page import EMPTY, Html, fill, join
from .subject import Subject
from .svg import Chart, picture, round_numbers, round_step

RANGES = (1.0, *(5.0 * k for k in range(1, 13)))
"""Where the curves have their corners, metres: both are nearly straight beyond the first."""

LEAST_GAP = 20.0
"""Least distance between the names of two curves."""

MOST_ABOVE = 4.0
"""A need beyond this many times the largest error is stated in words alone: its line would press
the curves flat."""


class ErrorCurve(NamedTuple):
    """The error of a point of a LiDAR at `RANGES`, metres.

    `bounds` hold for all points up to there with a probability of `CONFIDENCE`, as a need does;
    None if there is none, since the pose may be another one.
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

    None if no covariance is stated, and where refused.
    """
    pair, lidar = subject.pair, worst_lidar(subject.site.lidars)
    if pair is not None:
        lidar = subject.site.lidars[1]
    if not subject.answered or lidar is None or lidar.covariance is None:
        return None
    covariance = np.asarray(lidar.covariance)
    found, requested = None if pair is None else pair.confirmation, lidar.fitness
    wrong = (found.probability_wrong or 0.0) if found and not found.trusted else 0.0
    if pair is None:
        wrong = chance_wrong(subject.site.reasons)
    # As in `fitness`: what is left of the confidence once the pose may be another one.
    probability = CONFIDENCE / max(1.0 - wrong, CONFIDENCE)
    bounds = displacement_bounds(covariance, RANGES, probability).tolist()
    return ErrorCurve(
        [each.sigma_m for each in predicted_error(covariance, RANGES)],
        bounds if 1.0 - wrong > CONFIDENCE else None,
        Need(requested.within_m, requested.at_m) if requested else None,
        wrong,
        f"the {LIDARS[1]}" if pair is not None else lidar.name,
    )


def curve_sentence(curve: ErrorCurve | None) -> str:
    """State the error of a point, in one sentence; empty if no probability can be given."""
    if curve is None or curve.bounds is None:
        return ""
    of = "" if curve.whose == f"the {LIDARS[1]}" else f"of {curve.whose}, the least certain LiDAR, "
    return (
        f"Points {of}up to {BUDGET_RANGE:g} m away are within {curve.at_range(curve.bounds)} of "
        f"their true place, {CONFIDENCE:.0%} sure.".replace("%", " %")
    )


def curve_figure(curve: ErrorCurve | None) -> Html:
    """Draw the error over the distance, with what was requested; nothing if none is stated."""
    if curve is None:
        return EMPTY
    most = max([*curve.sigmas, *(curve.bounds or ())])
    need = curve.need if curve.need and curve.need.within <= MOST_ABOVE * most else None
    top = 1.05 * max(most, need.within if need else 0.0)
    step = round_step(top)
    top = step * math.ceil(top / step)
    scale, unit = (1000.0, "mm") if top < MILLIMETRES_BELOW else (1.0, "m")
    chart = Chart((58.0, 34.0, 462.0, 246.0), (0.0, RANGES[-1]), (0.0, top))
    marks = chart.axes(
        {distance: f"{distance:g}" for distance in RANGES if distance % 10 == 0} | {0.0: "0"},
        round_numbers(0.0, top, 1 / scale),
        "distance from the LiDAR, m",
        f"error, {unit}",
    )
    marks += _curves(chart, curve)
    if need is not None:
        marks.append(_need(chart, need))
    return picture("curve-said", 300.0, marks, _caption(curve, is_drawn=need is not None), "curve")


def _curves(chart: Chart, curve: ErrorCurve) -> Iterator[Html]:
    """Draw the curves and name each at its end, the names not overlapping."""
    lines = [("one-sigma", "1 σ", curve.sigmas)]
    if curve.bounds is not None:
        lines.append(("bound", f"{100 * CONFIDENCE:.0f} %", curve.bounds))
    last = math.inf
    for kind, name, values in lines:
        x, y = chart.at(np.array([[RANGES[-1], values[-1]]]))[0]
        last = min(float(y) + 5, last - LEAST_GAP)
        yield fill("line", kind=kind, path=chart.line(RANGES, values))
        yield fill("label", x=x + 8, y=last, anchor="start", style="name", text=name)


def _need(chart: Chart, need: Need) -> Html:
    """Draw what was requested, as far as it was requested."""
    x, y = chart.at(np.array([[min(need.at, RANGES[-1]), need.within]]))[0]
    left, top, _, _ = chart.box
    label_y = y + 20 if y < top + 20 else y - 8
    name = f"needed: {100 * need.within:g} cm up to {need.at:g} m"
    return fill("curve-need", left=left, x=x, y=y, text=left + 8, beside=label_y, name=name)


def _caption(curve: ErrorCurve, *, is_drawn: bool) -> str:
    """Describe the picture, also for those who do not see it."""
    far = f"{BUDGET_RANGE:g} m"
    text = [f"Predicted error of a point of {curve.whose} by its distance from that LiDAR."]
    text.append(f"1 σ, the mean over all directions: {curve.at_range(curve.sigmas)} at {far}.")
    if curve.bounds is not None:
        bound = curve.at_range(curve.bounds)
        text.append(f"With 95 % probability no point up to {far} away is off by more than {bound}.")
    else:
        text.append(
            f"No 95 % line: the pose itself is wrong with a probability of {curve.wrong:.0%}, "
            "which 1 σ does not include.".replace("%,", " %,")
        )
    if curve.need is not None:
        outside = "" if is_drawn else ", far above this picture"
        text.append(f"Needed: {curve.need.text}{outside}.")
    return " ".join(text)


def sways(subject: Subject) -> Html:
    """Draw what was seen of each recording, name what was stated; nothing if none swayed."""
    if not subject.site.sways:
        return EMPTY
    several = len(subject.site.placements) > 1
    figures = [_figure(subject, each, several=several) for each in subject.site.sways]
    return fill("sways", figures=join(figures))


def _figure(subject: Subject, found: SwayDoc, *, several: bool) -> Html:
    """Draw the angle over time, between three lines."""
    sway, name = found.sway, subject.called(found.lidar)
    name = f"{name[0].upper()}{name[1:]}"
    if several:
        name += f", placement {subject.placement(found.placement)}"
    text = f"{name}: {sway.text}."
    if len(sway.times_s) < 2:
        return fill("p", text=text)
    angles, last = [math.degrees(each) for each in sway.angles_rad], sway.times_s[-1]
    most = max(*map(abs, angles), 1e-3)
    chart = Chart((66.0, 34.0, 500.0, 166.0), (0.0, last), (-1.1 * most, 1.1 * most))
    levels = {k * round_below(most): f"{k * round_below(most):.2g}" for k in (-1, 0, 1)}
    times = {k * last / 4: f"{k * last / 4:.2g}" for k in range(5)}
    line = fill("line", kind="bound", path=chart.line(sway.times_s, angles))
    marks = [*chart.axes(times, levels, "time, s", "angle, °"), line]
    return picture(f"sway-{found.lidar}-{found.placement}", 220.0, marks, text, "curve")
