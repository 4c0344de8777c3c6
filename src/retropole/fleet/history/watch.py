"""What changed at one site: its checks in the order of time, replayed through the model.

Each check is predicted from those before. One that the prediction excludes waits until another
tells what it was: an *outlier*, where the next fits the prediction again (a lorry stood in view),
or the first of a *step*, where the next agrees with it. Smaller changes show in several checks
together: for every onset within the last year, a step and a trend from there on are held against
no change by their likelihood (window-limited GLR, Willsky and Jones 1976; Lai 1998). A change that
was found becomes part of what is expected, and the watch goes on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .changes import Changes, passed
from .events import GATE, Event, Expected, Watched, from_stored, stays_moved
from .model import Observed, together
from .runs import Past, Runs, adopted, as_told_by, begin, beside, first_onset, lost
from .search import THRESHOLDS, Branch, With, confirmed, found, may_be_found, needed

MOST_WAITING = 6
"""Checks that may wait. If no two of as many agree, the place has become another."""


@dataclass(frozen=True, eq=False)
class Stand:
    """Where the replay of a site stands after so many checks.

    Attributes
    ----------
    runs
        Of this one site.
    waiting
        χ² of the checks that wait, by their numbers.
    """

    count: int
    runs: Runs
    events: tuple[Event, ...]
    waiting: Mapping[int, float]


@dataclass(eq=False)
class _Told:
    """What is told of a site so far.

    Attributes
    ----------
    waiting
        χ² of the checks that wait, by their numbers.
    known
        Of filters that told, the changes as they saw them up to a check, with its number.
    is_torn
        Whether what its filters made of checks is needed that are not replayed.
    """

    checks: Observed
    events: list[Event] = field(default_factory=list)
    waiting: dict[int, float] = field(default_factory=dict)
    known: dict[int, tuple[float, Changes]] = field(default_factory=dict)
    is_torn: bool = False

    @property
    def singles(self) -> int:
        return sum(event.kind == "outlier" for event in self.events)

    def tell(self, branch: Branch, n: int) -> None:
        """Tell the change that explains the check n, and those that wait with it."""
        # The others that waited agree with nothing.
        self.are_outliers([k for k in self.waiting if k not in branch.numbers], n)
        first, newest = self.checks[0], self.checks[n]
        begun = branch.event.onset == 1 and from_stored(newest) < from_stored(first)
        # The first check alone stands against the stored pose and all others.
        self.events.append(Event("outlier", 0, n) if begun else branch.event)

    def are_outliers(self, numbers: Iterable[int], n: int) -> None:
        """Tell of checks that waited, by the check n, that they are off alone; none waits."""
        self.events += [Event("outlier", k, n) for k in numbers]
        self.waiting = {}

    def waits(self, n: int, off: float) -> bool:
        """Let the check n wait; gives whether it can, or too many do already."""
        self.waiting[n] = off
        if len(self.waiting) <= MOST_WAITING:
            return True
        self.events.append(Event("unsettled", min(self.waiting), n))
        self.waiting = {}
        return False

    def may_have_moved(self, n: int) -> None:
        """Tell whether checks up to n say by themselves that the site moved, where nothing does."""
        newest = [self.checks[k] for k in range(max(n - 2, 0), n + 1)]
        if stays_moved(newest) and not Watched((*self.events,)).alarms:
            check = newest[-1]
            size = check.random + check.common
            self.events.append(Event("moved", n - 1, n, check.step, size, from_stored(check)))


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
    return watch_all([together(checks)], thresholds=thresholds)[0]


def watch_all(
    sites: Sequence[Observed], *, thresholds: tuple[float, float] = THRESHOLDS
) -> list[Watched]:
    """Replay the checks of several sites, each as `watch` does.

    The n-th checks of all are taken in beside each other: most tell nothing, and cost little.

    Parameters
    ----------
    sites
        Of each all checks in one, their number in front: one check at least.
    """
    ends = watch_from(sites, [None] * len(sites), thresholds=thresholds)
    return [watched for watched, _ in ends]


def watch_from(
    sites: Sequence[Observed],
    stands: Sequence[Stand | None],
    *,
    thresholds: tuple[float, float] = THRESHOLDS,
) -> list[tuple[Watched, Stand]]:
    """Replay the checks of several sites from where each stood, or from the first.

    What is said is the same as from the first, and so is where they stand then. Where the checks
    before are needed again, as another filter comes to tell or a change began there, it is replayed
    from the first.
    """
    ends: dict[int, tuple[Watched, Stand]] = {}
    first = [0 if stand is None else stand.count for stand in stands]
    # From the first check last: what is torn is replayed with these.
    for count in sorted({0, *first}, reverse=True):
        some = [s for s in range(len(sites)) if s not in ends and first[s] == count]
        known = [stand for s in some if count and (stand := stands[s]) is not None]
        said = _replayed([sites[s] for s in some], known, thresholds)
        ends.update((s, end) for s, end in zip(some, said, strict=True) if end is not None)
        first = [0 if s in some else first[s] for s in range(len(sites))]
    return [ends[s] for s in range(len(sites))]


def _replayed(
    sites: Sequence[Observed], stands: Sequence[Stand], thresholds: tuple[float, float]
) -> list[tuple[Watched, Stand] | None]:
    """Replay sites from the same number of checks on; None of those that are torn."""
    if not sites:
        return []
    counts = np.array([len(checks.step) for checks in sites])
    order = np.argsort(-counts, kind="stable").tolist()
    told = [_Told(sites[s]) for s in order]
    checks = _beside([sites[s] for s in order])
    said: list[tuple[Watched, Stand] | None] = []
    past: deque[Past] = deque()
    first = 0
    if stands:
        runs, first = beside([stands[s].runs for s in order]), stands[0].count
        for one, s in zip(told, order, strict=True):
            one.events, one.waiting = [*stands[s].events], {**stands[s].waiting}
    else:
        runs = begin(checks[0])
    for n in range(first, counts.max()):
        under_way = int((counts > n).sum())
        if under_way < len(told):
            said = [*_said(runs, told, under_way), *said]
            runs, told = runs.of(slice(under_way)), told[:under_way]
        runs = _advanced(runs, told, checks[n][:under_way], past, (first, n), thresholds)
    said = [*_said(runs, told, 0), *said]
    return [said[order.index(s)] for s in range(len(sites))]


def _beside(sites: Sequence[Observed]) -> Observed:
    """Put the checks of sites beside each other: number, site; the first site has the most."""
    arrays = {}
    for name, first in vars(sites[0]).items():
        arrays[name] = np.zeros((len(first), len(sites), *first.shape[1:]), first.dtype)
        for s, checks in enumerate(sites):
            arrays[name][: len(checks.step), s] = vars(checks)[name]
    return Observed(**arrays)


def _said(runs: Runs, told: Sequence[_Told], first: int) -> list[tuple[Watched, Stand] | None]:
    """Give what is said of the sites from the first on, and where they stand."""
    said: list[tuple[Watched, Stand] | None] = []
    state, scale = runs.state.whole(), runs.scale
    for s in range(first, len(told)):
        if told[s].is_torn:
            said.append(None)
            continue
        one = s, int(runs.best[s])
        expected = Expected(
            state.mean[one], state.covariance[one], float(state.days[s]), bool(state.knows_other[s])
        )
        events, waiting = tuple(told[s].events), tuple(told[s].waiting)
        count, own = len(told[s].checks.step), runs.of(slice(s, s + 1))
        stand = Stand(count, own, events, told[s].waiting)
        said.append((Watched(events, waiting, float(scale[one]), expected), stand))
    return said


def _advanced(
    runs: Runs,
    told: Sequence[_Told],
    check: Observed,
    past: deque[Past],
    numbers: tuple[int, int],
    thresholds: tuple[float, float],
) -> Runs:
    """Take the checks n of sites in, and tell what they say; `numbers` are the first, and n."""
    first, n = numbers
    if np.any(check.other):
        runs = runs.whole()
    ahead = runs.ahead(check)
    off = ahead.chi2[np.arange(len(told)), runs.best]
    aside = (off > GATE) | np.array([bool(one.waiting) for one in told])
    after = runs.told(ahead)
    telling = np.where(aside, runs.best, after.best)
    for s in np.flatnonzero(telling != runs.telling).tolist():
        if first:
            told[s].is_torn = True
            continue
        changes, known = runs.changes.of(slice(s, s + 1)).copy(), told[s].known
        # Filters that are about as likely take turns.
        known[int(runs.telling[s])] = n - 1, changes
        to = int(telling[s])
        runs.changes.put(s, as_told_by(to, changes, past, s, known.get(to)))
    runs = replace(runs, telling=telling)
    after = replace(after, changes=runs.changes, telling=telling.copy()).taken(ahead, check, n)
    singles = np.array([one.singles for one in told])
    at_least = needed(thresholds, singles, n)
    newest = Past(n, np.ones(len(told), dtype=bool), passed(ahead))
    may_tell = may_be_found(after.changes, after.state.days, n, at_least)
    for s in np.flatnonzero(aside | may_tell).tolist():
        if told[s].is_torn:
            continue
        one = slice(s, s + 1)
        needs = *at_least[:2], at_least[2][one], at_least[3][one]
        own, result = runs.of(one), after.of(one)
        took = Past(n, newest.took[one], newest.passed.part(one))
        if aside[s]:
            # What is off shall not yet tell how the site scatters.
            untold = replace(own, state=result.state, changes=result.changes)
            all_in = With(own.changes, untold, (took,), float(off[s]))
            waiting = {**told[s].waiting, n: float(off[s])}
            alone = all_in if may_tell[s] else None
            branch = confirmed(own, alone, told[s].checks, waiting, needs)
        else:
            all_in = With(own.changes, result, (took,), float(off[s]))
            branch = found(all_in, n - 1, needs)
        if branch is not None and branch.event.onset < first:
            told[s].is_torn = True
            continue
        if branch is not None:
            told[s].tell(branch, n)
            own = adopted(branch.runs, branch.change, past, s, branch.taken)
        elif off[s] <= GATE:
            # The filter has not taken in those that wait: they are left out for good.
            told[s].are_outliers(told[s].waiting, n)
            continue
        elif told[s].waits(n, float(off[s])):
            own = replace(result, state=own.state, changes=own.changes)
        else:
            own = lost(own, check[one])
        newest.took[s] = False
        if branch is not None or not told[s].waiting:
            told[s].known = {}
        if own.state.mean.shape[-1] > after.state.mean.shape[-1]:
            after = after.whole()
        elif own.state.mean.shape[-1] < after.state.mean.shape[-1]:
            own = own.whole()
        after.put(s, own)
    for s in np.flatnonzero(check.moved).tolist():
        told[s].may_have_moved(n)
    past.append(newest)
    while past and past[0].n < first_onset(after.changes):
        past.popleft()
    return after
