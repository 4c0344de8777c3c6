"""How soon a change of a watched site is found, and how often one is found where there was none.

Sites with two years of weekly checks, whose scatter follows one of several laws. The rows are drawn
here: of each law as many sites without a change, with a step (0.3° or 3 cm), and with a drift of
1 cm a year.

What sets and what states. The constants of the detector were set on the laws of `TUNE` with seeds
below 1000 (`--tune --first 0`). What docs/evidence/checks.md states is of the laws of `STATE`
with seeds from 3300 on. Of these `UNSEEN` are of a kind that no law of `TUNE` has: tails of each
axis for itself, another shape of the year, scatter that differs from week to week and is not
stated, a stated covariance that is too large. The others of `STATE` are of a kind that `TUNE` has
too, and harsher. Seeds 3200 to 3233 were looked at before the last change: 15 false alarms in 872
site-years raised the threshold of a step from 40 to 42.

`--alarms` is another table, of what a person at a site would ask: a drift of 1 and 5 mm a day, a
step of 1 and 3 cm, and none; a check scatters by 1 or 3 mm on each axis; with and without lorries
in 2 % of the checks. Its seeds are 0 to 999 for tuning (`--first 0`), and from 6100 on for what is
stated; 5000 to 5049 and 6000 to 6049 were looked at before the last change.

Prints Markdown tables: false alarms, steps and drifts of each law, and the drifts that are found
within a year by how much a check scatters. `--recorded N` has N simulated sites recorded again and
again, and checked as `retropole check` does, to see whether rows scatter as their covariance says.
`--bound` says how soon a drift of 1 mm a day can be told at all, by `fleet_bound`.

    python benchmarks/fleet_history.py --tune --first 0
    python benchmarks/fleet_history.py --sites 34 --first 3300
    python benchmarks/fleet_history.py --alarms --sites 50 --first 6100
    python benchmarks/fleet_history.py --bound
    python benchmarks/fleet_history.py --recorded 6 --checks 12 --first 2000
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import pairwise, product
from multiprocessing import get_context

import numpy as np
from scipy.special import chdtrc

from again import record_again
from fleet_bound import bound_table
from retropole.api import floor
from retropole.base.datatypes import Array, PoseEstimate
from retropole.checking.drift import check
from retropole.checking.movement import BOUND_SIGMAS, FALSE_ALARM, upper_limit
from retropole.checking.tolerance import DEFAULT_TOLERANCE
from retropole.fleet.history.store import CheckRow, flat, observed
from retropole.fleet.history.watch import YEAR, Observed, Watched, watch
from retropole.pipeline import Options, calibrate
from retropole.simulation import NOISE_MODELS, simulate_pair

WEEKS = 104
SIGMAS = (np.radians(0.003), np.radians(0.05)), (0.0005, 0.005)
"""Between which 1 σ of a check's random part lies, rad and m, at all sites (log-uniform): one sweep
of a street or a harbour gives the least of it, one of a corridor, or of a road, the most."""

STEP = float(np.radians(0.3)), 0.03
DRIFT = 0.01
SCENES = ("corridor", "street", "harbor")


@dataclass(frozen=True)
class Law:
    """How the checks of a site scatter.

    Attributes
    ----------
    tails
        Degrees of freedom of Student's t, of variance one; None is Gaussian.
    apart
        Whether each axis has its tails for itself; otherwise a check is off on all.
    correlation
        Of a check with the next, a week later.
    weather
        Time constant of a part of the scatter, days, that has half of its variance; 0 for none.
    factor
        σ of the scatter beside what the rows state.
    uneven
        1 σ of the logarithm of what the σ of a week differs by and the rows do not state.
    missing, gap
        Share of the weeks without a check, and weeks of one gap.
    season
        Amplitude of an annual movement, m, with 0.005° for each millimetre.
    abrupt
        Whether the year has two states, with a fortnight between, and is no cosine.
    lorries
        Share of the checks that are off by 10 to 30 σ.
    other
        Share of the checks found by the scene alone, with an offset of its own.
    """

    tails: float | None = None
    apart: bool = False
    correlation: float = 0.0
    weather: float = 0.0
    factor: float = 1.0
    uneven: float = 0.0
    missing: float = 0.0
    gap: int = 0
    season: float = 0.0
    abrupt: bool = False
    lorries: float = 0.0
    other: float = 0.0


TUNE = {
    "Gaussian": Law(),
    "tails": Law(tails=5.0, lorries=0.01),
    "correlated": Law(correlation=0.5),
    "weather": Law(weather=40.0),
    "too small": Law(factor=1.3),
    "missing": Law(missing=0.1),
    "seasonal": Law(season=0.002),
    "two ways": Law(other=0.2),
    "all at once": Law(
        tails=5.0,
        correlation=0.3,
        factor=1.2,
        missing=0.1,
        season=0.001,
        lorries=0.01,
        other=0.2,
    ),
}
STATE = {
    "Gaussian": Law(),
    "tails, t of 3, and lorries": Law(tails=3.0, lorries=0.02),
    "tails of each axis, t of 3": Law(tails=3.0, apart=True),
    "correlated, 0.7 a week": Law(correlation=0.7),
    "weather of 60 days": Law(weather=60.0),
    "covariance 1.5 times too small": Law(factor=1.5),
    "covariance 1.5 times too large": Law(factor=1.0 / 1.5),
    "uneven weeks": Law(uneven=0.5),
    "missing weeks, a gap of 8": Law(missing=0.2, gap=8),
    "seasonal, 3 mm": Law(season=0.003),
    "abrupt seasons, 3 mm": Law(season=0.003, abrupt=True),
    "two ways": Law(other=0.3),
    "all at once": Law(
        tails=4.0,
        correlation=0.4,
        factor=1.3,
        missing=0.1,
        gap=4,
        season=0.0015,
        lorries=0.01,
        other=0.2,
    ),
}
"""Laws of a table; a name says what is unlike a Gaussian scatter as stated."""

UNSEEN = (
    "tails of each axis, t of 3",
    "covariance 1.5 times too large",
    "uneven weeks",
    "abrupt seasons, 3 mm",
)

BINS = 0.0, 0.001, 0.002, 0.003, 0.004, np.inf
"""Of the σ of a check by which drifts are counted, m."""


@dataclass(frozen=True)
class Outcome:
    """What came of one site, in checks after the change; None where it was not found.

    `sigma` is 1 σ of the translation that a check draws anew, along an axis, m: as rows state it.
    """

    law: str
    change: str
    years: float
    false: int
    sigma: float
    found: int | None = None
    within_days: float | None = None
    right: bool = False
    clear: bool = False


@dataclass(frozen=True)
class Recorded:
    """What came of a site that was recorded again and again."""

    seed: int
    checks: int
    told: int
    chi2: list[float]
    scale: float
    alarms: int


def direction(rng: np.random.Generator) -> Array:
    """Draw a direction (3,)."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def heavy(freedom: float, shape: int | tuple[int, int], rng: np.random.Generator) -> Array:
    """Draw what makes a Gaussian a Student's t of variance one."""
    return np.asarray(np.sqrt((freedom - 2.0) / rng.chisquare(freedom, shape)))


def passing(white: Array, kept: float) -> Array:
    """Make rows (n, 6) that keep so much of the one before, of the same variance."""
    noise = white.copy()
    for k in range(1, len(noise)):
        noise[k] = kept * noise[k - 1] + np.sqrt(1.0 - kept**2) * white[k]
    return noise


def scatter(law: Law, rng: np.random.Generator, count: int = WEEKS) -> Array:
    """Draw what each check errs by (count, 6), with the covariance of unit axes."""
    white = rng.normal(size=(count, 6))
    if law.tails is not None:
        shape = (count, 6 if law.apart else 1)
        white = white * heavy(law.tails, shape, rng)
    noise = passing(white, law.correlation)
    if law.weather:
        slow = passing(rng.normal(size=(count, 6)), float(np.exp(-7.0 / law.weather)))
        noise = np.sqrt(0.5) * (noise + slow)
    noise *= np.exp(law.uneven * rng.normal(size=(count, 1)) - law.uneven**2)
    off = rng.random(count) < law.lorries
    for k in np.flatnonzero(off):
        way = rng.normal(size=6)
        noise[k] += rng.uniform(10, 30) * way / np.linalg.norm(way)
    return np.asarray(law.factor * noise)


def annual(law: Law, days: Array, rng: np.random.Generator) -> Array:
    """Draw what moves with the seasons (n, 6), rad and m."""
    size = np.r_[direction(rng) * np.radians(0.005) / 0.001, direction(rng)] * law.season
    phase = 2 * np.pi * days[:, None] / YEAR + rng.uniform(0, 2 * np.pi, 6)
    # A fortnight is 2π / 26 of a year.
    course = np.tanh(np.cos(phase) * 26 / np.pi) if law.abrupt else np.cos(phase)
    return np.asarray(size * course)


def drawn(
    law: Law, change: str, seed: int, count: int = WEEKS, apart: float = 7.0
) -> tuple[list[Observed], float]:
    """Draw a site's checks, so many days apart, and when it changed (a step: the check before)."""
    rng = np.random.default_rng([16, seed])
    sigmas = np.repeat([np.exp(rng.uniform(*np.log(each))) for each in SIGMAS], 3)
    # A rotation about a far centre moves the origin: both parts correlate.
    A = np.eye(6) + 0.4 * rng.normal(size=(6, 6))
    A *= (sigmas / np.linalg.norm(A, axis=1))[:, None]
    common = 1.5 * A @ A.T + 2.0 * floor()
    level, other = (np.linalg.cholesky(common) @ rng.normal(size=6) for _ in range(2))
    spread = np.exp(0.2 * rng.normal(size=count))
    noise = spread[:, None] * (scatter(law, rng, count) @ A.T)
    days = 20000.0 + apart * np.arange(count) + rng.uniform(-0.2, 0.2, count)
    days += rng.uniform(0, YEAR)
    season = annual(law, days, rng)
    moved, since = np.zeros((count, 6)), np.inf
    if change == "step":
        k = int(rng.integers(12, count - 4))
        part, size_of = ((slice(0, 3), STEP[0]), (slice(3, 6), STEP[1]))[int(rng.integers(2))]
        moved[k:, part], since = size_of * direction(rng), days[k - 1]
    elif change == "drift":
        since = days[int(rng.integers(0, 50))]
        along = np.maximum(days - since, 0.0) / YEAR
        moved[:, 3:] = DRIFT * along[:, None] * direction(rng)
    there = rng.random(count) >= law.missing
    if law.gap:
        start = int(rng.integers(0, count - law.gap))
        there[start : start + law.gap] = False
    by_scene = rng.random(count) < law.other
    by_scene[0] = False
    there[0] = True
    checks = [
        Observed(
            float(days[k]),
            level + other * by_scene[k] + season[k] + noise[k] + moved[k],
            spread[k] ** 2 * A @ A.T,
            common,
            bool(by_scene[k]),
        )
        for k in np.flatnonzero(there)
    ]
    return checks, float(since)


def judged(
    name: str, change: str, checks: Sequence[Observed], since: float, seen: Watched
) -> Outcome:
    """Tell the alarms before a change, which are false, from the one that finds it."""
    days = np.array([one.days for one in checks])
    sigma = float(np.sqrt(np.trace(np.median([c.random for c in checks], axis=0)[3:, 3:]) / 3))
    years = float(min(since, days[-1]) - days[0]) / YEAR
    false = [event for event in seen.alarms if days[event.found] <= since]
    true = [event for event in seen.alarms if days[event.found] > since]
    if change == "none" or not true:
        return Outcome(name, change, years, len(false), sigma)
    first = true[0]
    right = first.kind == {"step": "step", "drift": "trend"}[change]
    number = int((days[: first.found + 1] > since).sum())
    late = float(days[first.found] - since)
    return Outcome(name, change, years, len(false), sigma, number, late, right, first.is_clear)


def run(seed: int, *, laws: dict[str, Law], changes: Sequence[str]) -> list[Outcome]:
    """Draw a site of each law with each change, and watch it."""
    found = []
    for number, (name, law) in enumerate(laws.items()):
        for change in changes:
            checks, since = drawn(law, change, 100_000 * number + seed)
            found.append(judged(name, change, checks, since, watch(checks)))
    return found


def table(outcomes: Sequence[Outcome], laws: dict[str, Law]) -> None:
    print(
        "| scatter | false alarms in site-years | steps found by the second check | named a step "
        "| drifts found within a year | median, 95 % days | named a trend |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in laws:
        own = [one for one in outcomes if one.law == name]
        quiet, steps, drifts = (
            [one for one in own if one.change == change] for change in ("none", "step", "drift")
        )
        soon = [one for one in steps if one.found is not None and one.found <= 2]
        year = [one for one in drifts if one.within_days is not None and one.within_days <= YEAR]
        told = [one for one in drifts if one.found is not None]
        late = np.array([one.within_days or np.inf for one in drifts] or [np.nan])
        print(
            f"| {name}{' *' * (name in UNSEEN)} | {sum(one.false for one in quiet)} in "
            f"{sum(one.years for one in quiet):.0f} | "
            f"{len(soon)} of {len(steps)} ({len(soon) / max(len(steps), 1):.1%}) | "
            f"{sum(one.right for one in soon)} | "
            f"{len(year)} of {len(drifts)} ({len(year) / max(len(drifts), 1):.1%}) | "
            f"{np.median(late):.0f}, {np.quantile(late, 0.95, method='higher'):.0f} | "
            f"{sum(one.right for one in told)} of {len(told)} |"
        )


def by_sigma(outcomes: Sequence[Outcome], laws: dict[str, Law]) -> None:
    """Print how many drifts are found within a year, by how much a check scatters."""
    names = [f"{1000 * low:g} to {1000 * high:g} mm" for low, high in pairwise(BINS)]
    names[-1] = f"{1000 * BINS[-2]:g} mm and more"
    print("\n| drifts found within a year, σ of a check | " + " | ".join(names) + " |")
    print("| --- |" + " --- |" * len(names))
    for name in (*laws, "all of them"):
        cells = []
        for low, high in pairwise(BINS):
            own = [
                one.within_days is not None and one.within_days <= YEAR
                for one in outcomes
                if one.change == "drift" and one.law in (name, *(laws if name not in laws else ()))
                if low <= one.sigma < high
            ]
            cells.append(f"{sum(own)} of {len(own)}")
        print(f"| {name} | " + " | ".join(cells) + " |")


def recorded(seed: int, *, checks: int) -> Recorded | None:
    """Record a simulated site again and again, unmoved, every third time without its poles."""
    rng = np.random.default_rng([16, seed])
    pair = simulate_pair(SCENES[seed % 3], rng, noise=NOISE_MODELS["field"])
    answer = calibrate(pair.target, pair.source, options=Options(sensors=pair.sensors))
    if answer.T_target_source is None:
        return None
    stored = PoseEstimate(answer.T_target_source, answer.covariance, 0.0)
    rows, told, start = [], 0, datetime(2026, 1, 5, tzinfo=UTC)
    for k in range(checks):
        again = record_again(pair, rng, poles=k % 3 != 2)
        found = check(
            stored,
            again.target,
            again.source,
            options=Options(sensors=pair.sensors),
            uncertainty=answer.uncertainty,
        )
        codes = tuple(reason.code for reason in found.reasons)
        time = start + k * timedelta(days=7)
        arrays = (flat(each) for each in (found.step, found.covariance, found.random))
        row = CheckRow("site", time, found.status, found.used, codes, None, *arrays)
        told += row.is_usable
        rows.append(row)
    seen = [one for _, one in observed(rows)]
    chi2 = []
    for other in (False, True):
        own = [one for one in seen if one.other == other]
        if len(own) < 3:
            continue
        # Against their weighted mean: n checks leave 6 (n - 1) degrees of freedom.
        weights = [np.linalg.inv(one.random) for one in own]
        mean = np.linalg.solve(
            sum(weights), sum(W @ one.step for W, one in zip(weights, own, strict=True))
        )
        share = len(own) / (len(own) - 1.0)
        chi2 += [
            share * float((one.step - mean) @ W @ (one.step - mean))
            for W, one in zip(weights, own, strict=True)
        ]
    watched = watch(seen)
    return Recorded(seed, len(rows), told, chi2, watched.scale, len(watched.alarms))


def recorded_table(sites: Sequence[Recorded]) -> None:
    chi2 = np.array([value for site in sites for value in site.chi2])
    print(
        f"{len(sites)} sites, {sum(site.checks for site in sites)} checks of which "
        f"{sum(site.told for site in sites)} gave a step that counts, "
        f"{sum(site.alarms for site in sites)} alarms\n"
        f"χ² of a step against the mean of its site and way, random part alone: median "
        f"{np.median(chi2):.1f}, 95 % {np.quantile(chi2, 0.95):.1f}, largest {chi2.max():.1f} "
        "(χ² with 6 degrees of freedom: 5.3, 12.6)\n"
        f"scale of a site at the end: {min(site.scale for site in sites):.2f} to "
        f"{max(site.scale for site in sites):.2f}"
    )


ALARMS = {
    "drift of 1 mm a day": (0.001, 0.0),
    "drift of 5 mm a day": (0.005, 0.0),
    "step of 1 cm": (0.0, 0.01),
    "step of 3 cm": (0.0, 0.03),
    "none": (0.0, 0.0),
}
"""Movement a day, m, and at once."""


def says_moved(step: Array, covariance: Array) -> bool:
    """Whether a check says by itself that the site moved, as `movement.compare_poses` does."""
    is_chance = chdtrc(6, step @ np.linalg.solve(covariance, step)) >= FALSE_ALARM
    limit = upper_limit(step, covariance, BOUND_SIGMAS)
    return not (is_chance or limit.is_within(DEFAULT_TOLERANCE))


def alarmed(seed: int, *, change: str, sigma: float, lorries: float) -> tuple[int, float, float]:
    """Watch a site: false alarms before the change, years of these; how far it had moved, m."""
    rng = np.random.default_rng([17, seed, int(1e4 * sigma), int(1e3 * lorries)])
    sigmas = np.repeat([np.radians(0.01) * sigma / 0.002, sigma], 3)
    random, common = np.diag(sigmas**2), np.diag(sigmas**2) + 2.0 * floor()
    days = 20000.0 + 7.0 * np.arange(WEEKS) + rng.uniform(-0.2, 0.2, WEEKS)
    noise = sigmas * scatter(Law(lorries=lorries), rng)
    a_day, at_once = ALARMS[change]
    since = rng.uniform(days[12], days[40]) if change != "none" else days[-1]
    size = np.where(days > since, a_day * (days - since) + at_once, 0.0)
    steps = np.linalg.cholesky(common) @ rng.normal(size=6) + noise
    steps[:, 3:] += size[:, None] * direction(rng)
    covariance = random + common
    seen = watch(
        [
            Observed(float(day), step, random, common, moved=says_moved(step, covariance))
            for day, step in zip(days, steps, strict=True)
        ]
    )
    found = [event.found for event in seen.alarms]
    true = [k for k in found if days[k] > since]
    return len(found) - len(true), (since - days[0]) / YEAR, size[true[0]] if true else np.inf


def alarm_table(first: int, sites: int) -> None:
    """Print how far a site had moved at its first alarm."""
    print(
        "| change | σ of a check | lorries | found | moved by then: median, 90 %, most, mm "
        "| by 20 mm | false alarms in site-years |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for change, sigma, lorries in product(ALARMS, (0.001, 0.003), (0.0, 0.02)):
        seeds = range(first, first + sites)
        found = [alarmed(k, change=change, sigma=sigma, lorries=lorries) for k in seeds]
        false, years, moved = (np.array(each) for each in zip(*found, strict=True))
        mm = [f"{1000 * np.quantile(moved, q, method='higher'):.0f}" for q in (0.5, 0.9, 1.0)]
        cells = [f"{np.isfinite(moved).sum()} of {sites}", ", ".join(mm)]
        cells += [f"{(moved <= 0.02).sum()}"] if change.startswith("drift") else [""]
        print(
            f"| {change} | {1000 * sigma:g} mm | {lorries:.0%} | "
            + " | ".join(cells if change != "none" else [""] * 3)
            + f" | {false.sum()} in {years.sum():.0f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, default=200, help="of each law and change")
    parser.add_argument("--first", type=int, default=3200, help="first seed")
    parser.add_argument("--tune", action="store_true", help="the laws that set the constants")
    parser.add_argument("--alarms", action="store_true", help="drifts and steps, told how soon")
    parser.add_argument("--bound", action="store_true", help="how soon a drift can be told at all")
    parser.add_argument("--laws", nargs="*", help="some of them")
    parser.add_argument("--changes", nargs="*", default=["none", "step", "drift"])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--recorded", type=int, metavar="N", help="sites to simulate and check")
    parser.add_argument("--checks", type=int, default=12, help="of each of these")
    arguments = parser.parse_args()
    if arguments.bound:
        bound_table(arguments.first)
        return
    if arguments.alarms:
        alarm_table(arguments.first, arguments.sites)
        return
    if arguments.recorded:
        seeds = range(arguments.first, arguments.first + arguments.recorded)
        found = [recorded(seed, checks=arguments.checks) for seed in seeds]
        recorded_table([site for site in found if site is not None])
        return
    laws = TUNE if arguments.tune else STATE
    if arguments.laws:
        laws = {name: laws[name] for name in arguments.laws}
    seeds = range(arguments.first, arguments.first + arguments.sites)
    job = partial(run, laws=laws, changes=arguments.changes)
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for done, found in enumerate(pool.map(job, seeds, chunksize=4), start=1):
            outcomes += found
            if done % 20 == 0:
                print(f"{done} of {len(seeds)}", file=sys.stderr, flush=True)
    table(outcomes, laws)
    by_sigma(outcomes, laws)


if __name__ == "__main__":
    main()
