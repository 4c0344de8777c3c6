"""Changes at one site: its checks in the order of time, replayed through a filter.

A check k gives a step ``y_k`` (6,) from the stored pose, which is modelled as

    y = level + season + slow + other + e,

- *level*: the error of the stored pose, the same in every check; it grows by a *slope* once a trend
  was found.
- *season*: a cosine and a sine of a year, zero mean and `SEASON` wide.
- *slow*: an Ornstein-Uhlenbeck process: weather, leaves.
- *other*: the difference of a pose found by the other method (by the scene alone, where poles
  gave the first).
- *e*: independent in each check, with the random part of its covariance times a scale.

In the axes that make the first check's random and common parts diagonal, all six are filtered
separately; correlations of later checks between these axes are neglected. For each of the models
`SLOW` of slow variation there is a Kalman filter; the likeliest one decides.

Changes show in several checks together: for onsets within the last year, a step and a trend from
there on are compared with no change by their likelihood (window-limited GLR, Willsky and Jones
1976; Lai 1998). A check that the filter excludes is treated as one that is just about excluded: as
if its scatter were that much wider. So a single one is not a change, but two that agree are. An
excluded check waits until another shows whether it is an *outlier*, if the next fits again (a
lorry was in view), or the first of a *step*. A change that was found becomes part of the
expectation, and the watch continues.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ...api import Array, BoolArray, floor

YEAR = 365.25
"""Days."""

LEVEL, COSINE, SINE, SLOWLY, SLOPE, OTHER = range(6)
"""Components of the state of an axis."""

SEASON = np.r_[np.full(3, np.radians(0.015)), np.full(3, 0.002)]
"""1 σ of the cosine and of the sine, rad and m: a steel mast of 6 m that is 30 K warmer on one side
than a year's mean differs in length by 2 mm."""

LEVEL_FACTOR = 1.5
"""Factor by which the error of the stored pose may be larger than stated, in σ."""

SCALE, SCALE_CHECKS = 1.25, 8.0
"""Prior of the ratio of a site's random scatter to the stated one, in σ, before its first check;
and its weight in checks. The prediction errors of the site then correct it."""

SLOW = {(0.25, 30.0): -1.0, (1.0, 30.0): 0.0, (4.0, 30.0): -1.0, (1.0, 90.0): -1.0}
"""Of the slow variation: the variance relative to the random part, and its correlation time in
days; with the logarithm of the prior probability of each: the checks of the site choose."""

SHARES, TIMES = np.array(list(SLOW)).T

CHANCE = 0.001
"""Probability that a check waits for another by chance alone."""

GATE = float(chdtri(6, CHANCE))
"""χ²(6) beyond which a check waits."""

MOST_WAITING = 6
"""Number of checks that may wait. If no two of this number agree, that is an alarm too."""

WINDOW = 400.0
"""Days back to which a change may have begun: a year and the weeks to see it."""

MOST_STEPS = 40
"""Number of checks back to which a step may have happened, however many there are in the window."""

SPACING, FRESH = 20.0, 4
"""Days between onsets of trends that are tried: those of neighbours are hardly distinguished; but
each of the newest checks is tried: at 5 mm a day and a check a week only these show the
change."""

STEP, TREND = 42.0, 18.0
"""Twice the log likelihood ratio from which a step, or a trend of few days, was found, and a trend
of many: trends of neighbouring onsets are almost one, so that chance exceeds it less often."""

SHORTEST_TREND = 120.0
"""Days a trend must have lasted: over fewer it cannot be distinguished from a step, unless it is
clear."""

BEHIND = 20.0
"""Amount by which the excess of a step over its threshold may be less than that of a short trend,
and still be reported: over few checks one may look like the other by chance."""

LEAST = np.radians(0.05), 0.005
"""A smaller change, or trend in a year, of rotation and translation, rad and m, is ignored: a
sixth of the tolerance of a check, the seasonal movement of any mast."""

CLEAR = 4.0
"""Difference of twice the log likelihoods from which a step and a trend are distinguished: of two
checks that are both excluded it is at most 5."""

UNKNOWN = 1e-6
"""Information on a change that has no data yet, in units of the first check's σ: tiny."""

EventKind = Literal["step", "trend", "outlier", "unsettled", "moved"]


class Observed(NamedTuple):
    """A check that gave a step.

    Attributes
    ----------
    days
        Its time, in days since any fixed date.
    step
        (6,) ``[φ, δ]``, rad and m.
    random
        (6, 6) the part that is independent in each check.
    common
        (6, 6) the part that checks with the same method roughly have in common.
    other
        Whether it was found with another method than the first of the site.
    moved
        Whether this check alone states that the site moved: by more than its tolerance.
    """

    days: float
    step: Array
    random: Array
    common: Array
    other: bool = False
    moved: bool = False


@dataclass(frozen=True, eq=False)
class Event:
    """A change found in the checks of a site.

    Attributes
    ----------
    kind
        ``step``: the level changed; ``trend``: it changes steadily; ``outlier``: one check is off,
        and the next is not; ``unsettled``: checks are off, and no two agree; ``moved``: two
        checks in a row, or three, each state that the site has moved.
    onset
        Number of the first check that shows it.
    found
        Number of the check that showed it.
    size
        (6,) of a step, rad and m, or of a trend, per year; of *moved*, the newest check's step from
        the stored pose; None of others.
    covariance
        (6, 6) covariance of the step.
    statistic
        Twice the log likelihood ratio against no change; of an outlier, or *moved*, its χ².
    lead
        Difference from that of the other kind of change.
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
        """Whether a step and a trend are distinguished."""
        return self.lead >= CLEAR


@dataclass(frozen=True, eq=False)
class Watched:
    """The checks of a site until now.

    Attributes
    ----------
    events
        In the order in which they were found.
    waiting
        Numbers of the checks that are off and wait for another: not confirmed.
    scale
        Scatter of the site relative to what is stated, in σ.
    """

    events: tuple[Event, ...] = ()
    waiting: tuple[int, ...] = ()
    scale: float = 1.0

    @property
    def alarms(self) -> tuple[Event, ...]:
        """The events that somebody should check: all except a single check that is off."""
        return tuple(event for event in self.events if event.kind != "outlier")


@dataclass(frozen=True, eq=False)
class _Filter:
    """The filters of a site under R laws after some checks, and M changes that may have begun.

    Attributes
    ----------
    axes
        (6, 6) of a step the six that are filtered.
    likelihood
        (R,) logarithm of the likelihood of the checks until now.
    total, weight
        (R,) of the squared scale, and the number of checks that it is from.
    mean, covariance
        (R, 6, 6) and (R, 6, 6, 6) of the state of each axis.
    onset, began, is_trend
        (M,) number of the check with which a change began, its days, and whether it is a trend.
    deviation
        (R, 6, 6, M) the deviation of the state from the filter's, for a change of size one.
    information, vector
        (R, 6, M) normal equations of the size.
    """

    axes: Array
    days: float
    knows_other: bool
    likelihood: Array
    total: Array
    weight: float
    mean: Array
    covariance: Array
    onset: Array
    began: Array
    is_trend: BoolArray
    deviation: Array
    information: Array
    vector: Array

    @property
    def best(self) -> int:
        """The likeliest filter."""
        return int(self.likelihood.argmax())

    def along(self, covariance: Array) -> Array:
        """(6,) variances along the axes."""
        return np.asarray(((self.axes @ covariance) * self.axes).sum(axis=1))

    def without_changes(self) -> _Filter:
        """Give the same with no change that may have begun."""
        return replace(self, **_no_changes(len(self.likelihood)))


def _no_changes(filters: int) -> dict[str, Any]:
    none = np.zeros((filters, 6, 0))
    empty = {"onset": np.zeros(0, int), "began": np.zeros(0), "is_trend": np.zeros(0, dtype=bool)}
    sums = {"information": none, "vector": none, "deviation": np.zeros((filters, 6, 6, 0))}
    return empty | sums


def _begin(first: Observed) -> _Filter:
    """Initialise before the first check: the error of the stored pose is as stated."""
    white = np.linalg.inv(np.linalg.cholesky(first.random + first.common))
    axes = np.linalg.eigh(white @ first.random @ white.T)[1].T @ white
    filters = len(SHARES)
    blank = _Filter(
        axes,
        first.days,
        False,
        np.array([*SLOW.values()]),
        np.full(filters, SCALE_CHECKS * SCALE**2),
        SCALE_CHECKS,
        np.zeros((filters, 6, 6)),
        np.zeros((filters, 6, 6, 6)),
        **_no_changes(filters),
    )
    P = blank.covariance
    P[..., LEVEL, LEVEL] = LEVEL_FACTOR**2 * blank.along(first.common)
    P[..., COSINE, COSINE] = P[..., SINE, SINE] = blank.along(np.diag(SEASON**2))
    unnamed, random = blank.along(floor()), blank.along(first.random)
    P[..., SLOWLY, SLOWLY] = unnamed + SHARES[:, None] * random
    return blank


def _include(now: _Filter, check: Observed, n: int) -> tuple[_Filter, float]:
    """Process check n, and give its χ²; changes that are too old are dropped, and new ones
    begin."""
    days, scale = check.days - now.days, np.sqrt(now.total / now.weight)[:, None]
    F = np.zeros((len(TIMES), 1, 6, 6)) + np.eye(6)
    kept = np.exp(-days / TIMES)[:, None]
    F[..., LEVEL, SLOPE], F[..., SLOWLY, SLOWLY] = days / YEAR, kept
    P = F @ now.covariance @ F.swapaxes(-1, -2)
    random = scale**2 * now.along(check.random)
    P[..., SLOWLY, SLOWLY] += (1 - kept**2) * (now.along(floor()) + SHARES[:, None] * random)
    if check.other and not now.knows_other:
        P[..., OTHER, OTHER] += LEVEL_FACTOR**2 * now.along(check.common)
    angle = 2.0 * np.pi * check.days / YEAR
    shown = np.array([1.0, np.cos(angle), np.sin(angle), 1.0, 0.0, check.other])
    mean, across = (F @ now.mean[..., None])[..., 0], P @ shown
    size, off = across @ shown + random, now.axes @ check.step - mean @ shown
    chi2 = (off**2 / size).sum(axis=1)
    clipped = np.minimum(chi2, GATE)
    likelihood = now.likelihood - 0.5 * (clipped + np.log(size).sum(axis=1))
    # One that is excluded is treated as if it were just about excluded.
    size *= np.maximum(chi2 / GATE, 1.0)[:, None]
    gain = across / size[..., None]

    keep = _kept(now, n, check.days)
    count = np.count_nonzero(keep)
    # After those that are kept a step begins that the check shows, and a trend that it does not
    # show yet.
    D = np.zeros((*mean.shape, count + 2))
    D[..., :count] = now.deviation[..., keep]
    D[:, :, LEVEL] += F[..., LEVEL, SLOPE, None] * D[:, :, SLOPE]
    D[:, :, SLOWLY] *= F[..., SLOWLY, SLOWLY, None]
    D[:, :, LEVEL, count] = 1.0
    G = shown @ D
    D -= gain[..., None] * G[:, :, None]
    D[:, :, SLOPE, count + 1] = 1.0
    information, vector = (weight[..., None] * G for weight in (1.0 / size, off / size))
    information = information * G + UNKNOWN
    information[..., :count] += now.information[..., keep] - UNKNOWN
    vector[..., :count] += now.vector[..., keep]
    after = replace(
        now,
        days=check.days,
        knows_other=now.knows_other or check.other,
        likelihood=likelihood,
        total=now.total + scale[:, 0] ** 2 * clipped / 6.0,
        weight=now.weight + 1.0,
        mean=mean + gain * off[..., None],
        covariance=P - gain[..., None] * across[..., None, :],
        onset=np.append(now.onset[keep], [n, n]),
        began=np.append(now.began[keep], [check.days, check.days]),
        is_trend=np.append(now.is_trend[keep], [False, True]),
        deviation=D,
        information=information,
        vector=vector,
    )
    return after, float(chi2[now.best])


def _kept(now: _Filter, n: int, days: float) -> BoolArray:
    """(M,) changes that are still tried: of older trends the first of each period of this many
    days."""
    span = np.where(now.is_trend, now.began // SPACING, -now.onset - 1.0)
    first = np.zeros(len(span), dtype=bool)
    first[np.unique(span, return_index=True)[1]] = True
    tried = np.where(now.is_trend, first | (now.onset >= n - FRESH), now.onset > n - MOST_STEPS)
    return np.asarray(tried & (days - now.began <= WINDOW))


def _statistics(now: _Filter) -> Array:
    """(M,) twice the log likelihood ratio of each change against none: χ²(6) if none was.

    A change may be one of translation alone, as of a foundation that sinks, which has three
    degrees of freedom; it is converted to the χ²(6) of the same probability.
    """
    A, b, V = now.information[now.best], now.vector[now.best], now.axes[:, 3:]
    pushed = (V.T @ b).T[..., None]
    normal = np.einsum("ij,im,ik->mjk", V, A, V)
    alone = (pushed * np.linalg.solve(normal, pushed)).sum(axis=(1, 2))
    as_six = chdtri(6, np.maximum(chdtrc(3, alone), 1e-280))
    return np.asarray(np.maximum((b**2 / A).sum(axis=0), as_six))


def _accepted(now: _Filter, m: int) -> _Filter:
    """Make a change part of the expectation."""
    D, A = now.deviation[..., m], now.information[..., m, None]
    mean = now.mean + D * now.vector[..., m, None] / A
    P = now.covariance + D[..., None] * D[..., None, :] / A[..., None]
    return replace(now, mean=mean, covariance=P).without_changes()


def _found(now: _Filter, n: int) -> tuple[int, Event] | None:
    """Find the likeliest change that matters, and was not first seen in the newest check n."""
    short = now.is_trend & (now.days - now.began < SHORTEST_TREND)
    statistics = np.where(now.onset < n, _statistics(now), 0.0)
    beyond = statistics - np.where(now.is_trend & ~short, TREND, STEP)
    likeliest = np.argsort(BEHIND * short - beyond, kind="stable")
    for m in likeliest[beyond[likeliest] > 0.0].tolist():
        back = np.linalg.inv(now.axes)
        A, b = now.information[now.best, :, m], now.vector[now.best, :, m]
        size, covariance = back @ (b / A), (back / A) @ back.T
        # The movement of a short trend until now, and that of a long one in a year.
        so_far = size * (now.days - now.began[m]) / YEAR if short[m] else size
        if np.linalg.norm(so_far[:3]) >= LEAST[0] or np.linalg.norm(so_far[3:]) >= LEAST[1]:
            others = statistics[now.is_trend != now.is_trend[m]].max(initial=0.0)
            evidence = float(statistics[m]), float(statistics[m] - others)
            kind: EventKind = "trend" if now.is_trend[m] else "step"
            return m, Event(kind, int(now.onset[m]), n, size, covariance, *evidence)
    return None


def _from_stored(check: Observed) -> float:
    """χ²(6) of a check against the stored pose, whose error may be wider than stated."""
    size = check.random + LEVEL_FACTOR**2 * check.common
    return float(check.step @ np.linalg.solve(size, check.step))


def _stays_moved(newest: Sequence[Observed]) -> bool:
    """Whether the newest two checks state that the site moved, in the same direction; or all
    three."""
    moved = [one.moved and _from_stored(one) > GATE for one in newest]
    if len(newest) < 2 or not all(moved[-2:]):
        return False
    before, last = newest[-2:]
    since = last._replace(step=last.step - before.step)
    return _from_stored(since) <= _from_stored(last) or (len(moved) > 2 and all(moved))


def watch(checks: Sequence[Observed]) -> Watched:
    """Replay the checks of a site and report what changed.

    Parameters
    ----------
    checks
        Those that gave a step from one stored pose, in the order of time.
    """
    if not checks:
        return Watched()
    now, events, waiting = _begin(checks[0]), list[Event](), list[int]()
    for n, check in enumerate(checks):
        now, chi2 = _include(now, check, n)
        waiting += [n] * (chi2 > GATE)
        found = _found(now, n)
        if found is not None or chi2 <= GATE:
            onset = n + 1 if found is None else found[1].onset
            events += [Event("outlier", k, n) for k in waiting if k < onset]
            waiting = []
        if found is not None:
            m, event = found
            # The first check alone may contradict the stored pose and all others.
            first = event.onset == 1 and _from_stored(check) < _from_stored(checks[0])
            events.append(Event("outlier", 0, n) if first else event)
            now = _accepted(now, m)
        elif len(waiting) > MOST_WAITING:
            events.append(Event("unsettled", waiting[0], n))
            waiting = []
        newest = checks[max(n - 2, 0) : n + 1]
        if check.moved and not Watched((*events,)).alarms and _stays_moved(newest):
            size = check.random + check.common
            events.append(Event("moved", n - 1, n, check.step, size, _from_stored(check)))
    return Watched((*events,), (*waiting,), float(np.sqrt(now.total[now.best] / now.weight)))
