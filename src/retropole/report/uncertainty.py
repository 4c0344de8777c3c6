"""How certain a pose is, on the page: by state, by range, and by source of error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import Array
from ..base.quantities import UNKNOWN, Unit, error, percent, value
from ..base.uncertainty import Uncertainty
from ..result import BudgetEntry, ResultDoc
from ..result.site_parts import LidarDoc
from .certainty import BUDGET_RANGE, error_parts, number
from .markup import folded, plus_minus, table
from .page import EMPTY, Html, fill, join
from .subject import LIDARS, Subject, colour_class

STATES = tuple(
    f"{kind} {axis}" for kind in ("rotation about", "translation along") for axis in "xyz"
)
"""The six directions of a covariance, in its order."""

UNITS: tuple[Unit, ...] = ("rad", "rad", "rad", "m", "m", "m")
"""Of the states."""

PARTS = ("random", "systematic")

FOLDED_BELOW = 0.005
"""Sources of error with a smaller share, written ``< 1 %``, are folded away."""


def uncertainty(subject: Subject, k: int) -> Html:
    """Show how certain the pose of the k-th LiDAR is, what that means, and what it is made of."""
    site, pair, lidar = subject.site, subject.pair, subject.site.lidars[k]
    if lidar.covariance is None:
        said = fill("p", text="This run gives no covariance.")
    elif not np.any(lidar.covariance):
        return fill("p", text="Its frame is that of the site: its pose has no error.")
    else:
        said = fill("p", text=site.covariance_frame)
    parts = None if pair is None else pair.uncertainty
    name = subject.called(k)
    matrices = [] if lidar.covariance is None else [lidar.covariance]
    matrices += [parts.random, parts.systematic] if matrices and parts else []
    captions = [f"Covariance of {name}, rad and m", *(f"Its {part} part" for part in PARTS)]
    order = site.covariance_order
    listed = [
        table(caption, ("state", *order), _named(order, [[f"{v:.3e}" for v in row] for row in C]))
        for caption, C in zip(captions, matrices, strict=False)
    ]
    tables = (
        range_table(lidar, parts, f"A point of {name} in the frame of {subject.frame}"),
        state_table(lidar, parts, f"Pose of {name}, axes of {subject.frame}"),
        EMPTY if pair is None else _residuals(pair),
    )
    return join(
        (
            EMPTY if pair is None else _weakest(pair),
            EMPTY if parts is None else fill("kinds"),
            fill("columns", body=join(tables)),
            budget_table(lidar.budget) if lidar.budget else EMPTY,
            said,
            folded("Covariance matrix", join(listed)),
        )
    )


def _named(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    return [(name, *row) for name, row in zip(names, rows, strict=True)]


def _weakest(pair: ResultDoc) -> Html:
    """Say in which direction the pose is least certain."""
    weakest = pair.weakest
    if weakest is None:
        return EMPTY
    direction = ", ".join(number(value, 2) for value in weakest.direction)
    return fill(
        "weakest",
        words=weakest.words,
        direction=direction,
        condition=number(weakest.condition, 1),
    )


def range_table(lidar: LidarDoc, parts: Uncertainty | None, caption: str) -> Html:
    """Say where a point lands, by its range."""
    stated = lidar.predicted_error or []
    if not stated:
        return EMPTY
    apart = [tuple(map(error, each[2:])) for each in error_parts(stated, parts)]
    rows = [
        (f"{each.range_m:g} m", plus_minus(each.sigma_m), *more)
        for each, more in zip(stated, apart or [()] * len(stated), strict=True)
    ]
    return table(caption, ("at range", "1 σ", *(PARTS if apart else ())), rows)


def state_table(lidar: LidarDoc, parts: Uncertainty | None, caption: str) -> Html:
    """Say how certain each rotation and translation is."""
    if lidar.covariance is None:
        return EMPTY
    matrices = [lidar.covariance, *([] if parts is None else [parts.random, parts.systematic])]
    rows = _named(STATES, list(zip(*map(_sigmas, matrices), strict=True)))
    return table(caption, ("state", "1 σ", *PARTS)[: 1 + len(matrices)], rows)


def _sigmas(matrix: Array) -> list[str]:
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0)).tolist()
    return [error(s, unit) for s, unit in zip(sigma, UNITS, strict=True)]


def _residuals(pair: ResultDoc) -> Html:
    estimates = (("poles alone", pair.stages.poles), ("refined", pair.stages.refined))
    rows = [(name, number(each.rms, 1, 1000)) for name, each in estimates if each is not None]
    return table("Pose estimates", ("estimate", "rms residual, mm"), rows) if rows else EMPTY


def budget_table(budget: Sequence[BudgetEntry]) -> Html:
    """List every source of error, the largest first, each with a bar as long as its share.

    Those of a small share are folded away. A column says whose each is where its name does not.
    """
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    whose = any(entry.sensor for entry in entries)
    # At least the largest is shown, also of a budget of many equal parts.
    shown = max(1, sum(entry.share_at_30m >= FOLDED_BELOW for entry in entries))
    together = percent(sum(entry.share_at_30m for entry in entries[shown:]))
    rest = _entries("The rest of the error budget", entries[shown:], whose)
    return fill(
        "budget",
        shown=_entries("Error budget", entries[:shown], whose),
        rest=folded(f"{len(entries) - shown} smaller, together {together}", rest),
        range=f"{BUDGET_RANGE:g}",
    )


def _entries(caption: str, entries: Sequence[BudgetEntry], whose: bool) -> Html:
    rows = [
        (
            entry.name,
            *([entry.sensor or UNKNOWN] if whose else []),
            error(entry.sigma, entry.unit),
            value(entry.estimated, entry.sigma, entry.unit),
            percent(entry.share_at_30m),
        )
        for entry in entries
    ]
    bars = [(bar_class(entry.sensor), entry.share_at_30m) for entry in entries]
    lidar = ["LiDAR"] if whose else []
    header = ("source of error", *lidar, "1 σ", "estimated", f"share at {BUDGET_RANGE:g} m")
    return table(caption, header, rows, (1,) if whose else (), bars) if rows else EMPTY


def bar_class(sensor: str | None) -> str:
    """Name the class of a bar's colour: that of its LiDAR."""
    return colour_class(LIDARS.index(sensor)) if sensor in LIDARS else "both"
