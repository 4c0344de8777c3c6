"""How certain a pose is, on the page: by state, by range, and by source of error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import Array
from ..base.quantities import UNKNOWN, Unit, error, percent, value
from ..base.uncertainty import Uncertainty
from ..result import BudgetEntry, ResultDoc
from ..result.site import LidarDoc
from .certainty import BUDGET_RANGE, error_parts, number
from .listings import Listing, numbers
from .page import EMPTY, Html, fill, folded, join, listed, plus_minus, table
from .subject import LIDARS, Subject, colour_class
from .verdict import folded_notes, listed_statements

STATES = (
    *(f"rotation about {axis} (phi_{axis})" for axis in "xyz"),
    *(f"translation along {axis} (delta_{axis})" for axis in "xyz"),
)
"""The six directions of a covariance, in its order."""

UNITS: tuple[Unit, ...] = ("rad", "rad", "rad", "m", "m", "m")
"""Of the states."""

FOLDED_BELOW = 0.005
"""Sources of error with a smaller share, written ``< 1 %``, are folded away."""


def certainty(subject: Subject) -> Html:
    """Say how certain an answer is, in sentences first; of a pair its figures follow."""
    if not subject.answered:
        return EMPTY
    return fill(
        "certainty",
        statements=listed_statements(subject),
        notes=folded_notes(subject),
        body=EMPTY if subject.pair is None else uncertainty(subject, 1),
    )


def uncertainty(subject: Subject, k: int) -> Html:
    """Show how certain the pose of the k-th LiDAR is, what that means, and what it is made of."""
    pair, lidar, name = subject.pair, subject.site.lidars[k], subject.called(k)
    parts = None if pair is None else pair.uncertainty
    kinds = covariances(lidar, parts)
    if kinds and not kinds["1 σ"].any():
        return fill("p", text="Its frame is that of the site: its pose has no error.")
    order = subject.site.covariance_order
    matrices = (
        table(
            f"Covariance of {name}, rad and m: {kind}",
            ("state", *order),
            [(state, *(f"{v:.3e}" for v in row)) for state, row in zip(order, matrix, strict=True)],
        )
        for kind, matrix in kinds.items()
    )
    tables = (
        listed(ranges(lidar, parts, f"A point of {name} in the frame of {subject.frame}")),
        listed(states(kinds, f"Pose of {name}, axes of {subject.frame}")),
        EMPTY if pair is None else listed(_residuals(pair)),
    )
    said = subject.site.covariance_frame if kinds else "This run gives no covariance."
    return fill(
        "uncertainty",
        weakest=EMPTY if pair is None else _weakest(pair),
        kinds=EMPTY if parts is None else fill("kinds"),
        tables=join(tables),
        budget=budget_table(lidar.budget) if lidar.budget else EMPTY,
        said=said,
        matrices=folded("Covariance matrix", join(matrices)),
    )


def covariances(lidar: LidarDoc, parts: Uncertainty | None) -> dict[str, Array]:
    """Give the covariance (6, 6) of a pose, and its two parts where they are stated."""
    if lidar.covariance is None:
        return {}
    whole = {"1 σ": np.asarray(lidar.covariance)}
    return whole | ({"random": parts.random, "systematic": parts.systematic} if parts else {})


def _weakest(pair: ResultDoc) -> Html:
    """Say in which direction the pose is least certain."""
    weakest = pair.weakest
    if weakest is None:
        return EMPTY
    direction = ", ".join(numbers(weakest.direction, 2))
    ratio = number(weakest.condition, 1)
    return fill("weakest", words=weakest.words, direction=direction, ratio=ratio)


def ranges(lidar: LidarDoc, parts: Uncertainty | None, caption: str) -> Listing:
    """Say where a point lands, by its range."""
    stated = lidar.predicted_error or []
    apart = [[error(each.random), error(each.systematic)] for each in error_parts(stated, parts)]
    rows = [
        [f"{each.range_m:g} m", plus_minus(each.sigma_m), *more]
        for each, more in zip(stated, apart or [[]] * len(stated), strict=True)
    ]
    kinds = ("random", "systematic") if apart else ()
    return Listing(caption, ("at range", "1 σ", *kinds), rows)


def states(kinds: dict[str, Array], caption: str) -> Listing:
    """Say how certain each rotation and translation is, in all and of each kind."""
    sigmas = [np.sqrt(np.maximum(np.diag(matrix), 0.0)) for matrix in kinds.values()]
    rows = [
        [state, *(error(float(s), unit) for s in row)]
        for state, unit, row in zip(STATES, UNITS, np.transpose(sigmas), strict=bool(kinds))
    ]
    return Listing(caption, ("state", *kinds), rows)


def _residuals(pair: ResultDoc) -> Listing:
    estimates = (("poles alone", pair.stages.poles), ("refined", pair.stages.refined))
    rows = [(name, number(each.rms, 1, 1000)) for name, each in estimates if each is not None]
    return Listing("Pose estimates", ("estimate", "rms residual, mm"), rows)


def budget_table(budget: Sequence[BudgetEntry]) -> Html:
    """List every source of error, the largest first, each with a bar as long as its share.

    Those of a small share are folded away.
    """
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    # At least the largest is shown, also of a budget of many equal parts.
    shown = max(1, sum(entry.share_at_30m >= FOLDED_BELOW for entry in entries))
    together = percent(sum(entry.share_at_30m for entry in entries[shown:]))
    rest = _entries("The rest of the error budget", entries[shown:])
    return fill(
        "budget",
        shown=_entries("Error budget", entries[:shown]),
        rest=folded(f"{len(entries) - shown} smaller, together {together}", rest),
        range=f"{BUDGET_RANGE:g}",
    )


def _entries(caption: str, entries: Sequence[BudgetEntry]) -> Html:
    if not entries:
        return EMPTY
    bars = [
        (
            colour_class(LIDARS.index(entry.sensor)) if entry.sensor in LIDARS else "both",
            entry.share_at_30m,
        )
        for entry in entries
    ]
    return table(*sources(caption, entries), bars)


def sources(caption: str, entries: Sequence[BudgetEntry]) -> Listing:
    """List sources of error; a column says whose each is, where its name does not."""
    whose = any(entry.sensor for entry in entries)
    rows = [
        [
            *(entry.name, *([entry.sensor or UNKNOWN] if whose else [])),
            error(entry.sigma, entry.unit),
            value(entry.estimated, entry.sigma, entry.unit),
            percent(entry.share_at_30m),
        ]
        for entry in entries
    ]
    lidar = ["LiDAR"] if whose else []
    header = ("source of error", *lidar, "1 σ", "estimated", f"share at {BUDGET_RANGE:g} m")
    return Listing(caption, header, rows, (1,) if whose else ())
