"""How certain the answer is, on the page: by state, by range, and by source of error."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ..base.datatypes import Array
from ..base.quantities import Unit, error, percent, value
from ..result import BudgetEntry, ResultDoc
from .certainty import BUDGET_RANGE, error_parts
from .markup import MISSING, number, plus_minus, table

_STATE = {
    **{f"phi_{axis}": f"rotation about {axis} (phi_{axis})" for axis in "xyz"},
    **{f"delta_{axis}": f"translation along {axis} (delta_{axis})" for axis in "xyz"},
}

_STATE_UNITS: tuple[Unit, ...] = ("rad", "rad", "rad", "m", "m", "m")

PARTS = ("random", "systematic")

FOLDED_BELOW = 0.005
"""Sources of error with a smaller share, written ``< 1 %``, are folded away."""


BUDGET_NOTE = (
    '<p class="note">1 σ: how large an error of that kind may be; of what is no error of an '
    f"instrument or a pole, how far it moves a point {BUDGET_RANGE:g} m away. Estimated: what "
    "these data say of it; the pose is free of that. Share: of the variance of where a point "
    f"{BUDGET_RANGE:g} m away lands; all shares make 100 %.</p>"
)
"""What the columns of `budget_table` mean."""


def uncertainty(result: ResultDoc) -> str:
    """Show the covariance, what it means at each range, and what it is made of."""
    if result.T_target_source is None:
        return ""
    matrix = "<p>This run gives no covariance.</p>"
    if result.covariance is not None:
        stated = result.uncertainty
        more = [] if stated is None else [(PARTS[0], stated.random), (PARTS[1], stated.systematic)]
        matrix = (
            f"<p>{escape(result.covariance_frame)}</p>"
            "<details><summary>Covariance matrix</summary>"
            + _matrix(result, "Covariance, rad and m", result.covariance)
            + "".join(_matrix(result, f"Its {part} part", entries) for part, entries in more)
            + "</details>"
        )
    return (
        '<section aria-labelledby="uncertainty"><h2 id="uncertainty">Uncertainty</h2>'
        f"{_weakest(result)}{_kinds(result)}"
        f'<div class="columns">{_ranges(result)}{_states(result)}{_residuals(result)}</div>'
        f"{_budget(result)}{matrix}</section>"
    )


def _weakest(result: ResultDoc) -> str:
    """Say in which direction the pose is least certain."""
    weakest = result.weakest
    if weakest is None:
        return ""
    direction = ", ".join(number(value, 2) for value in weakest.direction)
    return (
        f"<p>Least certain, at the poles: {escape(weakest.words)} (1 σ), along ({direction}) in "
        "the target frame. Ratio of the largest to the smallest 1 σ of the six directions of the "
        f"pose: {number(weakest.condition, 1)}.</p>"
    )


def _kinds(result: ResultDoc) -> str:
    if result.uncertainty is None:
        return ""
    return (
        '<p class="note">Random errors are drawn anew with every recording, and more recordings '
        "average them. Systematic errors belong to the instruments and the poles: they stay. The "
        "squares of both add up.</p>"
    )


def _ranges(result: ResultDoc) -> str:
    """Say where a point lands, by its range."""
    caption, parts = "A source point in the target frame", error_parts(result)
    if parts:
        rows = [
            (f"{each.range_m:g} m", plus_minus(each.together), *map(error, each[2:]))
            for each in parts
        ]
        return table(caption, ("at range", "1 σ", *PARTS), rows)
    stated = [(f"{e.range_m:g} m", plus_minus(e.sigma_m)) for e in result.predicted_error or []]
    return table(caption, ("at range", "1 σ"), stated) if stated else ""


def _states(result: ResultDoc) -> str:
    """Say how certain each rotation and translation is."""
    if result.covariance is None:
        return ""
    matrices, stated = [result.covariance], result.uncertainty
    if stated is not None:
        matrices += [stated.random, stated.systematic]
    columns = [_sigmas(matrix) for matrix in matrices]
    names = (_STATE.get(name, name) for name in result.covariance_order)
    rows = list(zip(names, *columns, strict=True))
    return table("1 σ of the pose", ("state", "1 σ", *PARTS)[: 1 + len(columns)], rows)


def _sigmas(matrix: Array) -> list[str]:
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0)).tolist()
    return [error(s, unit) for s, unit in zip(sigma, _STATE_UNITS, strict=True)]


def _residuals(result: ResultDoc) -> str:
    estimates = (("poles alone", result.stages.poles), ("refined", result.stages.refined))
    rows = [(name, number(each.rms, 1, 1000)) for name, each in estimates if each is not None]
    return table("Pose estimates", ("estimate", "rms residual, mm"), rows) if rows else ""


def _budget(result: ResultDoc) -> str:
    """List every source of error, the largest first, each with a bar as long as its share."""
    return budget_table(result.budget) + BUDGET_NOTE if result.budget else ""


def budget_table(budget: Sequence[BudgetEntry], whose: bool = True) -> str:
    """List sources of error, the largest first; those of a small share are folded away.

    Parameters
    ----------
    budget
        Sources of error.
    whose
        Whether a column says which LiDAR's each is; in a site its name does.
    """
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    # At least the largest is shown, also of a budget of many equal parts.
    shown = max(1, sum(entry.share_at_30m >= FOLDED_BELOW for entry in entries))
    rest, folded = entries[shown:], ""
    if rest:
        together = percent(sum(entry.share_at_30m for entry in rest))
        folded = (
            f"<details><summary>{len(rest)} smaller, together {together}</summary>"
            f"{_entries('The rest of the error budget', rest, whose)}</details>"
        )
    shown_entries = _entries("Error budget", entries[:shown], whose)
    return f"<h3>What the error is made of</h3>{shown_entries}{folded}"


def _entries(caption: str, entries: Sequence[BudgetEntry], whose: bool) -> str:
    rows = [
        (
            entry.name,
            *([entry.sensor or MISSING] if whose else []),
            error(entry.sigma, entry.unit),
            value(entry.estimated, entry.sigma, entry.unit),
            percent(entry.share_at_30m),
        )
        for entry in entries
    ]
    bars = [(entry.sensor or "both", entry.share_at_30m) for entry in entries]
    lidar = ["LiDAR"] if whose else []
    header = ("source of error", *lidar, "1 σ", "estimated", f"share at {BUDGET_RANGE:g} m")
    return table(caption, header, rows, (1,) if whose else (), bars)


def _matrix(result: ResultDoc, caption: str, matrix: Array) -> str:
    rows = [
        (name, *(f"{entry:.3e}" for entry in row))
        for name, row in zip(result.covariance_order, matrix, strict=True)
    ]
    return table(caption, ("state", *result.covariance_order), rows)
