"""What is found in the checks of a site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from ...api import Array
from .model import LEVEL_FACTOR, Observed

CLEAR = 6.0
"""Difference of twice the log likelihoods from which a step and a trend are told apart (ln 20)."""

CHANCE = 0.001
"""How often chance alone makes a check wait for another."""

GATE = float(chdtri(6, CHANCE))
"""χ²(6) beyond which a check waits."""

EventKind = Literal["step", "trend", "outlier", "unsettled", "moved"]


@dataclass(frozen=True, eq=False)
class Event:
    """What was found in the checks of a site.

    Attributes
    ----------
    kind
        ``step``: the level changed; ``trend``: it changes steadily; ``outlier``: one check is off,
        and the next is not; ``unsettled``: checks are off, and no two agree; ``moved``: two
        checks in a row, or three, say by themselves that the site is not where it was.
    onset
        Number of the first check that shows it.
    found
        Number of the check that told.
    size
        (6,) of a step, rad and m, or of a trend, per year; of *moved*, the newest check's step from
        the stored pose; None of others.
    covariance
        (6, 6) of it.
    statistic
        Twice the log likelihood ratio against no change; of an outlier, or *moved*, its χ².
    lead
        By how much that is more than of the other kind of change.
    """

    kind: EventKind
    onset: int
    found: int
    size: Array | None = None
    covariance: Array | None = None
    statistic: float = 0.0
    lead: float = np.inf

    @property
    def is_clear(self) -> bool:
        """Whether a step and a trend are told apart."""
        return self.lead >= CLEAR


@dataclass(frozen=True, eq=False)
class Expected:
    """What the likeliest filter of a site expects: mean (36,) and covariance (36, 36) of its state.

    `days` is the time of the newest check that it took in; `knows_other` whether one was found the
    other way.
    """

    mean: Array
    covariance: Array
    days: float
    knows_other: bool


@dataclass(frozen=True, eq=False)
class Watched:
    """What the checks of a site say so far.

    Attributes
    ----------
    events
        In the order in which they were found.
    waiting
        Numbers of the checks that are off and wait for another: not confirmed.
    scale
        Scatter of the site beside what is stated, in σ.
    state
        What is expected of the next check; None before the first.
    """

    events: tuple[Event, ...] = ()
    waiting: tuple[int, ...] = ()
    scale: float = 1.0
    state: Expected | None = None

    @property
    def alarms(self) -> tuple[Event, ...]:
        """The events that somebody should look at: any but a single check that is off."""
        return tuple(event for event in self.events if event.kind != "outlier")


def from_stored(check: Observed) -> float:
    """χ²(6) of a check against the stored pose, whose error may be wider than stated."""
    size = check.random + LEVEL_FACTOR**2 * check.common
    return float(check.step @ np.linalg.solve(size, check.step))


def stays_moved(newest: Sequence[Observed]) -> bool:
    """Whether the newest two checks say that the site moved, on the same side; or all three."""
    moved = [one.moved and from_stored(one) > GATE for one in newest]
    if len(newest) < 2 or not all(moved[-2:]):
        return False
    before, last = newest[-2:]
    apart = replace(last, step=last.step - before.step)
    return from_stored(apart) <= from_stored(last) or (len(moved) > 2 and all(moved))
