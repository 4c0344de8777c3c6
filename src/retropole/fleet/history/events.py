"""What is found in the checks of a site."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...api import Array
from .model import State

CLEAR = 6.0
"""Difference of twice the log likelihoods from which a step and a trend are told apart (ln 20)."""

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
    state: State | None = None

    @property
    def alarms(self) -> tuple[Event, ...]:
        """The events that somebody should look at: any but a single check that is off."""
        return tuple(event for event in self.events if event.kind != "outlier")
