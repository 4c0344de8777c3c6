"""What changed at one site: its checks in the order of time, replayed through the model.

Each check is predicted from those before. One that the prediction excludes waits until another
tells what it was: an *outlier*, where the next fits the prediction again (a lorry stood in view),
or the first of a *step*, where the next agrees with it. Smaller changes show in several checks
together: for every onset within the last year, a step and a trend from there on are held against
no change by their likelihood (window-limited GLR, Willsky and Jones 1976; Lai 1998). A change that
was found becomes part of what is expected, and the watch goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from ...api import Array
from .events import CHANCE, GATE, Event, Watched, from_stored, stays_moved
from .model import (
    LEVEL,
    YEAR,
    Changes,
    Kind,
    Observed,
    State,
    Surprise,
    adopted,
    begin,
    first_state,
    no_changes,
    predicted,
    some,
    updated,
)

THRESHOLDS = 42.0, 18.0
"""Twice the log likelihood ratio from which a step, and a trend, was found: trends of neighbouring
onsets are almost one, so that chance makes less of them. Without a change, trends reached 10.8 in
120 site-years of a Gaussian scatter, 15.9 of one that has all errors, and once 24.9 of a correlated
one; steps of three checks 49 (laws that tune, benchmarks/fleet_history.py). With 13.5 for trends
97 % of those of 1 cm a year were found within it, but laws that are harsher than those that tune
(its seeds 4000 to 4016) made 23 false alarms in 442 site-years."""

QUICK = 55.0
"""The same of a step that two checks show alone. Heavy tails made three pairs in a row that agreed
by chance, of 47 to 53, in some 780 site-years without a change (laws that tune, seeds 100 to 148).
Of 81 steps of 3 cm at sites of 3 mm and more, 76 are beyond by the second check, 78 beyond 45."""

OFTEN = 0.01
"""Share of a site's checks that are off alone from which two in a row are likelier by chance, and
`QUICK` grows: by twice the logarithm of the squared ratio."""

SURE = 80.0
"""The same of a step that is smaller than `LARGE`: it may wait for a third check otherwise."""

LARGE = (slice(0, 3), float(np.radians(0.2))), (slice(3, 6), 0.02)
"""What two checks may tell, rad and m: two thirds of the tolerance of a check."""

WEAKER = 0.3
"""Share of that which the weaker of the two must have by itself: what is fading is no step."""

STEP_WINDOW = 400.0
TREND_WINDOW = 400.0
"""Days back to which a step, and a trend, may have begun: a year and the weeks to see it."""

TREND_SPACING = 20.0
"""Days between onsets of trends that are tried: those of neighbours are hardly told apart."""

MOST_STEPS = 40
"""Checks back to which a step may have happened, however many there are in the window."""

SHORTEST_TREND = 120.0
"""Days a trend must have lasted: over fewer it is no other than a step, unless it is plain."""

QUICK_TREND = 50.0
"""Twice the log likelihood ratio from which a trend of fewer days was found. Without a change 38
made 3 false alarms in 540 site-years, of 35, 44 and no trend at all, and 45 none (laws that tune,
seeds 200 to 229); of a t of 3 with lorries, which no law that tunes has, 45 made one of 50."""

SHOWN, ALREADY = 30.0, 0.2
"""How much of that, and which share, it must have had before the newest check: a lorry after a
check that chance put aside would be one otherwise. With 20 and 0.1 one was, in 68 site-years of a t
of 3 with lorries."""

BEHIND = 20.0
"""By how much less a step may be beyond its threshold than a short trend, and still be told: at
three checks chance makes a trend of a step; of one of 3 cm its χ² was 9 more, and its threshold is
10 less."""

FRESH = 4
"""Checks back from which each may be the onset of a trend, however near they are: at 5 mm a day and
a check a week nothing else says what happens."""

MOST_WAITING = 6
"""Checks that may wait. If no two of as many agree, the place has become another."""

SCALE, SCALE_CHECKS = 1.25, 8.0
"""What a site's random scatter is taken for beside what is stated, in σ, before it has told: and
how many checks that counts as. The site's own surprises then correct it."""

SLOW = {(0.25, 30.0): -1.0, (1.0, 30.0): 0.0, (4.0, 30.0): -1.0, (1.0, 90.0): -1.0}
"""Of what varies slowly the variance beside the random part, and the days in which it forgets; with
the logarithm of how likely each is before a site has told: the site's own checks choose. Without
the last, weather of 40 days made 16 false alarms in 47 site-years, with it one (a law that
tunes)."""

SHARES, TIMES = np.array(list(SLOW)).T

LEAST = (slice(0, 3), float(np.radians(0.05))), (slice(3, 6), 0.005)
"""A smaller change, or trend in a year, of rotation and translation, rad and m, is none: a sixth of
the tolerance of a check, which any mast moves by from season to season."""

KINDS: tuple[Kind, ...] = "step", "trend"

LOST = np.r_[np.full(3, np.radians(2.0)), np.full(3, 0.2)]
"""1 σ of the level, rad and m, after no two of the waiting checks agreed."""


@dataclass(frozen=True, eq=False)
class _Runs:
    """The replay under each law of what varies slowly, R of them beside each other.

    `total` (R,) and `weight` are of the squared scale, `likelihood` (R,) is the logarithm of how
    likely the checks so far are.
    """

    likelihood: Array
    state: State
    changes: Changes
    total: Array
    weight: float = SCALE_CHECKS

    @property
    def scale(self) -> Array:
        return np.asarray(np.sqrt(self.total / self.weight))

    @property
    def best(self) -> int:
        return int(np.argmax(self.likelihood))

    def told(self, surprise: Surprise) -> _Runs:
        """Let a check's surprise correct scale and likelihood; an outlier counts as the gate."""
        chi2 = np.minimum(surprise.chi2, GATE)
        return replace(
            self,
            total=self.total + self.scale**2 * chi2 / 6.0,
            weight=self.weight + 1.0,
            likelihood=self.likelihood - 0.5 * (chi2 + surprise.log_size),
        )


def watch(checks: Sequence[Observed], *, thresholds: tuple[float, float] = THRESHOLDS) -> Watched:
    """Replay the checks of a site and tell what changed.

    Parameters
    ----------
    checks
        Those that gave a step from one stored pose, in the order of time.
    thresholds
        From which a step, and a trend, counts as found.
    """
    if not checks:
        return Watched()
    total = np.full(len(SLOW), SCALE_CHECKS * SCALE**2)
    state = first_state(checks[0], SHARES)
    runs = _Runs(np.array([*SLOW.values()]), state, no_changes(len(SLOW)), total)
    events: list[Event] = []
    waiting: dict[int, float] = {}
    for n, check in enumerate(checks):
        ahead = _ahead(runs, check, n)
        taken, surprise = _taken(ahead, check)
        off = float(surprise.chi2[runs.best])
        singles = sum(event.kind == "outlier" for event in events)
        needed = *thresholds, _quick(singles, n), _quick(singles, n) + QUICK_TREND - QUICK
        branch = None
        if off <= GATE and not waiting:
            runs = taken.told(surprise)
            branch = _found(runs, ahead, (n,), n - 1, needed)
        else:
            branch = _confirmed(runs, checks, {**waiting, n: off}, needed)
        if branch is not None:
            # The others that waited agree with nothing.
            events += [Event("outlier", k, n) for k in waiting if k not in branch.numbers]
            begun = branch.event.onset == 1 and from_stored(check) < from_stored(checks[0])
            # The first check alone stands against the stored pose and all others.
            events.append(Event("outlier", 0, n) if begun else branch.event)
            # It is part of what is expected from now on.
            state = adopted(branch.runs.state, branch.runs.changes, branch.change)
            runs, waiting = replace(branch.runs, state=state, changes=no_changes(len(SLOW))), {}
        elif off <= GATE and waiting:
            # The filter has not taken them in: they are left out for good.
            events += [Event("outlier", k, n) for k in waiting]
            runs, waiting = taken.told(surprise), {}
        elif off > GATE:
            waiting[n] = off
            runs = runs.told(surprise)
            if len(waiting) > MOST_WAITING:
                events.append(Event("unsettled", min(waiting), n))
                runs, waiting = _lost(ahead, check), {}
        if stays_moved(checks[max(n - 2, 0) : n + 1]) and not Watched((*events,)).alarms:
            size = check.random + check.common
            events.append(Event("moved", n - 1, n, check.step, size, from_stored(check)))
    best, state = runs.best, runs.state
    state = replace(state, mean=state.mean[best], covariance=state.covariance[best])
    return Watched(tuple(events), tuple(waiting), float(runs.scale[best]), state)


def _ahead(runs: _Runs, check: Observed, n: int) -> _Runs:
    """Predict a check; changes may begin with it."""
    state, changes = predicted(runs.state, runs.changes, check, runs.scale, SHARES, TIMES)
    age = check.days - changes.days
    recent = (age <= STEP_WINDOW) & (changes.onset > n - MOST_STEPS)
    # Of the older trends the first of each so many days.
    first = np.zeros(len(age), dtype=bool)
    spans = changes.days // TREND_SPACING + np.where(changes.is_trend, 0.0, -np.inf)
    first[np.unique(spans, return_index=True)[1]] = True
    trying = (age <= TREND_WINDOW) & (first | (changes.onset >= n - FRESH))
    changes = some(changes, np.where(changes.is_trend, trying, recent))
    return replace(runs, state=state, changes=begin(changes, n, check.days, kinds=KINDS))


def _taken(ahead: _Runs, check: Observed) -> tuple[_Runs, Surprise]:
    """Take a check in that was predicted."""
    state, changes, surprise = updated(ahead.state, ahead.changes, check, ahead.scale)
    return replace(ahead, state=state, changes=changes), surprise


@dataclass(frozen=True, eq=False)
class _Branch:
    """Runs that have taken in some checks, the number of the change that explains them, and it."""

    runs: _Runs
    numbers: tuple[int, ...]
    change: int
    event: Event


def _quick(singles: int, n: int) -> float:
    """Give what two checks need, of a site where so many of n were off alone."""
    share = (singles + 0.5) / (n + 50.0)
    return QUICK + 4.0 * float(np.log(max(share / OFTEN, 1.0)))


def _confirmed(
    runs: _Runs,
    checks: Sequence[Observed],
    off: Mapping[int, float],
    needed: tuple[float, ...],
) -> _Branch | None:
    """Find the change by which the newest check, with those that wait or without, is no surprise.

    `off` is the χ² of each against what was expected, the newest last.
    """
    *waiting, n = off
    likely: list[_Branch] = []
    whole = [(*waiting, n)] if len(waiting) > 1 else []
    for numbers in ((n,), *((k, n) for k in waiting), *whole):
        before, after, surprises = _with_all(runs, checks, numbers)
        alone = numbers[-2] if len(numbers) > 1 else n - 1
        branch = _found(after, before, numbers, alone, needed)
        if branch is None or not _explains(runs.changes.of(runs.best), branch.event, surprises):
            continue
        fading = min(off[k] for k in numbers) <= WEAKER * branch.event.statistic
        if branch.event.onset != alone or not fading:
            likely.append(branch)
    return max(likely, key=lambda one: one.event.statistic, default=None)


def _with_all(
    runs: _Runs, checks: Sequence[Observed], numbers: Sequence[int]
) -> tuple[_Runs, _Runs, list[float]]:
    """Take checks in as if none were off; gives what was before the last, and the χ² of each."""
    surprises, best = [], runs.best
    for k in numbers:
        before = _ahead(runs, checks[k], k)
        runs, surprise = _taken(before, checks[k])
        surprises.append(float(surprise.chi2[best]))
    return before, runs, surprises


def _explains(before: Changes, event: Event, surprises: Sequence[float]) -> bool:
    """Tell whether under a change the checks that were taken in are no surprise."""
    same = (before.onset == event.onset) & (before.is_trend == (event.kind == "trend"))
    # What the change explained before these checks is none of their surprise.
    left = sum(surprises) - (event.statistic - float(before.statistics()[same].sum()))
    freedom = 6 * len(surprises) - (0 if same.any() else 6)
    return bool(left <= chdtri(freedom, CHANCE))


def _found(
    runs: _Runs, before: _Runs, numbers: tuple[int, ...], alone: int, needed: tuple[float, ...]
) -> _Branch | None:
    """Find the likeliest change that matters, of those that two checks show, and days enough.

    The last of the checks `numbers` is the newest, `before` what was known before it. A step that
    begins with the check `alone` is shown by two. `needed` is of a step, of a trend, of a step that
    two show, and of a short trend.
    """
    n, changes = numbers[-1], runs.changes.of(runs.best)
    least = np.where(changes.is_trend, needed[1], needed[0])
    two = ~changes.is_trend & (changes.onset >= alone)
    least = np.where(two, np.maximum(least, needed[2]), least)
    days = runs.state.days - changes.days
    short = changes.is_trend & (days < SHORTEST_TREND)
    least = np.where(short, np.maximum(least, needed[3]), least)
    statistics = np.where(changes.onset < n, changes.statistics(), 0.0)
    if (short & (statistics > least)).any():
        # Before the newest check it showed already: no single one that is off makes a trend.
        earlier = before.changes.of(runs.best)
        of_trends = earlier.statistics()[earlier.is_trend]
        shown = dict(zip(earlier.onset[earlier.is_trend], of_trends, strict=True))
        had = np.array([shown.get(onset, 0.0) for onset in changes.onset])
        statistics[short & (had < np.maximum(SHOWN, ALREADY * statistics))] = 0.0
    beyond = statistics - least
    for m in np.argsort(BEHIND * short - beyond, kind="stable").tolist():
        if beyond[m] <= 0.0:
            continue
        size, covariance = changes.size(m)
        # What a short trend has moved by so far, and what a long one moves by in a year.
        so_far = size * (days[m] / YEAR) if short[m] else size
        quick = (two[m] or short[m]) and statistics[m] <= SURE
        if any(np.linalg.norm(so_far[part]) >= one for part, one in (LARGE if quick else LEAST)):
            kind: Literal["step", "trend"] = "trend" if changes.is_trend[m] else "step"
            others = statistics[changes.is_trend != changes.is_trend[m]]
            lead = float(statistics[m] - others.max(initial=0.0))
            onset, statistic = int(changes.onset[m]), float(statistics[m])
            event = Event(kind, onset, n, size, covariance, statistic, lead)
            return _Branch(runs, numbers, m, event)
    return None


def _lost(ahead: _Runs, check: Observed) -> _Runs:
    """Start the level anew from a check."""
    P = ahead.state.covariance.copy()
    P[..., LEVEL, LEVEL] += np.diag(LOST**2)
    state = replace(ahead.state, covariance=P)
    return _taken(replace(ahead, state=state, changes=no_changes(len(SLOW))), check)[0]
