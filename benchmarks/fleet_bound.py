"""The soonest that any detector can tell a drift of 1 mm a day, by its checks alone.

The likelihood-ratio test (Neyman and Pearson 1933) of a drift against none, that knows how large
the drift is and how checks scatter: Gaussian, 1 σ on each axis, about a level that the stored pose
errs by. Nothing else is unknown to it, neither tails nor seasons nor what is correlated. It runs
each week, so the onset is unknown: the largest ratio of all onsets, one a day in the last
`ONSETS` days, is held against a threshold (CUSUM, Page 1954; Lorden 1971). The threshold is the one
with one false alarm in 100 site-years, on `QUIET` sites that do not move. Three such tests:

- *all but the onset* is known: no detector that is not told the onset as well does clearly better;
- *how fast*: the largest ratio of all directions of the translation;
- *nothing*: of all directions and speeds, as a detector needs that is told nothing of how a site
  will move.

Lorries make a check useless to both, and they are told which: a bound on what a detector that has
to find out can do.

Of drifts, onsets and the level's σ as in ``fleet_history.py --alarms``, on other seeds. Nothing was
tuned.

    python benchmarks/fleet_history.py --bound
"""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np

from retropole.api import floor
from retropole.base.datatypes import Array

A_DAY, LIMIT = 0.001, 0.02
"""The drift, m a day, and by when it is to be told, m."""

WEEKS, ONSETS = 104, 84
QUIET, DRIFTING = 5_000, 2_000
"""Sites of two years without a drift, that set the threshold, and with one."""

WANTED = 0.01
"""False alarms in a site-year."""

KNOWN = {
    "all but the onset": (1, True),
    "how fast": (3, True),
    "nothing": (3, False),
}
"""What is known of the drift: axes of the translation that are looked at, whether its speed is."""


def simulated(
    sites: int, sigma: float, lorries: float, axes: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """What checks of sites that do not move say (S, W, A), in m, and which count (S, W)."""
    level = level_sigma(sigma) * rng.normal(size=(sites, 1, axes))
    said = level + sigma * rng.normal(size=(sites, WEEKS, axes))
    return said, rng.random((sites, WEEKS)) >= lorries


def level_sigma(sigma: float) -> float:
    """1 σ of what the stored pose errs by, along an axis, metres: as ``--alarms`` has it."""
    return float(np.sqrt(sigma**2 + 2.0 * np.mean(np.diag(floor())[3:])))


def ratios(said: Array, counts: Array, sigma: float, *, speed_known: bool) -> Array:
    """Largest log-likelihood ratio of all onsets, at each check (S, W).

    Of one axis the drift is along it; of three the direction is the likeliest. Where its speed is
    not known, that is the likeliest, too.
    """
    sites, weeks, axes = said.shape
    days = 7.0 * np.arange(weeks)
    used = np.where(counts[..., None], said, 0.0)
    # A level of so many σ⁻² is known beforehand, besides the checks.
    number = np.cumsum(counts, axis=1) + (sigma / level_sigma(sigma)) ** 2
    total = np.cumsum(used, axis=1)
    reach = ONSETS // 7 + 1
    found = np.full((sites, weeks), -np.inf)
    for n in range(weeks):
        last = slice(max(n - reach + 1, 0), n + 1)
        onsets = days[n] - 1.0 - np.arange(ONSETS)
        moved = A_DAY * np.maximum(days[last] - onsets[:, None], 0.0)
        by = moved @ used[:, last].transpose(1, 0, 2).reshape(-1, sites * axes)
        by = by.reshape(-1, sites, axes)
        sums, squares = (part @ counts[:, last].T.astype(float) for part in (moved, moved**2))
        slope = (by - sums[..., None] * (total[:, n] / number[:, n, None])) / sigma**2
        information = (squares - sums**2 / number[:, n]) / sigma**2
        along = slope[..., 0] if axes == 1 else np.linalg.norm(slope, axis=2)
        # Of an onset just before the check nothing is told: 0 of 0 is no information.
        at_best = along**2 / np.maximum(2 * information, 1e-12)
        found[:, n] = (along - information / 2 if speed_known else at_best).max(axis=0)
    return found


def threshold(found: Array) -> float:
    """Threshold that sites without a drift cross as often as is wanted."""
    # A site alarms once; the years after its alarm count no more, of which there are few.
    years = 7.0 * found.shape[1] / 365.25
    return float(np.quantile(found.max(axis=1), np.exp(-WANTED * years)))


def told_at(
    sigma: float,
    lorries: float,
    axes: int,
    limit: float,
    rng: np.random.Generator,
    *,
    speed_known: bool,
) -> Array:
    """How far sites had drifted when they were told (S,), metres."""
    said, counts = simulated(DRIFTING, sigma, lorries, axes, rng)
    days = 7.0 * np.arange(WEEKS)
    onset = rng.uniform(days[12], days[40], DRIFTING)
    moved = A_DAY * np.maximum(days - onset[:, None], 0.0)
    said[..., 0] += moved
    above = (ratios(said, counts, sigma, speed_known=speed_known) > limit) & (moved > 0)
    return np.where(above.any(axis=1), moved[np.arange(DRIFTING), above.argmax(axis=1)], np.inf)


def bound_table(first: int) -> None:
    """Print how soon a drift of 1 mm a day can be told."""
    print(
        "| known of the drift | σ of a check | lorries | moved by then: median, 90 %, 99 %, mm "
        "| by 20 mm | false alarms in site-years |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for (name, (axes, speed_known)), sigma, lorries in product(
        KNOWN.items(), (0.001, 0.003), (0.0, 0.02)
    ):
        rng = np.random.default_rng([20, first, axes, int(1e4 * sigma), int(1e3 * lorries)])
        test = partial(ratios, sigma=sigma, speed_known=speed_known)
        limit = threshold(test(*simulated(QUIET, sigma, lorries, axes, rng)))
        again = test(*simulated(QUIET, sigma, lorries, axes, rng))
        false = int((again.max(axis=1) > limit).sum())
        moved = told_at(sigma, lorries, axes, limit, rng, speed_known=speed_known)
        mm = [f"{1000 * np.quantile(moved, q, method='higher'):.0f}" for q in (0.5, 0.9, 0.99)]
        print(
            f"| {name} | {1000 * sigma:g} mm | {lorries:.0%} | {', '.join(mm)} | "
            f"{np.mean(moved <= LIMIT):.1%} | {false} in {QUIET * 7 * WEEKS / 365.25:.0f} |",
            flush=True,
        )
