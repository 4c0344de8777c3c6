"""What the steps of one site look like over time where nothing moved, and where something did.

A check k at time t gives a step ``y_k`` (6,) from the stored pose. It is modelled as

    y = level + season + slow + other + e,

- *level*: what the stored pose errs by, the same in every check; it grows by a *slope* once a trend
  was found.
- *season*: a cosine and a sine of a year for each of the six, zero mean and `SEASON` wide.
- *slow*: an Ornstein-Uhlenbeck process with the time `SLOW_TIME`: weather, warm-up, leaves.
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
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from ...alignment.certainty import floor
from ...datatypes import Array

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

LEVEL_FACTOR = 1.5
"""How much wider than stated the stored pose's error may be, in σ."""

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
    """

    days: float
    step: Array
    random: Array
    common: Array
    other: bool = False


@dataclass(frozen=True, eq=False)
class State:
    """The filter after a check: mean (36,) and covariance (36, 36) of the state, and its time."""

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
        (M, 6, 6) and (M, 6) the normal equations of the size.
    """

    onset: Array
    days: Array
    is_trend: NDArray[np.bool_]
    deviation: Array
    information: Array
    vector: Array

    def statistics(self) -> Array:
        """(M,) twice the log likelihood ratio of each change against none: χ²(6) where none was."""
        if not len(self.onset):
            return np.zeros(0)
        sizes = np.linalg.solve(self.information, self.vector[..., None])[..., 0]
        return np.asarray(np.einsum("mi,mi->m", sizes, self.vector))

    def size(self, m: int) -> tuple[Array, Array]:
        """(6,) the most likely size of a change, per year of a trend, and its (6, 6) covariance."""
        covariance = np.linalg.inv(self.information[m])
        return np.asarray(covariance @ self.vector[m]), covariance


def no_changes() -> Changes:
    """Give no change at all."""
    none = np.zeros(0)
    shapes = np.zeros((0, SIZE, 6)), np.zeros((0, 6, 6)), np.zeros((0, 6))
    return Changes(none, none, none.astype(bool), *shapes)


def begin(changes: Changes, check: int, days: float, *, kinds: tuple[Kind, ...]) -> Changes:
    """Add the changes that begin with a check."""
    fresh = np.zeros((len(kinds), SIZE, 6))
    for m, kind in enumerate(kinds):
        fresh[m, SLOPE if kind == "trend" else LEVEL] = np.eye(6)
    is_trend = np.array([kind == "trend" for kind in kinds])
    # What has no data yet counts as nothing known: a tiny information keeps it solvable.
    tiny = np.diag(np.r_[np.full(3, 1e-2), np.full(3, 1e-4)])
    return Changes(
        np.r_[changes.onset, np.full(len(kinds), check)],
        np.r_[changes.days, np.full(len(kinds), days)],
        np.r_[changes.is_trend, is_trend].astype(bool),
        np.concatenate([changes.deviation, fresh]),
        np.concatenate([changes.information, np.broadcast_to(tiny, (len(kinds), 6, 6))]),
        np.concatenate([changes.vector, np.zeros((len(kinds), 6))]),
    )


def some(changes: Changes, keep: Array) -> Changes:
    """Keep some of the changes: a mask or indices (M,)."""
    names = ("onset", "days", "is_trend", "deviation", "information", "vector")
    return Changes(*(getattr(changes, name)[keep] for name in names))


def first_state(first: Observed, share: float) -> State:
    """Give what is known before the first check: the stored pose may err by what is stated.

    Of what varies slowly the variance is the floor of what no model names, and a share of a check's
    random part.
    """
    mean, covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    covariance[LEVEL, LEVEL] = LEVEL_FACTOR**2 * first.common
    covariance[COSINE, COSINE] = covariance[SINE, SINE] = np.diag(SEASON**2)
    covariance[SLOW, SLOW] = floor() + share * first.random
    return State(mean, covariance, first.days)


def predicted(
    state: State, changes: Changes, check: Observed, scale: float, share: float
) -> tuple[State, Changes]:
    """Bring the state, and what each change makes of it, to the time of a check.

    `scale` is that of the random part, in σ, and `share` as for `first_state`.
    """
    years = (check.days - state.days) / YEAR
    kept = float(np.exp(-(check.days - state.days) / SLOW_TIME))
    F = np.eye(SIZE)
    F[LEVEL, SLOPE] = years * np.eye(6)
    F[SLOW, SLOW] *= kept
    P = F @ state.covariance @ F.T
    deviation = changes.deviation.copy()
    deviation[:, LEVEL] += years * deviation[:, SLOPE]
    deviation[:, SLOW] *= kept
    P[SLOW, SLOW] += (1.0 - kept**2) * (floor() + scale**2 * share * check.random)
    if check.other and not state.knows_other:
        P[OTHER, OTHER] += LEVEL_FACTOR**2 * check.common
    knows = state.knows_other or check.other
    ahead = State(F @ state.mean, P, check.days, knows)
    return ahead, replace(changes, deviation=deviation)


def weights(check: Observed) -> Array:
    """(6,) by how much each kind of the state shows in a check."""
    angle = 2.0 * np.pi * check.days / YEAR
    return np.array([1.0, 0.0, np.cos(angle), np.sin(angle), 1.0, float(check.other)])


class Surprise(NamedTuple):
    """χ²(6) of a check against what was predicted, and the logarithm of that one's determinant."""

    chi2: float
    log_size: float


def updated(
    state: State, changes: Changes, check: Observed, scale: float
) -> tuple[State, Changes, Surprise]:
    """Take a check in; gives the surprise too. The state is that of the check's time."""
    shares = weights(check)
    H = (shares[:, None, None] * np.eye(6)).transpose(1, 0, 2).reshape(6, SIZE)
    PH = state.covariance @ H.T
    factor = cho_factor(H @ PH + scale**2 * check.random)
    inverse = cho_solve(factor, np.eye(6))
    gain = PH @ inverse
    off = check.step - H @ state.mean
    P = state.covariance - gain @ PH.T
    after = replace(state, mean=state.mean + gain @ off, covariance=(P + P.T) / 2.0)
    weighted = inverse @ off
    log_size = 2.0 * float(np.log(np.diag(factor[0])).sum())
    told = Surprise(float(off @ weighted), log_size)
    if not len(changes.onset):
        return after, changes, told
    shown = np.tensordot(changes.deviation.reshape(-1, 6, 36), shares, (1, 0)).reshape(-1, 6, 6)
    across = np.swapaxes(shown, 1, 2)
    return (
        after,
        replace(
            changes,
            deviation=changes.deviation - gain @ shown,
            information=changes.information + across @ inverse @ shown,
            vector=changes.vector + across @ weighted,
        ),
        told,
    )


def adopted(state: State, changes: Changes, m: int) -> State:
    """Put a change into the state: from now on it is part of what is expected."""
    size, covariance = changes.size(m)
    D = changes.deviation[m]
    return replace(
        state, mean=state.mean + D @ size, covariance=state.covariance + D @ covariance @ D.T
    )
