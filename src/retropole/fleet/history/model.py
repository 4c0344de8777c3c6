"""What the steps of one site look like over time where nothing moved, and where something did.

A check k at time t gives a step ``y_k`` (6,) from the stored pose. It is modelled as

    y = level + season + slow + other + e,

- *level*: what the stored pose errs by, the same in every check; it grows by a *slope* once a trend
  was found.
- *season*: a cosine and a sine of a year for each of the six, zero mean and `SEASON` wide.
- *slow*: an Ornstein-Uhlenbeck process with the time `SLOW_TIME`, or another: weather, leaves.
- *other*: what a pose found the other way (by the scene alone, where poles gave the first) differs.
- *e*: drawn anew in each check, with the random part of its covariance times a scale.

A Kalman filter predicts each step from those before. Filters of several sites, and several of each
site, run beside each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...api import Array, BoolArray, floor

LEVEL, COSINE, SINE, SLOW, SLOPE, OTHER = (slice(6 * k, 6 * k + 6) for k in range(6))
SIZE = 36
"""The state: six quantities of each kind."""

PLAIN = 24
"""As many are other than zero, where no trend was found and no check was found the other way."""

YEAR = 365.25
"""Days."""

SLOW_TIME = 30.0
"""Days in which what varies slowly forgets: weather lasts for weeks, foliage for months."""

SEASON = np.r_[np.full(3, np.radians(0.015)), np.full(3, 0.002)]
"""1 σ of the cosine and of the sine, rad and m: a steel mast of 6 m that is 30 K warmer on one side
than a year's mean differs in length by 2 mm."""

LEVEL_FACTOR = 1.5
"""How much wider than stated the stored pose's error may be, in σ."""

UNNAMED = floor()
"""(6, 6) of unmodelled errors."""

Kind = Literal["step", "trend"]


@dataclass(frozen=True, eq=False)
class Observed:
    """A check that gave a step; or several, each value with their axes in front.

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

    days: Array | float
    step: Array
    random: Array
    common: Array
    other: BoolArray | bool = False
    moved: BoolArray | bool = False

    def __getitem__(self, k: int | slice) -> Observed:
        """Give some of several along the first axis."""
        return Observed(*(values[k] for values in vars(self).values()))


def together(checks: Sequence[Observed]) -> Observed:
    """Put checks into one, their number in front."""
    return Observed(*(np.array([vars(one)[name] for one in checks]) for name in vars(checks[0])))


@dataclass(frozen=True, eq=False)
class State:
    """The filters of S sites, R beside each other of each, after a check of each.

    Attributes
    ----------
    mean
        (S, R, N) of the state. N is `PLAIN` while no site needs the other kinds, and else `SIZE`.
    covariance
        (S, R, N, N) of it.
    days
        (S,) their times.
    knows_other
        (S,) whether a check of the site was found the other way.
    """

    mean: Array
    covariance: Array
    days: Array
    knows_other: BoolArray

    def whole(self) -> State:
        """Give the same with all kinds."""
        more = SIZE - self.mean.shape[-1]
        if not more:
            return self
        none = [(0, 0)] * 2
        return replace(
            self,
            mean=np.pad(self.mean, [*none, (0, more)]),
            covariance=np.pad(self.covariance, [*none, (0, more), (0, more)]),
        )


def first_state(first: Observed, share: Array) -> State:
    """Give what is known before the first checks (S,): stored poses may err by what is stated.

    Of what varies slowly the variance is the floor of unmodelled errors, and a share (R,) of a
    check's random part.
    """
    mean = np.zeros((len(first.step), len(share), PLAIN))
    covariance = np.zeros((*mean.shape, PLAIN))
    covariance[..., LEVEL, LEVEL] = LEVEL_FACTOR**2 * first.common[:, None]
    covariance[..., COSINE, COSINE] = covariance[..., SINE, SINE] = np.diag(SEASON**2)
    covariance[..., SLOW, SLOW] = UNNAMED + share[:, None, None] * first.random[:, None]
    return State(mean, covariance, np.array(first.days), np.zeros(len(mean), dtype=bool))


def weights(check: Observed) -> Array:
    """(..., 6) by how much each kind of the state shows in a check."""
    angle = 2.0 * np.pi * np.asarray(check.days) / YEAR
    shown = np.zeros((*angle.shape, 6))
    for kind, value in ((LEVEL, 1.0), (COSINE, np.cos(angle)), (SINE, np.sin(angle)), (SLOW, 1.0)):
        shown[..., kind.start // 6] = value
    shown[..., OTHER.start // 6] = check.other
    return shown


@dataclass(frozen=True, eq=False)
class Prediction:
    """What S sites' filters make of their next checks, before they take them in.

    Attributes
    ----------
    years
        (S,) since what came before.
    kept
        (S, R) share of what varies slowly that is left of then.
    through
        (S, R, 6, N) by how much of the state before shows in the check.
    varied
        (S, R, 6, 6) what has varied since.
    fresh
        (S, 6, 6) variance of what is found the other way for the first time.
    across
        (S, R, 6, N) covariance of the check with the state.
    gain
        (S, R, 6, N) of the filter, transposed.
    inverse
        (S, R, 6, 6) information of the prediction.
    off
        (S, R, 6) by what the check is off from it.
    chi2, log_size
        (S, R) χ²(6) of that, and the logarithm of the determinant of its covariance.
    """

    years: Array
    kept: Array
    through: Array
    varied: Array
    fresh: Array
    across: Array
    gain: Array
    inverse: Array
    off: Array
    chi2: Array
    log_size: Array


def predicted(
    state: State, check: Observed, scale: Array, share: Array, slow_time: Array
) -> Prediction:
    """Predict the checks of S sites.

    `scale` (S, R) is that of the random part, in σ, and `share` (R,) as for `first_state`; what
    varies slowly forgets within `slow_time` (R,), days. Where a check is found the other way, or a
    trend was, the state must be whole.
    """
    since = np.asarray(check.days) - state.days
    years, kept = since / YEAR, np.exp(-since[:, None] / slow_time)
    squared = np.square(scale)[..., None, None]
    random = check.random[:, None]
    left = kept[..., None, None]
    varied = (1.0 - left**2) * (UNNAMED + share[:, None, None] * squared * random)
    first = np.asarray(check.other) & ~state.knows_other
    fresh = first[:, None, None] * (LEVEL_FACTOR**2 * check.common)
    weight = weights(check)[:, None]
    shown = _side_by_side(weight, state.mean.shape[-1])
    # A transition scales each kind, but that a slope adds to the level.
    weight = np.repeat(weight, kept.shape[1], axis=1)
    weight[..., SLOW.start // 6] = kept
    weight[..., SLOPE.start // 6] = years[:, None]
    through = _side_by_side(weight, state.mean.shape[-1])
    across = through @ state.covariance
    across[..., SLOW] *= left
    across[..., SLOW] += varied
    if state.mean.shape[-1] == SIZE:
        across[..., LEVEL] += years[:, None, None, None] * across[..., SLOPE]
        across[..., OTHER] += fresh[:, None]
    S = across @ np.swapaxes(shown, -1, -2) + squared * random
    inverse = np.asarray(np.linalg.inv(S), float)
    inverse = (inverse + np.swapaxes(inverse, -1, -2)) / 2.0
    off = check.step[:, None] - (through @ state.mean[..., None])[..., 0]
    chi2 = ((inverse @ off[..., None])[..., 0] * off).sum(axis=-1)
    size = np.asarray(np.linalg.slogdet(S)[1], float)
    gain = inverse @ across
    return Prediction(years, kept, through, varied, fresh, across, gain, inverse, off, chi2, size)


def _side_by_side(weight: Array, size: int) -> Array:
    """(..., 6, N) the identity for each kind of the state, times its weight (..., 6)."""
    matrix = np.zeros((*weight.shape[:-1], 6, size))
    for kind in range(size // 6):
        matrix[..., range(6), range(6 * kind, 6 * kind + 6)] = weight[..., kind, None]
    return matrix


def updated(state: State, check: Observed, ahead: Prediction) -> State:
    """Take checks in that were predicted."""
    mean, P = state.mean.copy(), state.covariance.copy()
    left, years = ahead.kept[..., None], ahead.years[:, None, None]
    mean[..., SLOW] *= left
    P[..., SLOW, :] *= left[..., None]
    P[..., :, SLOW] *= left[..., None]
    P[..., SLOW, SLOW] += ahead.varied
    if mean.shape[-1] == SIZE:
        mean[..., LEVEL] += years * mean[..., SLOPE]
        P[..., LEVEL, :] += years[..., None] * P[..., SLOPE, :]
        P[..., :, LEVEL] += years[..., None] * P[..., :, SLOPE]
        P[..., OTHER, OTHER] += ahead.fresh[:, None]
    mean += (ahead.off[..., None, :] @ ahead.gain)[..., 0, :]
    P -= np.swapaxes(ahead.gain, -1, -2) @ ahead.across
    knows = state.knows_other | np.asarray(check.other)
    return State(mean, P, np.array(check.days), knows)
