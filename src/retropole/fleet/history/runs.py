"""The filters of several sites beside each other, and of each what it says the site scatters by."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from ...api import Array, BoolArray, IntArray
from .changes import (
    IS_TREND,
    NONE,
    NOTHING_KNOWN,
    ORDER,
    Changes,
    Passed,
    no_changes,
    passed,
    rebuilt,
    taken,
)
from .events import GATE
from .model import LEVEL, SIZE, Observed, Prediction, State, first_state, predicted, updated

SCALE, SCALE_CHECKS = 1.25, 8.0
"""What a site's random scatter is taken for beside what is stated, in σ, before it has told: and
how many checks that counts as. The site's own surprises then correct it."""

SLOW = {(0.25, 30.0): -1.0, (1.0, 30.0): 0.0, (4.0, 30.0): -1.0, (1.0, 90.0): -1.0}
"""Of what varies slowly the variance beside the random part, and the days in which it forgets; with
the logarithm of how likely each is before a site has told: the site's own checks choose. Without
the last, weather of 40 days made 16 false alarms in 47 site-years, with it one (a law that
tunes)."""

SHARES, TIMES = np.array(list(SLOW)).T

LOST = np.r_[np.full(3, np.radians(2.0)), np.full(3, 0.2)]
"""1 σ of the level, rad and m, after no two of the waiting checks agreed."""


@dataclass(frozen=True, eq=False)
class Runs:
    """The replay of S sites under each law of what varies slowly, R of them beside each other.

    Attributes
    ----------
    likelihood
        (S, R) logarithm of how likely the checks so far are.
    total, weight
        (S, R) and (S,) of the squared scale.
    state
        The filters.
    changes
        What may have begun, as the filter `telling` (S,) of each site sees it.
    """

    likelihood: Array
    total: Array
    weight: Array
    state: State
    changes: Changes
    telling: IntArray

    @property
    def scale(self) -> Array:
        """(S, R) scatter of the sites beside what is stated, in σ."""
        return np.asarray(np.sqrt(self.total / self.weight[:, None]))

    @property
    def best(self) -> IntArray:
        """(S,) the likeliest filters."""
        return np.asarray(self.likelihood.argmax(axis=1), np.int64)

    def of(self, sites: slice) -> Runs:
        """Give those of some sites."""
        state = State(*(values[sites] for values in vars(self.state).values()))
        return Runs(
            self.likelihood[sites],
            self.total[sites],
            self.weight[sites],
            state,
            self.changes.of(sites),
            self.telling[sites],
        )

    def put(self, s: int, one: Runs) -> None:
        """Set those of one site, in place."""
        for name in ("likelihood", "total", "weight", "telling"):
            vars(self)[name][s] = vars(one)[name][0]
        for name, values in vars(self.state).items():
            values[s] = vars(one.state)[name][0]
        self.changes.put(s, one.changes)

    def whole(self) -> Runs:
        """Give the same with all kinds of the state."""
        return replace(self, state=self.state.whole(), changes=self.changes.whole())

    def told(self, ahead: Prediction) -> Runs:
        """Let checks correct scale and likelihood; an outlier counts as the gate."""
        chi2 = np.minimum(ahead.chi2, GATE)
        return replace(
            self,
            total=self.total + self.scale**2 * chi2 / 6.0,
            weight=self.weight + 1.0,
            likelihood=self.likelihood - 0.5 * (chi2 + ahead.log_size),
        )

    def ahead(self, check: Observed) -> Prediction:
        """Predict the checks."""
        return predicted(self.state, check, self.scale, SHARES, TIMES)

    def taken(self, ahead: Prediction, check: Observed, n: int) -> Runs:
        """Take in the checks n, which were predicted."""
        state = updated(self.state, check, ahead)
        through = passed(ahead).of(np.arange(len(self.telling)), self.telling)
        return replace(self, state=state, changes=taken(self.changes, n, state.days, through))


def begin(first: Observed) -> Runs:
    """Begin the replay of sites before their first checks."""
    sites = len(first.step)
    return Runs(
        np.tile(np.array([*SLOW.values()]), (sites, 1)),
        np.full((sites, len(SLOW)), SCALE_CHECKS * SCALE**2),
        np.full(sites, SCALE_CHECKS),
        first_state(first, SHARES),
        no_changes(sites),
        np.zeros(sites, dtype=int),
    )


def beside(runs: Sequence[Runs]) -> Runs:
    """Put runs of one site each beside each other."""
    if any(one.state.mean.shape[-1] == SIZE for one in runs):
        runs = [one.whole() for one in runs]
    each = zip(*(vars(one.state).values() for one in runs), strict=True)
    state = State(*(np.concatenate(values) for values in each))
    changes = no_changes(len(runs), state.mean.shape[-1])
    for s, one in enumerate(runs):
        changes.put(s, one.changes)
    return Runs(
        np.concatenate([one.likelihood for one in runs]),
        np.concatenate([one.total for one in runs]),
        np.concatenate([one.weight for one in runs]),
        state,
        changes,
        np.concatenate([one.telling for one in runs]),
    )


def lost(own: Runs, check: Observed) -> Runs:
    """Start the level of one site anew from a check."""
    P = own.state.covariance.copy()
    P[..., LEVEL, LEVEL] += np.diag(LOST**2)
    anew = replace(own, state=replace(own.state, covariance=P))
    state = updated(anew.state, check, anew.ahead(check))
    return replace(own, state=state, changes=no_changes(1, P.shape[-1]))


class Past(NamedTuple):
    """Checks n of sites that were taken in (S,), and what all of the filters made of them."""

    n: int
    took: BoolArray
    passed: Passed


def first_onset(changes: Changes) -> float:
    """Give the first check with which one of the changes began."""
    return float(np.where(changes.onset == NONE, np.inf, changes.onset).min(initial=np.inf))


Seen = Iterator[tuple[int, Passed]]
"""Numbers of checks of a site, and what some of its filters made of each."""


def seen_by(filters: IntArray, past: Iterable[Past], s: int, first: float) -> Seen:
    """Give what some filters of a site made of the checks that were taken in, from a first on."""
    return ((one.n, one.passed.of(s, filters)) for one in past if one.n >= first and one.took[s])


def as_told_by(
    filter: int, changes: Changes, past: Iterable[Past], s: int, known: tuple[float, Changes] | None
) -> Changes:
    """Give the changes of one site, which is s, as another of its filters sees them.

    `known` are those that this filter saw up to a check, with its number.
    """
    since, start = known or (NONE, no_changes(1, changes.deviation.shape[1]))
    if changes.deviation.shape[1] == SIZE:
        start = start.whole()
    start = replace(start, onset=changes.onset, days=changes.days)
    information, vector = start.information.copy(), start.vector.copy()
    anew = changes.onset[0] > since
    information[:, :, 0, anew], vector[:, 0, anew] = NOTHING_KNOWN[..., None], 0.0
    start = replace(start, information=information, vector=vector)
    first = max(since + 1, first_onset(changes))
    return rebuilt(start, IS_TREND, seen_by(np.array([filter]), past, s, first))


def adopted(own: Runs, m: int, past: Iterable[Past], s: int, newest: Iterable[Past]) -> Runs:
    """Put a change into the state of one site: from now on it is part of what is expected.

    `past` is of all sites, of which it is s, and `newest` of its checks that are not in there.
    """
    if IS_TREND[m]:
        own = own.whole()
    filters, onset = np.arange(own.likelihood.shape[1], dtype=np.int64), own.changes.onset[0, m]
    blank = no_changes(len(filters), own.changes.deviation.shape[1], 1)
    start = replace(blank, onset=np.full((len(filters), 1), onset))
    checks = seen_by(filters, past, s, onset), seen_by(filters, newest, 0, onset)
    seen = rebuilt(start, IS_TREND[m : m + 1], chain(*checks))
    mean, P = own.state.mean.copy(), own.state.covariance.copy()
    for r in filters.tolist():
        size, covariance = seen.size(r, 0)
        D = seen.deviation[r, :, :, 0][:, ORDER]
        mean[0, r] += D @ size
        P[0, r] += D @ covariance @ D.T
    state = replace(own.state, mean=mean, covariance=P)
    return replace(own, state=state, changes=no_changes(1, P.shape[-1]))
