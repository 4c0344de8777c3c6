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
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from ...datatypes import Array
from .events import Event, Watched
from .model import (
    LEVEL,
    Changes,
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

CHANCE = 0.001
"""How often chance alone makes a check wait for another."""

GATE = float(chdtri(6, CHANCE))
"""χ²(6) beyond which a check waits."""

THRESHOLDS = 36.0, 21.0
"""Twice the log likelihood ratio from which a step, and a trend, was found: trends of neighbouring
onsets are almost one, so that chance makes less of them."""

QUICK = 45.0
"""The same of a step that two checks show alone: heavy tails make two that are off by chance."""

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
"""Days a trend must have lasted: over fewer it is no other than a step."""

MOST_WAITING = 6
"""Checks that may wait. If no two of as many agree, the place has become another."""

SCALE, SCALE_CHECKS = 1.25, 8.0
"""What a site's random scatter is taken for beside what is stated, in σ, before it has told: and
how many checks that counts as. The site's own surprises then correct it."""

SHARES = {0.25: -1.0, 1.0: 0.0, 4.0: -1.0}
"""Variances of what varies slowly beside the random part, and the logarithm of how likely each is
before a site has told: the site's own checks choose."""

LEAST = (slice(0, 3), float(np.radians(0.05))), (slice(3, 6), 0.005)
"""A smaller change, or trend in a year, of rotation and translation, rad and m, is none: a sixth of
the tolerance of a check, which any mast moves by from season to season."""

LOST = np.r_[np.full(3, np.radians(2.0)), np.full(3, 0.2)]
"""1 σ of the level, rad and m, after no two of the waiting checks agreed."""


@dataclass(frozen=True, eq=False)
class _Run:
    """The replay under one share of what varies slowly.

    `total` and `weight` are of the squared scale, `likelihood` is the logarithm of how likely the
    checks so far are.
    """

    share: float
    likelihood: float
    state: State
    changes: Changes = field(default_factory=no_changes)
    total: float = SCALE_CHECKS * SCALE**2
    weight: float = SCALE_CHECKS

    @property
    def scale(self) -> float:
        return float(np.sqrt(self.total / self.weight))

    def told(self, surprise: Surprise) -> _Run:
        """Let a check's surprise correct scale and likelihood; an outlier counts as the gate."""
        chi2 = min(surprise.chi2, GATE)
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
    runs = [_Run(*of, first_state(checks[0], of[0])) for of in SHARES.items()]
    events: list[Event] = []
    waiting: dict[int, float] = {}
    for n, check in enumerate(checks):
        ahead = [_ahead(run, check, n) for run in runs]
        taken = [_taken(run, check) for run in ahead]
        best = int(np.argmax([run.likelihood for run in runs]))
        fits = taken[best][1].chi2 <= GATE
        branch = None
        if fits and not waiting:
            runs = [run.told(surprise) for run, surprise in taken]
            best = int(np.argmax([run.likelihood for run in runs]))
            change = _found(runs[best], n, thresholds)
            branch = None if change is None else _Branch(runs, (n,), change)
        else:
            branch = _confirmed(runs, best, checks, {**waiting, n: taken[best][1].chi2}, thresholds)
        if branch is not None:
            # The others that waited agree with nothing.
            events += [Event("outlier", k, n) for k in waiting if k not in branch.numbers]
            events.append(_event(branch.runs[best], branch.change, n))
            runs = [_adopted(run, branch.change) for run in branch.runs]
            waiting = {}
        elif fits and waiting:
            # The filter has not taken them in: they are left out for good.
            events += [Event("outlier", k, n) for k in waiting]
            runs, waiting = [run.told(surprise) for run, surprise in taken], {}
        elif not fits:
            waiting[n] = taken[best][1].chi2
            runs = [run.told(own[1]) for run, own in zip(runs, taken, strict=True)]
            if len(waiting) > MOST_WAITING:
                events.append(Event("unsettled", min(waiting), n))
                runs, waiting = [_lost(run, check) for run in ahead], {}
    best = int(np.argmax([run.likelihood for run in runs]))
    return Watched(tuple(events), tuple(waiting), runs[best].scale, runs[best].state)


def _ahead(run: _Run, check: Observed, n: int) -> _Run:
    """Predict a check; changes may begin with it."""
    state, changes = predicted(run.state, run.changes, check, run.scale, run.share)
    age = check.days - changes.days
    recent = (age <= STEP_WINDOW) & (changes.onset > n - MOST_STEPS)
    changes = some(changes, np.where(changes.is_trend, age <= TREND_WINDOW, recent))
    trends = changes.days[changes.is_trend]
    also_trend = not len(trends) or check.days - trends.max() >= TREND_SPACING
    kinds: tuple[Literal["step", "trend"], ...] = ("step", "trend") if also_trend else ("step",)
    return replace(run, state=state, changes=begin(changes, n, check.days, kinds=kinds))


def _taken(ahead: _Run, check: Observed) -> tuple[_Run, Surprise]:
    """Take a check in that was predicted."""
    state, changes, surprise = updated(ahead.state, ahead.changes, check, ahead.scale)
    return replace(ahead, state=state, changes=changes), surprise


@dataclass(frozen=True, eq=False)
class _Branch:
    """Runs that have taken in some checks, and the number of the change that explains them."""

    runs: list[_Run]
    numbers: tuple[int, ...]
    change: int


def _confirmed(
    runs: Sequence[_Run],
    best: int,
    checks: Sequence[Observed],
    off: Mapping[int, float],
    thresholds: tuple[float, float],
) -> _Branch | None:
    """Find the change by which the newest check, with one that waits or without, is no surprise.

    `off` is the χ² of each against what was expected, the newest last.
    """
    *waiting, n = off
    likely: list[tuple[float, _Branch]] = []
    for numbers in ((n,), *((k, n) for k in waiting)):
        after, surprises = _with_all(runs[best], checks, numbers)
        change = _found(after, n, thresholds)
        if change is None or not _explains(runs[best], after, change, surprises):
            continue
        statistic = float(after.changes.statistics()[change])
        if after.changes.onset[change] == numbers[0] and (
            statistic <= QUICK or min(off[k] for k in numbers) <= WEAKER * statistic
        ):
            continue
        branches = [_with_all(run, checks, numbers)[0] for run in runs]
        likely.append((statistic, _Branch(branches, numbers, change)))
    return max(likely, key=lambda one: one[0], default=(0.0, None))[1]


def _with_all(
    run: _Run, checks: Sequence[Observed], numbers: Sequence[int]
) -> tuple[_Run, list[float]]:
    """Take checks in as if none were off; gives the χ² of each too."""
    surprises = []
    for k in numbers:
        run, surprise = _taken(_ahead(run, checks[k], k), checks[k])
        surprises.append(surprise.chi2)
    return run, surprises


def _explains(before: _Run, after: _Run, m: int, surprises: Sequence[float]) -> bool:
    """Tell whether under a change the checks that were taken in are no surprise."""
    old, new = before.changes, after.changes
    same = (old.onset == new.onset[m]) & (old.is_trend == new.is_trend[m])
    # What the change explained before these checks is none of their surprise.
    known = float(old.statistics()[same].sum())
    left = sum(surprises) - (float(new.statistics()[m]) - known)
    freedom = 6 * len(surprises) - (0 if same.any() else 6)
    return bool(left <= chdtri(freedom, CHANCE))


def _statistics(run: _Run, n: int) -> Array:
    """Likelihood ratio of each change that at least two checks show, and days enough."""
    changes = run.changes
    long = ~changes.is_trend | (run.state.days - changes.days >= SHORTEST_TREND)
    shown = (n - changes.onset >= 1) & long
    return np.where(shown, changes.statistics(), 0.0)


def _found(run: _Run, n: int, thresholds: tuple[float, float]) -> int | None:
    """Give the number of the likeliest change that matters, where one was found."""
    changes = run.changes
    needed = np.where(changes.is_trend, thresholds[1], thresholds[0])
    two = ~changes.is_trend & (changes.onset == n - 1)
    needed = np.where(two, np.maximum(needed, QUICK), needed)
    beyond = _statistics(run, n) - needed
    for m in np.argsort(-beyond, kind="stable"):
        if beyond[m] <= 0.0:
            return None
        size, _ = changes.size(int(m))
        if any(np.linalg.norm(size[part]) >= least for part, least in LEAST):
            return int(m)
    return None


def _event(run: _Run, m: int, n: int) -> Event:
    changes, statistics = run.changes, _statistics(run, n)
    is_trend = bool(changes.is_trend[m])
    others = statistics[changes.is_trend != is_trend]
    return Event(
        "trend" if is_trend else "step",
        int(changes.onset[m]),
        n,
        *changes.size(m),
        float(statistics[m]),
        float(statistics[m] - others.max(initial=0.0)),
    )


def _adopted(run: _Run, m: int) -> _Run:
    """Make a change part of what is expected."""
    return replace(run, state=adopted(run.state, run.changes, m), changes=no_changes())


def _lost(ahead: _Run, check: Observed) -> _Run:
    """Start the level anew from a check."""
    P = ahead.state.covariance.copy()
    P[LEVEL, LEVEL] += np.diag(LOST**2)
    state = replace(ahead.state, covariance=P)
    return _taken(replace(ahead, state=state, changes=no_changes()), check)[0]
