"""How probable it is that a line is a pole, by its shape and its surroundings.

The log-odds are linear in a few measures, with weights that a logistic regression gives.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array
from .lines import LITTLE, MOST, SEARCH_ROOM, TUBE, WIDTH_IN_RMS
from .surroundings import PIECES, SHORT_LENGTH, Surroundings, cluttered_share, is_wall_behind

WEIGHTS = 2.9, 2.2, -4.3, -4.1, -1.3, -4.9, -14.2, -3.5
"""Of `measures_of`, by benchmarks/odds.py, seeds 0 to 9: 12,417 lines on 140 poles and on 857 other
things. Log-odds of 0 or more have 98 % of the poles and 10 % of the others."""


def log_odds(around: Surroundings, radius: float) -> float:
    """Log-odds that a line is a pole of a radius, metres, and no other bright thing."""
    return float(measures_of(around, radius) @ WEIGHTS)


def measures_of(around: Surroundings, radius: float) -> Array:
    """What speaks for and against a line in its surroundings.

    Returns
    -------
    Array
        (8,) one; the logarithms of its length over its width, and of the number of bright returns
        close to it for each on the line, as multiples of `LITTLE`; the share of its length along
        which bright ones are near it at all, along which others are close, and along which others
        are near it that are not on a wall behind it; and the share of `SHORT_LENGTH` along which it
        goes on without tape beyond the end where it does less, and beyond the other.
    """
    line = around.line
    bright = around.is_retro & around.nearby
    close = ~around.on_line & (around.distance < radius + TUBE + SEARCH_ROOM)
    goes_on = _goes_on(around)
    others = around.nearby & ~around.is_retro
    in_surface = cluttered_share(line, around.along[others], MOST)
    if in_surface:
        nearby, own = (around.cloud.xyz[index] for index in (around.near[others], line.index))
        in_surface *= not is_wall_behind(nearby, own)
    return np.array(
        [
            1.0,
            np.log(line.length / max(line.width - WIDTH_IN_RMS * line.thicker, SEARCH_ROOM / 2)),
            np.log1p(np.count_nonzero(bright & close) / (LITTLE * len(line.index))),
            cluttered_share(line, around.along[bright], LITTLE),
            cluttered_share(line, around.along[close & ~around.is_retro], MOST),
            in_surface,
            min(goes_on),
            max(goes_on),
        ]
    )


def _goes_on(around: Surroundings) -> list[float]:
    """Share of the pieces of `SHORT_LENGTH` beyond either end in which there are dim returns."""
    line = around.line
    dim = around.along[around.untaped & around.on_line]
    pieces = max(min(PIECES, SHORT_LENGTH / max(line.step, 1e-9)), 1.0)
    counts = (
        np.histogram(beyond, PIECES, (0.0, SHORT_LENGTH))[0]
        for beyond in (dim - line.high, line.low - dim)
    )
    return [min(np.count_nonzero(each) / pieces, 1.0) for each in counts]
