"""Sec. IV-A, trial by trial: ten draws of noise per set-up, and poles of several lengths."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from retropole.base.datatypes import Array
from retropole.checking.metrics import errors_of
from retropole.report.figures import BLUE, ORANGE
from retropole.simulation import EXACT, SimulatedPair, simulate_pair
from retropole.simulation.pairs import Arrangement, Recorders, record
from studies.paper.estimator import PAPER_E_RT, poles_of, solve
from studies.paper.exhibit import Cell, Exhibit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRIALS = 10
"""Draws of noise for each set-up (Sec. IV-A)."""

TRIAL_LENGTH = 2.0
"""Of the poles of the ten trials, metres: what a person can carry. The paper states none."""

POLE_LENGTHS = (1.0, 2.0, 6.0)
"""Lengths of poles that are compared, metres."""

MIN_RETURNS, MIN_RINGS = 6, 3
"""On each pole, of each LiDAR: fewer give no line, and the set-up is left out at every length."""

ESTIMATORS = ("the paper's estimator", "beam model")


def set_up(seed: int, length: float) -> SimulatedPair:
    """Draw a set-up of Sec. IV-A without noise, its poles of some length, metres.

    The same seed places LiDARs and axes alike at every length.
    """
    pair = simulate_pair("paper", np.random.default_rng(seed), noise=EXACT)
    poles = [replace(pole, length=length) for pole in pair.poles]
    poses = pair.T_world_target, pair.T_world_source
    at = Arrangement(pair.surroundings, poles, poses, pair.clear)
    recorders = Recorders(pair.sensors, pair.devices, EXACT, 1)
    return record(at, recorders, np.random.default_rng([seed, 2]))


def sees_both(pair: SimulatedPair) -> bool:
    """Whether both LiDARs have enough returns on both poles for lines."""
    first = len(pair.surroundings)
    for cloud, labels in zip((pair.target, pair.source), pair.labels, strict=True):
        assert cloud.ring is not None
        for k in range(len(pair.poles)):
            on = labels == first + k
            if on.sum() < MIN_RETURNS or len(np.unique(cloud.ring[on])) < MIN_RINGS:
                return False
    return True


def trial_errors(pair: SimulatedPair, seed: int, trials: int) -> Array:
    """Errors of both estimators in trials that differ in their isotropic noise.

    Returns
    -------
    Array
        (trials, 2, 3) rotation, rad, translation, metres, and e_rt, metres, of the paper's
        estimator and of the beam model; nan where that refuses.
    """
    errors = np.full((trials, 2, 3), np.nan)
    for trial in range(trials):
        rng = np.random.default_rng([seed, 1, trial])
        for k, estimate in enumerate(solve(pair, poles_of(pair, "isotropic", rng))):
            if estimate is not None:
                found = errors_of(estimate.T_target_source, pair.T_target_source)
                errors[trial, k] = found.rotation, found.translation, found.e_rt
    return errors


def ten_trials(setups: int) -> Exhibit:
    """Mean and standard deviation over ten trials, set-up by set-up."""
    seen = [(seed, pair) for seed in range(setups) if sees_both(pair := set_up(seed, TRIAL_LENGTH))]
    errors = {seed: trial_errors(pair, seed, TRIALS) for seed, pair in seen}
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(ESTIMATORS):
        spread = []
        for seed, each in errors.items():
            answered = each[np.isfinite(each[:, k, 2]), k] * (np.degrees(1.0), 1.0, 1.0)
            if len(answered) < 2:
                rows.append((seed, name, *[None] * 6, len(answered)))
                continue
            mean, sd = answered.mean(axis=0), answered.std(axis=0, ddof=1)
            spread.append(np.stack([mean, sd], axis=1).ravel())
            rows.append((seed, name, *map(float, spread[-1]), len(answered)))
        if spread:
            middle = map(float, np.median(spread, axis=0))
            rows.append(("median of set-ups", name, *middle, None))
    rows.sort(key=lambda row: isinstance(row[0], int))
    means = np.array([each[:, 0, 2].mean() for each in errors.values()])
    within = np.array([each[:, 0, 2].std(ddof=1) for each in errors.values()])
    words = "There is no such set-up."
    if len(means):
        words = (
            f"Set-ups differ more than trials: the mean e_rt of the paper's estimator lies between "
            f"{means.min():.3f} and {means.max():.3f} m, and below the {PAPER_E_RT} m of the paper "
            f"in {np.count_nonzero(means < PAPER_E_RT)} of {len(means)}; within a set-up it "
            f"scatters by {np.median(within):.3f} m, 1 σ, in the median."
        )
    header = ("set-up", "estimator")
    figures = ("rotation °", "translation m", "e_rt m")
    return Exhibit(
        "simulated_trials",
        f"Simulated error, {TRIALS} trials of each set-up",
        (
            *header,
            *(f"{name}, {of}" for name in figures for of in ("mean", "sd")),
            "answered trials",
        ),
        tuple(rows),
        f"Poles of {TRIAL_LENGTH:g} m, isotropic noise of 6 mm, from the right hypothesis; the "
        "beam model is told that the LiDARs have no systematic errors. Set-ups "
        f"are seeds 0 to {setups - 1}, of which {len(seen)} show both poles to both LiDARs, with "
        f"{MIN_RETURNS} returns on {MIN_RINGS} rings. The paper gives no rotation or translation "
        f"error of its own, and of e_rt {PAPER_E_RT} m. {words}",
        lambda figure: _draw_trials(figure, errors),
        (12.0, 4.5),
    )


def pole_lengths(setups: int) -> Exhibit:
    """Compare e_rt of poles of several lengths, over the set-ups that are seen at all of them."""
    found: dict[float, list[Array]] = {length: [] for length in POLE_LENGTHS}
    used = 0
    for seed in range(setups):
        pairs = [set_up(seed, length) for length in POLE_LENGTHS]
        if all(map(sees_both, pairs)):
            used += 1
            for length, pair in zip(POLE_LENGTHS, pairs, strict=True):
                found[length].append(trial_errors(pair, seed, 1)[0, :, 2])
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(ESTIMATORS):
        for length, each in found.items():
            errors = np.array(each).reshape(-1, len(ESTIMATORS))[:, k]
            refused = int(np.count_nonzero(np.isnan(errors)))
            errors = np.where(np.isnan(errors), np.inf, errors)
            if not len(errors):
                rows.append((name, length, None, None, refused))
                continue
            figures = float(np.median(errors)), float(np.quantile(errors, 0.9, method="higher"))
            rows.append((name, length, *figures, refused))
    return Exhibit(
        "simulated_pole_length",
        "Simulated e_rt by the length of the poles",
        ("estimator", "length m", "median e_rt m", "90 % m", "refused"),
        tuple(rows),
        f"The {used} of {setups} set-ups (seeds from 0) in which both LiDARs see both poles with "
        f"{MIN_RETURNS} returns on {MIN_RINGS} rings at every length; one draw of isotropic noise "
        "of 6 mm; the beam model is told that the LiDARs have no systematic errors. Centres of the "
        "poles lie in z = 0, as in the paper, which states no length. "
        "Nearly parallel poles that the beam model refuses count as infinite.",
    )


def _draw_trials(figure: Figure, errors: dict[int, Array]) -> None:
    """Draw every trial's e_rt above its set-up, set-ups in the order of the paper's estimator."""
    order = sorted(errors, key=lambda seed: float(np.median(errors[seed][:, 0, 2])))
    axes = figure.subplots()
    shades = ((ORANGE, -0.15, "the paper's estimator"), (BLUE, 0.15, "beam model"))
    for k, (color, shift, name) in enumerate(shades):
        for at, seed in enumerate(order):
            each = errors[seed][:, k, 2]
            each = each[np.isfinite(each)]
            label = name if at == 0 else None
            axes.plot(np.full(len(each), at + shift), each, "o", ms=3, color=color, alpha=0.5)
            if len(each) > 1:
                axes.errorbar(
                    at + shift,
                    each.mean(),
                    each.std(ddof=1),
                    color=color,
                    fmt="_",
                    ms=9,
                    lw=1.5,
                    label=label,
                )
    axes.axhline(PAPER_E_RT, color="k", lw=1, label="reported in the paper")
    axes.set(yscale="log", ylabel="e_rt, m", xlabel="set-up (seed), by the paper's estimator")
    axes.set_xticks(range(len(order)), [str(seed) for seed in order], fontsize=7)
    axes.legend(fontsize=8)
