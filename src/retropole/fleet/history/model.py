"""What the steps of one site look like over time where nothing moved, and where something did.

A check k at time t gives a step ``y_k`` (6,) from the stored pose. It is modelled as

    y = level + season + slow + other + e,

- *level*: what the stored pose errs by, the same in every check; it grows by a *slope* once a trend
  was found.
- *season*: a cosine and a sine of a year for each of the six, zero mean and `SEASON` wide.
- *slow*: an Ornstein-Uhlenbeck process with the time `SLOW_TIME`, or another: weather, leaves.
- *other*: what a pose found the other way (by the scene alone, where poles gave the first) differs.
- *e*: drawn anew in each check, with the random part of its covariance times a scale.

A Kalman filter predicts each step from those before. A change is a deviation of the state: of the
level at a *step*, of the slope where a *trend* begins. How such a deviation passes into all later
predictions is linear and known, so that its size follows by least squares (Willsky and Jones 1976).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ...api import Array, BoolArray, floor

LEVEL, SLOPE, COSINE, SINE, SLOW, OTHER = (slice(6 * k, 6 * k + 6) for k in range(6))
SIZE = 36
"""The state: six quantities of each kind."""

YEAR = 365.25
"""Days."""

SLOW_TIME = 30.0
"""Days in which what varies slowly forgets: weather lasts for weeks, foliage for months."""

SEASON = np.r_[np.full(3, np.radians(0.015)), np.full(3, 0.002)]
"""1 σ of the cosine and of the sine, rad and m: a steel mast of 6 m that is 30 K warmer on one side
than a year's mean differs in length by 2 mm."""

TRANSLATION = slice(3, 6)
"""Of the six."""

RAREST = 1e-280
"""Smaller probabilities are none to a computer."""

LEVEL_FACTOR = 1.5
"""How much wider than stated the stored pose's error may be, in σ."""

UNNAMED = floor()
"""(6, 6) of unmodelled errors."""

IDENTITY = np.eye(6)

NOTHING_KNOWN = np.diag(np.repeat([1e-2, 1e-4], 3))
"""Information on a change that has no data yet: tiny, and keeps its size solvable."""

Kind = Literal["step", "trend"]


@dataclass(frozen=True, eq=False)
class Observed:
    """A check that gave a step.

    Attributes
    ----------
    days
        Its time, in days since any fixed date.
    step
        (6,) ``[φ, δ]``, rad and m.
    random
        (6, 6) of it what each check draws anew.
    common
        (6, 6) of it what all checks found the same way share, more or less.
    other
        Whether it was found another way than the first of the site.
    moved
        Whether it says by itself that the site moved: by more than its tolerance.
    """

    days: float
    step: Array
    random: Array
    common: Array
    other: bool = False
    moved: bool = False


@dataclass(frozen=True, eq=False)
class State:
    """The filter after a check: mean (36,) and covariance (36, 36) of the state, and its time.

    Several filters that run beside each other, R, are (R, 36) and (R, 36, 36).
    """

    mean: Array
    covariance: Array
    days: float
    knows_other: bool = False


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes that may have begun, one for each onset and kind, as the filter sees them.

    Attributes
    ----------
    onset
        (M,) number of the check from which on.
    days
        (M,) its time.
    is_trend
        (M,) whether the slope changed, or the level.
    deviation
        (M, 36, 6) by how much the state is off from the filter's, for a change of size one.
    information, vector
        (M, 6, 6) and (M, 6) the normal equations of the size. Of several filters that run beside
        each other these three have their number R behind M.
    """

    onset: Array
    days: Array
    is_trend: BoolArray
    deviation: Array
    information: Array
    vector: Array

    def statistics(self) -> Array:
        """(M,) twice the log likelihood ratio of each change against none: χ²(6) where none was.

        A trend may be one of translation alone, as of a foundation that settles, which three
        degrees of freedom tell; it counts as the χ²(6) that chance exceeds as often.
        """
        both = self._ratio(slice(0, 6))
        alone = np.where(self.is_trend, self._ratio(TRANSLATION), 0.0)
        return np.asarray(np.maximum(both, chdtri(6, np.maximum(chdtrc(3, alone), RAREST))))

    def size(self, m: int) -> tuple[Array, Array]:
        """(6,) the most likely size of a change, per year of a trend, and its (6, 6) covariance."""
        covariance = np.asarray(np.linalg.inv(self.information[m]), float)
        return (covariance @ self.vector[m][..., None])[..., 0], covariance

    def of(self, run: int) -> Changes:
        """Give those of one of several filters."""
        parts = self.deviation[:, run], self.information[:, run], self.vector[:, run]
        return Changes(self.onset, self.days, self.is_trend, *parts)

    def _ratio(self, part: slice) -> Array:
        """(M,) the same where nothing but a part of the six changed."""
        vector = self.vector[..., part, None]
        sizes = np.linalg.solve(self.information[..., part, part], vector)
        return np.asarray((sizes * vector).sum(axis=(-2, -1)))


def no_changes(*runs: int) -> Changes:
    """Give no change at all; of so many filters that run beside each other."""
    none = np.zeros(0)
    shapes = np.zeros((0, *runs, SIZE, 6)), np.zeros((0, *runs, 6, 6)), np.zeros((0, *runs, 6))
    return Changes(none, none, none.astype(bool), *shapes)


def begin(changes: Changes, check: int, days: float, *, kinds: tuple[Kind, ...]) -> Changes:
    """Add the changes that begin with a check."""
    runs, count = changes.vector.shape[1:-1], len(kinds)
    deviation = np.zeros((count, *runs, SIZE, 6))
    for m, kind in enumerate(kinds):
        deviation[m, ..., SLOPE if kind == "trend" else LEVEL, :] = IDENTITY
    fresh = Changes(
        np.full(count, check),
        np.full(count, days),
        np.array(kinds) == "trend",
        deviation,
        np.broadcast_to(NOTHING_KNOWN, (count, *runs, 6, 6)),
        np.zeros((count, *runs, 6)),
    )
    both = zip(vars(changes).values(), vars(fresh).values(), strict=True)
    return Changes(*map(np.concatenate, both))


def some(changes: Changes, keep: BoolArray) -> Changes:
    """Keep some of the changes: a mask (M,)."""
    return changes if keep.all() else Changes(*(values[keep] for values in vars(changes).values()))


def first_state(first: Observed, share: float | Array) -> State:
    """Give what is known before the first check: the stored pose may err by what is stated.

    Of what varies slowly the variance is the floor of unmodelled errors, and a share of a check's
    random part; of several shares (R,) it is that of as many filters.
    """
    shares = np.asarray(share)[..., None, None]
    mean = np.zeros((*shares.shape[:-2], SIZE))
    covariance = np.zeros((*mean.shape, SIZE))
    covariance[..., LEVEL, LEVEL] = LEVEL_FACTOR**2 * first.common
    covariance[..., COSINE, COSINE] = covariance[..., SINE, SINE] = np.diag(SEASON**2)
    covariance[..., SLOW, SLOW] = UNNAMED + shares * first.random
    return State(mean, covariance, first.days)


def predicted(
    state: State,
    changes: Changes,
    check: Observed,
    scale: float | Array,
    share: float | Array,
    slow_time: float | Array = SLOW_TIME,
) -> tuple[State, Changes]:
    """Bring the state, and what each change makes of it, to the time of a check.

    `scale` is that of the random part, in σ, and `share` as for `first_state`; what varies slowly
    forgets within `slow_time`, days.
    """
    years = (check.days - state.days) / YEAR
    kept = np.exp(-(check.days - state.days) / np.asarray(slow_time))[..., None, None]
    F = np.zeros((*kept.shape[:-2], SIZE, SIZE))
    F[...] = np.eye(SIZE)
    F[..., LEVEL, SLOPE] = years * IDENTITY
    F[..., SLOW, SLOW] *= kept
    P = F @ state.covariance @ np.swapaxes(F, -1, -2)
    deviation = changes.deviation.copy()
    deviation[..., LEVEL, :] += years * deviation[..., SLOPE, :]
    deviation[..., SLOW, :] *= kept
    varied = np.asarray(np.square(scale) * share)[..., None, None] * check.random
    P[..., SLOW, SLOW] += (1.0 - kept**2) * (UNNAMED + varied)
    if check.other and not state.knows_other:
        P[..., OTHER, OTHER] += LEVEL_FACTOR**2 * check.common
    knows = state.knows_other or check.other
    mean = (F @ state.mean[..., None])[..., 0]
    ahead = State(mean, P, check.days, knows)
    return ahead, replace(changes, deviation=deviation)


def weights(check: Observed) -> Array:
    """(6,) by how much each kind of the state shows in a check."""
    angle = 2.0 * np.pi * check.days / YEAR
    return np.array([1.0, 0.0, np.cos(angle), np.sin(angle), 1.0, float(check.other)])


class Surprise(NamedTuple):
    """χ²(6) of a check against what was predicted, and the logarithm of that one's determinant."""

    chi2: Array
    log_size: Array


def updated(
    state: State, changes: Changes, check: Observed, scale: float | Array
) -> tuple[State, Changes, Surprise]:
    """Take a check in; gives the surprise too. The state is that of the check's time."""
    H = np.kron(weights(check), IDENTITY)
    PH = state.covariance @ H.T
    S = H @ PH + np.asarray(np.square(scale))[..., None, None] * check.random
    inverse = np.linalg.inv(S)
    inverse = (inverse + np.swapaxes(inverse, -1, -2)) / 2.0
    gain = PH @ inverse
    off = (check.step - state.mean @ H.T)[..., None]
    P = state.covariance - gain @ np.swapaxes(PH, -1, -2)
    P = (P + np.swapaxes(P, -1, -2)) / 2.0
    after = replace(state, mean=state.mean + (gain @ off)[..., 0], covariance=P)
    weighted = inverse @ off
    chi2 = np.asarray((off * weighted).sum(axis=(-2, -1)))
    told = Surprise(chi2, np.linalg.slogdet(S)[1])
    shown = H @ changes.deviation
    across = np.swapaxes(shown, -1, -2) @ inverse
    changes = replace(
        changes,
        deviation=changes.deviation - gain @ shown,
        information=changes.information + across @ shown,
        vector=changes.vector + (across @ off)[..., 0],
    )
    return after, changes, told


def adopted(state: State, changes: Changes, m: int) -> State:
    """Put a change into the state: from now on it is part of what is expected."""
    size, covariance = changes.size(m)
    D = changes.deviation[m]
    return replace(
        state,
        mean=state.mean + (D @ size[..., None])[..., 0],
        covariance=state.covariance + D @ covariance @ np.swapaxes(D, -1, -2),
    )
