"""Changes that may have begun at sites, and what the checks since say of each.

A change is a deviation of the state: of the level at a *step*, of the slope where a *trend* begins.
How such a deviation passes into all later predictions is linear and known, so that its size follows
by least squares (Willsky and Jones 1976).

Those of many sites lie beside each other in slots, and so do the checks: the work of a check is a
few operations on large arrays. It is done for one of the filters of each site, the one that tells;
what the others' would be follows from the checks `Passed`, where another comes to tell.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ...api import Array, BoolArray, IntArray
from .model import LEVEL, PLAIN, SIZE, SLOPE, SLOW, Prediction

STEP_WINDOW = 400.0
TREND_WINDOW = 400.0
"""Days back to which a step, and a trend, may have begun: a year and the weeks to see it."""

TREND_SPACING = 20.0
"""Days between onsets of trends that are tried: those of neighbours are hardly told apart."""

MOST_STEPS = 40
"""Checks back to which a step may have happened, however many there are in the window."""

FRESH = 4
"""Checks back from which each may be the onset of a trend, however near they are: at 5 mm a day and
a check a week nothing else says what happens."""

MOST_TRENDS = int(TREND_WINDOW // TREND_SPACING) + 1 + FRESH + 1
"""One of each span of days, the fresh ones, and the one that begins."""

IS_TREND = np.arange(MOST_STEPS + MOST_TRENDS) >= MOST_STEPS
"""(M,) what the slots hold: a step that begins with check n has the slot n modulo `MOST_STEPS`."""

NONE = -1
"""Onset of a slot that is free."""

ORDER = [3, 4, 5, 0, 1, 2]
"""Of the six of a size, translation first: where it is eliminated first, what it tells alone is
there on the way."""

TOGETHER = 64
"""Checks whose sums are taken together, where many are taken in again."""

CACHED = 2
"""Sites whose deviations a processor's cache of 1 MB holds, before and after a check."""

RAREST = 1e-280
"""Smaller probabilities are none to a computer."""

SIZE_ONE = np.eye(6)[:, ORDER]
"""(6, 6) a change of one in each of the six."""

SLOPES = SIZE_ONE[:, :, None] * IS_TREND
"""(6, 6, M) of trends at sites where none was found; of steps it is zero."""

NOTHING_KNOWN = np.diag(np.repeat([1e-4, 1e-2], 3))
"""Information on a change that has no data yet: tiny, and keeps its size solvable."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes that may have begun at S sites, as one filter of each site sees them; M slots.

    Attributes
    ----------
    onset
        (S, M) number of the check from which on; `NONE` of a free slot, whose rest means nothing.
    days
        (S, M) its time.
    deviation
        (S, N, 6, M) by how much the state is off from the filter's, for a change of size one. While
        N is `PLAIN`, the slope is off by one in trends, and by nothing in steps.
    information, vector
        (6, 6, S, M), of which the half above the diagonal counts, and (6, S, M): the normal
        equations of the size, the six in the `ORDER`.
    """

    onset: Array
    days: Array
    deviation: Array
    information: Array
    vector: Array

    def of(self, sites: slice) -> Changes:
        """Give those of some sites."""
        parts = (self.information[:, :, sites], self.vector[:, sites])
        return Changes(self.onset[sites], self.days[sites], self.deviation[sites], *parts)

    def copy(self) -> Changes:
        """Give the same in arrays of their own."""
        return Changes(*(values.copy() for values in vars(self).values()))

    def put(self, s: int, one: Changes) -> None:
        """Set those of one site, in place."""
        for name in ("onset", "days", "deviation"):
            vars(self)[name][s] = vars(one)[name][0]
        self.information[:, :, s], self.vector[:, s] = one.information[:, :, 0], one.vector[:, 0]

    def whole(self) -> Changes:
        """Give the same with all kinds of the state."""
        if self.deviation.shape[1] == SIZE:
            return self
        deviation = np.pad(self.deviation, ((0, 0), (0, SIZE - PLAIN), (0, 0), (0, 0)))
        deviation[:, SLOPE] = SLOPES
        return replace(self, deviation=deviation)

    def ratios(self) -> tuple[Array, Array]:
        """(S, M) twice the log likelihood ratio of each against none; and of translation alone."""
        A, rest = self.information.copy(), self.vector.copy()
        told = []
        for k in range(6):
            share = A[k, k + 1 :] / A[k, k]
            told.append(np.square(rest[k]) / A[k, k])
            A[k + 1 :, k + 1 :] -= share[:, None] * A[k, None, k + 1 :]
            rest[k + 1 :] -= share * rest[k]
        alone = told[0] + told[1] + told[2]
        return alone + (told[3] + told[4] + told[5]), alone

    def statistics(self) -> Array:
        """(S, M) twice the log likelihood ratio of each change against none: χ²(6) if none was.

        A trend may be one of translation alone, as of a foundation that settles, which three
        degrees of freedom tell; it counts as the χ²(6) that chance exceeds as often.
        """
        both, alone = self.ratios()
        both[:, IS_TREND] = np.maximum(both[:, IS_TREND], as_six(alone[:, IS_TREND]))
        return np.where(self.onset == NONE, 0.0, both)

    def size(self, s: int, m: int) -> tuple[Array, Array]:
        """(6,) the most likely size of a change, per year of a trend, and its (6, 6) covariance."""
        half = np.triu(self.information[:, :, s, m])
        information = (half + np.triu(half, 1).T)[np.ix_(ORDER, ORDER)]
        covariance = np.asarray(np.linalg.inv(information), float)
        return covariance @ self.vector[ORDER, s, m], covariance


def as_six(alone: Array) -> Array:
    """Give the χ²(6) that chance exceeds as often as a χ²(3)."""
    return np.asarray(chdtri(6, np.maximum(chdtrc(3, alone), RAREST)))


def no_changes(sites: int, size: int = PLAIN, slots: int = len(IS_TREND)) -> Changes:
    """Give sites no change at all."""
    information = np.broadcast_to(NOTHING_KNOWN[..., None, None], (6, 6, sites, slots)).copy()
    onset, days = np.full((sites, slots), NONE), np.zeros((sites, slots))
    deviation, vector = np.zeros((sites, size, 6, slots)), np.zeros((6, sites, slots))
    return Changes(onset, days, deviation, information, vector)


class Passed(NamedTuple):
    """What deviations pass through with a check of S sites: parts of a `Prediction`.

    Of all of their filters, R, or with no such axis of one of each.
    """

    years: Array
    kept: Array
    through: Array
    gain: Array
    inverse: Array
    off: Array

    def of(self, sites: IntArray | int, filters: IntArray) -> Passed:
        """Take one of all filters of each of some sites."""
        count = np.zeros_like(filters) + sites
        return Passed(self.years[count], *(values[count, filters] for values in self[1:]))

    def whole(self) -> Passed:
        """Give that of one filter of each site with all kinds of the state."""
        more = (0, 0), (0, 0), (0, SIZE - PLAIN)
        through = np.pad(self.through, more)
        through[:, range(6), range(SLOPE.start, SLOPE.stop)] = self.years[:, None]
        return self._replace(through=through, gain=np.pad(self.gain, more))

    def part(self, sites: slice) -> Passed:
        """Give those of some sites."""
        return Passed(*(values[sites] for values in self))


def passed(ahead: Prediction) -> Passed:
    """Keep of a prediction what deviations pass through."""
    return Passed(ahead.years, ahead.kept, ahead.through, ahead.gain, ahead.inverse, ahead.off)


def taken(changes: Changes, n: int, days: Array, check: Passed) -> Changes:
    """Take the checks n at `days` (S,) in; what is too old is left out, and changes begin."""
    onset, begin = _kept(changes, n, days), changes.days.copy()
    sites = np.arange(len(onset))
    steps = np.full(len(onset), n % MOST_STEPS)
    trends = np.asarray(MOST_STEPS + (onset[:, IS_TREND] == NONE).argmax(axis=1))
    begins = (sites, steps), (sites, trends)
    deviation, shown = _through(changes.deviation, check, IS_TREND, *begins)
    information, vector = changes.information.copy(), changes.vector.copy()
    for of, slots in begins:
        onset[of, slots], begin[of, slots] = n, days
        information[:, :, of, slots] = NOTHING_KNOWN[..., None]
        vector[:, of, slots] = 0.0
    _tell(information, vector, shown, check)
    return Changes(onset, begin, deviation, information, vector)


def _kept(changes: Changes, n: int, days: Array) -> Array:
    """(S, M) the onsets that are tried at the checks n, of those that were."""
    onset, begin = changes.onset, changes.days
    age = days[:, None] - begin
    keep = (onset != NONE) & (age <= STEP_WINDOW) & (onset > n - MOST_STEPS)
    # Of the older trends the first of each so many days.
    own, span = onset[:, IS_TREND], begin[:, IS_TREND] // TREND_SPACING
    earlier = (own[:, None, :] < own[:, :, None]) & (own != NONE)[:, None, :]
    first = ~(earlier & (span[:, None, :] == span[:, :, None])).any(axis=-1)
    trying = (age[:, IS_TREND] <= TREND_WINDOW) & (first | (own >= n - FRESH))
    keep[:, IS_TREND] = (own != NONE) & trying
    return np.where(keep, onset, NONE)


Slots = tuple[IntArray, IntArray]
"""Numbers of sites, and of a slot of each."""


def _slots(which: BoolArray) -> Slots:
    sites, slots = np.nonzero(which)
    return sites, slots


def _through(
    D: Array, check: Passed, is_trend: BoolArray, steps: Slots, trends: Slots
) -> tuple[Array, Array]:
    """Pass deviations (S, N, 6, M) through a check; gives too how much of them it shows.

    `is_trend` (M,) says what the slots hold, trends last; in the slots `steps` and `trends` one
    begins with it.
    """
    size = D.shape[1]
    towards = -np.swapaxes(check.gain, 1, 2)
    begin = np.zeros((len(D), size + 6, 6))
    begin[:, :size] = towards[..., ORDER]
    begin[:, LEVEL] += SIZE_ONE
    begin[:, size:] = SIZE_ONE
    # Each kind of the state shows with one weight, as the identity.
    weight = check.through[:, :1, ::6]
    flat, left = D.reshape(len(D), size, -1), check.kept[:, None, None]
    years, first_trend = check.years[:, None, None], np.count_nonzero(~is_trend)
    # After the check first, and below what shows in it.
    both = np.empty((len(D), size + 6, 6, len(is_trend)))
    for first in range(0, len(D), CACHED):
        some = slice(first, first + CACHED)
        old, product = flat[some], both[some].reshape(-1, size + 6, flat.shape[-1])
        after, shows = product[:, :size], product[:, size:]
        kinds = old.reshape(len(old), size // 6, -1)
        np.matmul(weight[some], kinds, out=shows.reshape(len(old), 1, -1))
        # The slope of a trend, which is not among plain kinds, has added to the level.
        sloped = years[some, ..., None] * SIZE_ONE[..., None]
        if size == PLAIN:
            both[some, size:, :, first_trend:] += sloped
        np.matmul(towards[some], shows, out=after)
        after[:, : SLOW.start] += old[:, : SLOW.start]
        after[:, SLOW] += left[some] * old[:, SLOW]
        after[:, SLOW.stop :] += old[:, SLOW.stop :]
        if size == SIZE:
            after[:, LEVEL] += years[some] * old[:, SLOPE]
        else:
            both[some, LEVEL, :, first_trend:] += sloped
    both[steps[0], :, :, steps[1]] = begin[steps[0]]
    slope = np.zeros((SIZE + 6, 6))
    slope[SLOPE] = SIZE_ONE
    both[trends[0], :, :, trends[1]] = slope if size == SIZE else 0.0
    return both[:, :size], both[:, size:]


def _tell(information: Array, vector: Array, shown: Array, check: Passed) -> None:
    """Add to normal equations, in place, what a check says that shows (S, 6, 6, M) of changes."""
    flat = shown.reshape(*shown.shape[:2], -1)
    weighted = check.inverse @ flat
    towards = (check.inverse @ check.off[..., None]).swapaxes(1, 2) @ flat
    vector += towards.reshape(len(flat), 6, -1).swapaxes(0, 1)
    # Six by six, size by size, of all changes: sums of whole rows are quick.
    G, W = (
        np.ascontiguousarray(each.reshape(shown.shape).transpose(1, 2, 0, 3))
        for each in (shown, weighted)
    )
    for k in range(6):
        information[k, k:] += np.einsum("rsm,rjsm->jsm", G[:, k], W[:, k:])


def rebuilt(start: Changes, is_trend: BoolArray, past: Iterable[tuple[int, Passed]]) -> Changes:
    """Take checks in again, of sites whose changes that are to be known in the end are named.

    `start` has the onsets of these, in slots for `is_trend` (M,), and is else as it was before the
    checks; `past` has the number of each, from the first that any of the sites lacks on.
    """
    onset, D = start.onset, start.deviation
    shown, weighted, off = [], [], []
    for n, check in past:
        steps, trends = ((onset == n) & (is_trend == each) for each in (False, True))
        if check.gain.shape[-1] < D.shape[1]:
            check = check.whole()
        D, one = _through(D, check, is_trend, _slots(steps), _slots(trends))
        one *= ((onset != NONE) & (onset <= n))[:, None, None]
        shown.append(one)
        weighted.append((check.inverse @ one.reshape(*one.shape[:2], -1)).reshape(one.shape))
        off.append(check.off)
    information, vector = start.information, start.vector
    for k in range(0, len(off), TOGETHER):
        some = slice(k, k + TOGETHER)
        # All that the checks show of a change in one: (S, M, 6, 6 checks).
        G, W = (
            np.array(each[some]).transpose(1, 4, 3, 0, 2).reshape(*onset.shape, 6, -1)
            for each in (shown, weighted)
        )
        beyond = np.array(off[some]).transpose(1, 0, 2).reshape(len(onset), 1, -1, 1)
        information = information + np.moveaxis(G @ np.swapaxes(W, -1, -2), (2, 3), (0, 1))
        vector = vector + np.moveaxis((W @ beyond)[..., 0], 2, 0)
    return replace(start, deviation=D, information=information, vector=vector)
