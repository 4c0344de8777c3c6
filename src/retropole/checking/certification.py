"""The field test of two LiDARs by the distances between poles, without any calibration.

After ISO 17123-9, whose idea it takes: two instruments measure the same targets, and the distances
between targets do not depend on where an instrument is. Each LiDAR's axes come from its
returns (`axes`), and are compared by `distances` that no rigid motion changes. See docs/check.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Literal

import msgspec
import numpy as np
from scipy.special import ndtri

from ..adjustment.axes import LidarAxes, find_axes
from ..alignment.origins import beam_origins
from ..base.bounded import Count, Number, Size
from ..base.datatypes import Array, Placement, Pole, Scan
from ..base.description import Site
from ..base.errors import Reason, Refusal
from ..base.quantities import counted
from ..hypotheses.correspondence import left_out, match_poles
from ..surfaces.scans import find_poles
from ..surfaces.static import check_poles
from .distances import (
    Measured,
    SpreadTest,
    Targets,
    compare_spread,
    measure,
    middles,
    spread_of_sweeps,
)


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Which poles of one placement are the same, and in which direction.

    Attributes
    ----------
    pairs
        ``((i, j), …)``: target pole ``i`` is source pole ``j``.
    target, source
        (K,) the poles themselves, in the order of the pairs.
    signs
        (K,) 1 where the direction of the source's pole is that of the target's, else -1.
    """

    pairs: tuple[tuple[int, int], ...]
    target: tuple[Pole, ...]
    source: tuple[Pole, ...]
    signs: Array

    def poles(self, lidar: int) -> tuple[Pole, ...]:
        """The poles of the target (0) or the source (1)."""
        return self.source if lidar else self.target

    def directions(self, lidar: int) -> Array:
        """(K, 3) their directions, with the sense that both LiDARs agree on."""
        directions = np.array([pole.direction for pole in self.poles(lidar)])
        return np.asarray(self.signs[:, None] * directions if lidar else directions)


def correspond(target: Sequence[Pole], source: Sequence[Pole]) -> Correspondence:
    """Match the poles that are the same, by their distances and angles alone.

    Poles up to half a metre from where the others place them are treated as the same:
    that they do not fit is for the test to find.

    Raises
    ------
    Refusal
        As `match_poles`.
    """
    candidates = []
    for match in match_poles(target, source):
        if match.exact:
            near = tuple((i, j) for i, j, _ in left_out(target, source, match))
            candidates.append((match, (*match.pairs, *near)))
    # Of equals the first, which fits best.
    match, pairs = max(candidates, key=lambda each: len(each[1]))
    own, others = tuple(target[i] for i, _ in pairs), tuple(source[j] for _, j in pairs)
    turned = np.array([pole.direction for pole in others]) @ match.T_target_source[:3, :3].T
    along = np.einsum("ki,ki->k", turned, np.array([pole.direction for pole in own]))
    return Correspondence(pairs, own, others, np.where(along < 0, -1.0, 1.0))


Verdict = Literal["pass", "partial", "fail", "refused"]
"""``partial``: what was tested passes, and some LiDARs are in no pair that could be tested."""

ALPHA = 0.05
"""Probability with which LiDARs that measure as stated fail: of all distances together, and of the
comparison of variances likewise."""

MIN_DISTANCES = 4
"""Least number of distances that a verdict rests on."""


class DistanceTest(msgspec.Struct, frozen=True):
    """The distance between two poles as both LiDARs have it, metres.

    Attributes
    ----------
    placement
        Index of the placement of the poles.
    poles
        Numbers of both poles in the target's detection.
    target_m, source_m, u_target_m, u_source_m
        As the target and as the source have it, and the standard uncertainty of each.
    random_target_m, random_source_m
        The part of that uncertainty that comes from the scatter of the returns.
    difference_m, u_end_m
        Target less source, and half of its standard uncertainty: that of one end of one of the
        distances, which has four ends in all.
    limit_m, passed
        Largest difference of either sign that passes, ``2 u z``, and whether it does.
    """

    placement: Count
    poles: tuple[Count, Count]
    target_m: Size
    source_m: Size
    u_target_m: Size
    u_source_m: Size
    random_target_m: Size
    random_source_m: Size
    difference_m: Number
    u_end_m: Size
    limit_m: Size
    passed: bool


class PolesSeen(msgspec.Struct, frozen=True):
    """How many poles of a placement each LiDAR sees, and how many are compared."""

    target: Count
    source: Count
    compared: Count


@dataclass(frozen=True, eq=False)
class FieldTest:
    """The field test of a pair of LiDARs.

    Attributes
    ----------
    status
        ``pass``, ``fail``, or ``refused`` where there are too few data.
    reasons
        Why it was refused, or else which placements are not compared.
    distances
        One test for each pair of poles of a placement.
    alpha, z
        Probability of a false alarm over all distances, and the quantile that it gives each;
        None if nothing was tested.
    spread
        The comparison of variances; None if the recordings do not repeat anything.
    poles
        What each LiDAR sees of each placement.
    """

    status: Verdict
    reasons: tuple[Reason, ...]
    distances: tuple[DistanceTest, ...]
    alpha: float
    z: float | None
    spread: SpreadTest | None
    poles: tuple[PolesSeen, ...]


def certify(
    placements: Sequence[Placement], *, radius: float, radius_sigma: float = 0.0
) -> FieldTest:
    """Test by the distances between poles whether two LiDARs measure as well as stated.

    Nothing is raised: what cannot be tested is ``refused``, with the reason.

    Parameters
    ----------
    placements
        What both recorded, and the poles found in it (`surfaces.scans.find_poles`).
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    """
    try:
        check_poles(placements)
    except Refusal as refusal:
        return _refused([_reason(refusal)], tuple(PolesSeen(0, 0, 0) for _ in placements))
    placements = beam_origins(placements).about(placements)
    found: list[tuple[int, Correspondence]] = []
    reasons: list[Reason] = []
    poles: list[PolesSeen] = []
    for k, placement in enumerate(placements):
        counts = len(placement.target.poles), len(placement.source.poles)
        try:
            both = correspond(placement.target.poles, placement.source.poles)
        except Refusal as refusal:
            prefix = f"placement {k + 1} is not compared: " if len(placements) > 1 else ""
            reasons.append(_reason(refusal, prefix))
            poles.append(PolesSeen(*counts, 0))
        else:
            found.append((k, both))
            poles.append(PolesSeen(*counts, len(both.pairs)))
    which = [
        (k, (each.pairs[i][0], each.pairs[j][0]))
        for k, each in found
        for i, j in combinations(range(len(each.pairs)), 2)
    ]
    if len(which) < MIN_DISTANCES:
        if found or len(placements) > 1:
            reasons.insert(0, _too_few(len(which)))
        return _refused(reasons, tuple(poles))
    used = tuple((placements[k], each) for k, each in found)
    seen = _seen(used, 0), _seen(used, 1)
    target, source = (_axes(each, radius, radius_sigma) for each in seen)
    on_target, on_source = _targets(used, (target, source))
    z = quantile(ALPHA, len(which))
    tests = compare((measure(target, on_target), measure(source, on_source)), which, z)
    spread = compare_spread(
        spread_of_sweeps(seen[0], target, on_target),
        spread_of_sweeps(seen[1], source, on_source),
        ALPHA,
    )
    passed = all(test.passed for test in tests) and (spread is None or spread.passed)
    status: Verdict = "pass" if passed else "fail"
    return FieldTest(status, tuple(reasons), tests, ALPHA, z, spread, tuple(poles))


def certify_site(
    site: Site, progress: Callable[[str], None] = lambda step: None
) -> tuple[tuple[tuple[int, int], FieldTest], ...]:
    """Test every pair of LiDARs of a site that recorded a placement together.

    Parameters
    ----------
    site
        Its LiDARs and what they recorded; nothing that was surveyed is used.
    progress
        Called with the name of each step.

    Returns
    -------
    tuple
        The indices of both LiDARs, and their test.
    """
    scans: list[list[Scan | None]] = []
    for lidar in site.lidars:
        progress(f"poles of {lidar.name}")
        search = partial(
            find_poles, sensor=lidar.sensor, threshold=lidar.threshold, radius=site.radius
        )
        scans.append([None if cloud is None else search(cloud) for cloud in lidar.clouds])
    tests = []
    for a, b in combinations(range(len(scans)), 2):
        placements = [
            Placement(target, source)
            for target, source in zip(scans[a], scans[b], strict=True)
            if target is not None and source is not None
        ]
        if placements:
            progress(f"{site.lidars[a].name} and {site.lidars[b].name}")
            answer = certify(placements, radius=site.radius, radius_sigma=site.radius_sigma)
            tests.append(((a, b), answer))
    return tuple(tests)


def quantile(alpha: float, tests: int) -> float:
    """z(1 − α'/2) of each of several tests, with ``α' = 1 − (1 − α)^(1/m)``.

    Of normal differences, however they are correlated, one or more then lies outside with a
    probability of at most α (Šidák 1967, Rectangular confidence regions for the means of
    multivariate normal distributions, J. Amer. Statist. Assoc. 62).
    """
    each = -np.expm1(np.log1p(-alpha) / tests)
    return float(-ndtri(each / 2))


def compare(
    measured: tuple[Measured, Measured], which: Sequence[tuple[int, tuple[int, int]]], z: float
) -> tuple[DistanceTest, ...]:
    """Compare the distances of both LiDARs one by one.

    Parameters
    ----------
    measured
        By the target and by the source.
    which
        Placement and poles of each.
    z
        Quantile of each test.
    """
    a, b = measured
    # Both measure the same poles: of what the radius changes, only the difference counts.
    square = a.standard_uncertainty**2 + b.standard_uncertainty**2 - 2.0 * a.radius * b.radius
    u = 0.5 * np.sqrt(np.maximum(square, 0.0))
    difference, limit = a.lengths - b.lengths, 2.0 * u * z
    return tuple(
        DistanceTest(
            placement=placement,
            poles=poles,
            target_m=float(a.lengths[k]),
            source_m=float(b.lengths[k]),
            u_target_m=float(a.standard_uncertainty[k]),
            u_source_m=float(b.standard_uncertainty[k]),
            random_target_m=float(np.sqrt(a.random[k, k])),
            random_source_m=float(np.sqrt(b.random[k, k])),
            difference_m=float(difference[k]),
            u_end_m=float(u[k]),
            limit_m=float(limit[k]),
            passed=bool(abs(difference[k]) <= limit[k]),
        )
        for k, (placement, poles) in enumerate(which)
    )


def _reason(refusal: Refusal, prefix: str = "") -> Reason:
    return Reason(refusal.code, prefix + refusal.message, refusal.values)


def _refused(reasons: Sequence[Reason], poles: tuple[PolesSeen, ...]) -> FieldTest:
    return FieldTest("refused", tuple(reasons), (), ALPHA, None, None, poles)


def _too_few(total: int) -> Reason:
    return Reason(
        "too_few_distances",
        f"{counted(total, 'distance')} between poles that both LiDARs see, {MIN_DISTANCES} are "
        "needed: four poles give 6, three give 3, two give 1, and the distances of placements are "
        "added",
        {"distances": total, "needed": MIN_DISTANCES},
    )


Seen = Sequence[tuple[Scan, tuple[Pole, ...]]]


def _seen(used: Sequence[tuple[Placement, Correspondence]], lidar: int) -> Seen:
    """What a LiDAR has of each placement: its scan, and the poles that are compared."""
    return [
        (placement.source if lidar else placement.target, each.poles(lidar))
        for placement, each in used
    ]


def _axes(seen: Seen, radius: float, radius_sigma: float) -> LidarAxes:
    return find_axes(
        [(pole, scan.cloud) for scan, poles in seen for pole in poles],
        sensor=seen[0][0].sensor,
        radius=radius,
        radius_sigma=radius_sigma,
    )


def _targets(
    used: Sequence[tuple[Placement, Correspondence]], axes: tuple[LidarAxes, LidarAxes]
) -> tuple[list[Targets], list[Targets]]:
    """Find for each LiDAR the axes that belong together, and the points on them to measure."""
    targets: tuple[list[Targets], list[Targets]] = [], []
    first = 0
    for _, each in used:
        index = first + np.arange(len(each.pairs))
        first += len(index)
        senses, reached = [], []
        for lidar, own in enumerate(axes):
            along = np.einsum("ki,ki->k", own.state.directions[index], each.directions(lidar))
            senses.append(np.where(along < 0, -1.0, 1.0))
            reached.append(middles(own.state, each.poles(lidar), index, senses[-1]))
        # Any way along the axes will do, as long as both go it: that to the middle of what is seen.
        offsets = np.asarray(np.mean(reached, axis=0))
        for lidar in (0, 1):
            targets[lidar].append(Targets(index, senses[lidar], offsets))
    return targets
