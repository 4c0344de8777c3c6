"""What the newest checks of a site are taken for: a change that is found, or one that waits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc, chdtri

from ...api import Array, BoolArray
from .changes import IS_TREND, NONE, Changes, passed
from .events import CHANCE, Event
from .model import YEAR, Observed
from .runs import Past, Runs

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

LEAST = (slice(0, 3), float(np.radians(0.05))), (slice(3, 6), 0.005)
"""A smaller change, or trend in a year, of rotation and translation, rad and m, is none: a sixth of
the tolerance of a check, which any mast moves by from season to season."""


Needed = tuple[float, float, Array, Array]
"""Twice the log likelihood ratio from which a step, a trend, a step that two checks show, and a
short trend count as found; the last two (S,)."""


def needed(thresholds: tuple[float, float], singles: Array, n: int) -> Needed:
    """Give what is needed, of sites where so many (S,) of n checks were off alone."""
    share = (singles + 0.5) / (n + 50.0)
    quick = QUICK + 4.0 * np.log(np.maximum(share / OFTEN, 1.0))
    return *thresholds, quick, quick + QUICK_TREND - QUICK


def _least(
    changes: Changes, days: Array, alone: int, needed: Needed
) -> tuple[Array, BoolArray, BoolArray]:
    """(S, M) from which each change was found; whether two checks show it, and few days.

    A step that begins with the check `alone` is shown by two; `days` (S,) are the newest.
    """
    step, trend, quick, soon = needed
    two = ~IS_TREND & (changes.onset >= alone)
    short = IS_TREND & (days[:, None] - changes.days < SHORTEST_TREND)
    least = np.where(IS_TREND, trend, step)
    least = np.where(two, np.maximum(least, quick[:, None]), least)
    return np.where(short, np.maximum(least, soon[:, None]), least), two, short


def may_be_found(changes: Changes, days: Array, n: int, needed: Needed) -> BoolArray:
    """(S,) whether the checks n may tell a change: of most sites they do not."""
    both, alone = changes.ratios()
    least, _, short = _least(changes, days, n - 1, needed)
    # A χ² of three degrees of freedom counts by how rare it is.
    soon, late = chdtri(3, chdtrc(6, [max(needed[1], QUICK_TREND), needed[1]]))
    beyond = (both > ROUNDED * least) | (IS_TREND & (alone > ROUNDED * np.where(short, soon, late)))
    return np.asarray((beyond & (changes.onset != NONE) & (changes.onset < n)).any(axis=1))


ROUNDED = 1.0 - 1e-9
"""Share of a threshold from which it is looked at twice."""


@dataclass(frozen=True, eq=False)
class Branch:
    """Runs of one site that have taken in some checks, the change that explains them, and it.

    Attributes
    ----------
    runs
        With the checks taken in.
    taken
        What the filters made of these.
    change
        Slot of the change.
    """

    runs: Runs
    taken: tuple[Past, ...]
    change: int
    event: Event

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of the checks that were taken in."""
        return tuple(one.n for one in self.taken)


@dataclass(frozen=True, eq=False)
class With:
    """Runs of one site that took some checks in.

    Attributes
    ----------
    before
        The changes before the last of these.
    runs
        After it.
    taken
        What the filters made of the checks.
    surprise
        Sum of their χ².
    """

    before: Changes
    runs: Runs
    taken: tuple[Past, ...]
    surprise: float


def confirmed(
    runs: Runs, newest: With | None, checks: Observed, off: Mapping[int, float], needed: Needed
) -> Branch | None:
    """Find the change by which the newest check, with those that wait or without, is no surprise.

    `runs` are of one site, `newest` the same with the newest check where that alone may tell a
    change, `checks` all of the site, and `off` is the χ² of each that is off or new against what
    was expected, the newest last.
    """
    *waiting, n = off
    likely: list[Branch] = []
    whole = [(*waiting, n)] if len(waiting) > 1 else []
    tried = [] if newest is None else [(newest, n - 1)]
    several = (*((k, n) for k in waiting), *whole)
    for all_in, alone in (*tried, *((_with_all(runs, checks, each), each[-2]) for each in several)):
        branch = found(all_in, alone, needed)
        if branch is None or not _explains(runs.changes, branch, all_in):
            continue
        fading = min(off[one.n] for one in all_in.taken) <= WEAKER * branch.event.statistic
        if branch.event.onset != alone or not fading:
            likely.append(branch)
    return max(likely, key=lambda one: one.event.statistic, default=None)


def _with_all(runs: Runs, checks: Observed, numbers: Sequence[int]) -> With:
    """Take checks in as if none were off."""
    taken, surprise = [], 0.0
    for k in numbers:
        check, before = checks[k : k + 1], runs.changes
        ahead = runs.ahead(check)
        runs = runs.taken(ahead, check, k)
        taken.append(Past(k, np.ones(1, dtype=bool), passed(ahead)))
        surprise += float(ahead.chi2[0, runs.telling[0]])
    return With(before, runs, tuple(taken), surprise)


def _explains(before: Changes, branch: Branch, all_in: With) -> bool:
    """Tell whether under a change the checks that were taken in are no surprise."""
    event, m = branch.event, branch.change
    same = bool(before.onset[0, m] == event.onset)
    # What the change explained before these checks is none of their surprise.
    already = float(before.statistics()[0, m]) if same else 0.0
    left = all_in.surprise - (event.statistic - already)
    freedom = 6 * len(all_in.taken) - (0 if same else 6)
    return bool(left <= chdtri(freedom, CHANCE))


def found(all_in: With, alone: int, needed: Needed) -> Branch | None:
    """Find the likeliest change that matters, of those that two checks show, and days enough.

    A step that begins with the check `alone` is shown by two.
    """
    n, runs, before = all_in.taken[-1].n, all_in.runs, all_in.before
    changes, onset = runs.changes, runs.changes.onset[0]
    least, two, short = (each[0] for each in _least(changes, runs.state.days, alone, needed))
    statistics = np.where(onset < n, changes.statistics()[0], 0.0)
    if (short & (statistics > least)).any():
        # Before the newest check it showed already: no single one that is off makes a trend.
        had = np.where(before.onset[0] == onset, before.statistics()[0], 0.0)
        statistics[short & (had < np.maximum(SHOWN, ALREADY * statistics))] = 0.0
    beyond = statistics - least
    likeliest = np.argsort(BEHIND * short - beyond, kind="stable")
    for m in likeliest[beyond[likeliest] > 0.0].tolist():
        size, covariance = changes.size(0, m)
        # What a short trend has moved by so far, and what a long one moves by in a year.
        lasted = float(runs.state.days[0] - changes.days[0, m]) / YEAR
        so_far = size * lasted if short[m] else size
        quick = (two[m] or short[m]) and statistics[m] <= SURE
        if any(np.linalg.norm(so_far[part]) >= one for part, one in (LARGE if quick else LEAST)):
            kind: Literal["step", "trend"] = "trend" if IS_TREND[m] else "step"
            others = statistics[IS_TREND[m] != IS_TREND]
            lead = float(statistics[m] - others.max(initial=0.0))
            event = Event(kind, int(onset[m]), n, size, covariance, float(statistics[m]), lead)
            return Branch(runs, all_in.taken, m, event)
    return None
