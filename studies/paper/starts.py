"""Fig. 4: the eight starts of two poles on two, and where the least squares end from each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, Pole
from retropole.extraction.poles import extract_poles
from retropole.hypotheses.correspondence import pair_starts
from retropole.report.figures import BLUE, GREY, ORANGE
from retropole.simulation import simulate_pair
from studies.paper.choosing import EXAMPLE_SEED
from studies.paper.estimator import align_poles
from studies.paper.exhibit import Exhibit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = "abcdefgh"
"""Of the eight, the exact ones first; a is right."""

SAME_RMS = 1.01
"""Ends whose rms is less than so many times the least fit alike: the exact ones do to rounding."""

SAME_ROTATION, SAME_TRANSLATION = float(np.radians(5.0)), 0.5
"""Ends that differ by less are one optimum, rad and metres: exact ones are 180° apart."""


@dataclass(frozen=True, eq=False)
class End:
    """Where the least squares of eq. 1–2 end from one start.

    Attributes
    ----------
    order
        Which source pole goes to the first and to the second target pole.
    T_target_source
        (4, 4) pose.
    rms
        Of the points' distances from their lines, metres.
    exact
        Whether no other start of the eight ends in a better fit.
    """

    order: tuple[int, int]
    T_target_source: Array
    rms: float
    exact: bool


Ends = tuple[tuple[list[Pole], list[Pole]], list[End]]
"""The two poles of target and source, and the eight ends, best fit first, a the right one."""


def solve_starts(target: list[Pole], source: list[Pole]) -> list[End]:
    """Solve the eight starts of two poles on two, the best fit first.

    Raises
    ------
    Refusal
        ``parallel_poles`` or ``degenerate_poles``.
    """
    lines = [(pole.point, pole.direction) for pole in target]
    starts = pair_starts((target[0], target[1]), (source[0], source[1]))
    fits = [(order, align_poles(lines, [source[k].xyz for k in order], T)) for T, order in starts]
    limit = SAME_RMS * min(fit.rms for _, fit in fits)
    ends = [End(order, fit.T_target_source, fit.rms, fit.rms <= limit) for order, fit in fits]
    return sorted(ends, key=lambda end: end.rms)


def eight_ends(seed: int) -> Ends | None:
    """Solve all eight starts of a simulated corridor; None where a LiDAR finds other than two."""
    pair = simulate_pair("corridor", np.random.default_rng(seed))
    target, source = (list(extract_poles(cloud).poles) for cloud in (pair.target, pair.source))
    if len(target) != 2 or len(source) != 2:
        return None

    def off(end: End) -> tuple[bool, float]:
        angle = se3.difference(end.T_target_source, pair.T_target_source).rotation
        return not end.exact, angle if end.exact else end.rms

    return (target, source), sorted(solve_starts(target, source), key=off)


def different(ends: list[End]) -> int:
    """Count the optima among ends: those nearer than `SAME_ROTATION` are one."""
    kept: list[End] = []
    for end in ends:
        apart = (se3.difference(end.T_target_source, one.T_target_source) for one in kept)
        if all(d.rotation > SAME_ROTATION or d.translation > SAME_TRANSLATION for d in apart):
            kept.append(end)
    return len(kept)


def eight_starts(seeds: int) -> Exhibit:
    """Draw the poles of both LiDARs where each of the eight starts ends (Fig. 4), and count."""
    example = eight_ends(EXAMPLE_SEED)
    assert example is not None
    first = example[1][0].T_target_source
    rows = tuple(
        (
            name,
            ", ".join(f"{i}–{j}" for i, j in enumerate(end.order)),
            end.rms,
            "yes" if end.exact else "no",
            float(np.degrees(se3.difference(end.T_target_source, first).rotation)),
        )
        for name, end in zip(NAMES, example[1], strict=True)
    )
    found = [ends for seed in range(seeds) if (ends := eight_ends(seed)) is not None]
    exact = [[end for end in ends if end.exact] for _, ends in found]
    four = sum(different(each) == 4 for each in exact)
    only = sum(len(each) == 4 for each in exact)
    ratios = [end.rms / ends[0].rms for _, ends in found for end in ends if not end.exact]
    further = sum(map(len, exact)) - 4 * len(found)
    worse = ""
    if ratios:
        worse = (
            f" (rms {np.median(ratios):.1f} times theirs in the median, {min(ratios):.1f} least)"
        )
    return Exhibit(
        "fig4_hypotheses",
        "Fig. 4: the eight starts of two poles on two poles, and where they end",
        ("hypothesis", "pairs, target–source", "rms on the poles m", "exact", "rotation from a, °"),
        rows,
        "Two skew lines that are not perpendicular have four exact matches: the identity, and the "
        "rotations by 180° about their common perpendicular and about the two bisectors of their "
        f"directions. Drawn is the corridor of seed {EXAMPLE_SEED}. Of {seeds} corridors (seeds "
        f"from 0), {len(found)} show two poles to both LiDARs. In {four} the best ends are four "
        f"different poses. In {only} the other four starts, which pair the angle of the poles with "
        f"its supplement, all end in worse optima; of all {4 * len(found)} other starts "
        f"{len(ratios)} do{worse}, and {further} run on into one of the four exact matches.",
        lambda figure: _draw(figure, *example),
        (12.0, 6.8),
    )


def _draw(figure: Figure, poles: tuple[list[Pole], list[Pole]], ends: list[End]) -> None:
    """Draw the poles of both LiDARs where each start ends, the exact ones above."""
    target, source = poles
    for k, (name, end) in enumerate(zip(NAMES, ends, strict=True)):
        axes: Any = figure.add_subplot(2, 4, k + 1, projection="3d")
        T = end.T_target_source
        for i, j in enumerate(end.order):
            ours, theirs = target[i], source[j]
            middle = se3.apply(T, theirs.point[None])[0]
            lean = T[:3, :3] @ theirs.direction
            drawn = ours.point + np.outer([-1.0, 1.0], ours.direction)
            matched = middle + np.outer([-1.0, 1.0], lean)
            # Lines have no ends: poles that are offset along themselves match too, and the thin
            # line shows it.
            along = (np.concatenate([drawn, matched]) - ours.point) @ ours.direction
            line = ours.point + np.outer([along.min(), along.max()], ours.direction)
            axes.plot(*line.T, color=GREY, lw=0.8)
            axes.plot(*drawn.T, color=BLUE, lw=3, label=f"target {i}")
            axes.plot(*matched.T, "--", color=ORANGE, lw=2, label=f"source {j}")
        for pose, color in ((np.eye(4), BLUE), (T, ORANGE)):
            for column in range(3):
                tip = pose[:3, 3] + 0.8 * pose[:3, column]
                axes.plot(*np.stack([pose[:3, 3], tip]).T, color=color, lw=2)
        kind = ("exact, right" if k == 0 else "exact") if end.exact else "worse"
        axes.set_title(f"{name}: {kind}, rms {end.rms:.3f} m", fontsize=10, y=0.97)
        axes.locator_params(nbins=5)
        axes.set_box_aspect((1, 1, 1))
        axes.axis("equal")
        axes.tick_params(labelsize=6, pad=-2)
        if k == 0:
            figure.legend(loc="outside lower center", ncols=4, fontsize=9)
