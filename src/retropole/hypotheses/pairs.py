"""The hypotheses of each pair of LiDARs: poses under which the poles of both can be the same.

A pose of two LiDARs is valid for all placements, so the matches of all placements are combined: the
same pose from several placements is one hypothesis. The scene scores each once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from ..base.datatypes import Array, Hypothesis, Match
from ..base.errors import Reason, Refusal
from ..surfaces.scans import why_few_poles
from ..surfaces.visibility import OVERLAP_DISTANCE, View, compare_views
from .candidate_confirmation import MAX_CONFIRMED_VIOLATION
from .choice import LEAST_OVERLAP, MIN_OVERLAP, check_overlap, is_as_possible
from .correspondence import match_poles
from .placements import AGREE_ANGLE, AGREE_DISTANCE
from .scans import SiteScans, Views

SPARSE, SPARSE_ERROR = 8, 0.03
"""First one in this many of the points is compared, and all of them if the first result may be off
by this much. Of 1,200 hypotheses of 8 LiDARs their scores were off by 0.006 (RMS), by at most
0.025."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two LiDARs and their hypotheses, the best score first.

    Attributes
    ----------
    lidars
        Indices, the lower first.
    hypotheses
        Exact ones only; none if they have no two poles in common.
    overlaps
        Whether the scenes overlap under the best, so that they can be used.
    refusal
        Why there is no hypothesis; None if there is one.
    by_place
        Whether the surroundings give a part of the pose that one pole, or parallel ones, do not
        determine.
    """

    lidars: tuple[int, int]
    hypotheses: tuple[Hypothesis, ...]
    overlaps: bool
    refusal: Reason | None = None
    by_place: bool = False

    @property
    def standing(self) -> tuple[Hypothesis, ...]:
        """Hypotheses that are not ruled out by the scene."""
        return tuple(each for each in self.hypotheses if each.stands)

    @cached_property
    def possible(self) -> tuple[Hypothesis, ...]:
        """Hypotheses that the scene does not rule out, even if it favours others by far."""
        return tuple(each for each in self.hypotheses if each.possible)

    @cached_property
    def _rotations(self) -> Array:
        """(H, 9) of those that are possible."""
        return np.array([each.T[:3, :3].ravel() for each in self.possible]).reshape(-1, 9)

    def at(self, T: Array, points: Array) -> Hypothesis | None:
        """Find the possible hypothesis that equals a pose (4, 4), with points (N, 3) of the
        second."""
        # Called a hundred thousand times, mostly without a result: all angles at once.
        turned = self._rotations @ T[:3, :3].ravel() >= 1.0 + 2.0 * np.cos(AGREE_ANGLE)
        near = [
            each
            for each in (self.possible[k] for k in np.flatnonzero(turned))
            if is_same_pose(T, each.T, points)
        ]
        return max(near, key=lambda each: (each.stands, each.evidence, each.score), default=None)


def is_same_pose(T: Array, other: Array, points: Array, slack: float = 1.0) -> bool:
    """Whether two poses are the same up to the uncertainty from the poles of one placement.

    Parameters
    ----------
    T, other
        (4, 4) each.
    points
        (N, 3) where the poles are.
    slack
        Factor on the difference that the uncertainty of the poles allows.
    """
    # Called a hundred thousand times: the angle by the trace, and positions only if it is small.
    cosine = (float(np.vdot(T[:3, :3], other[:3, :3])) - 1.0) / 2.0
    if cosine < np.cos(slack * AGREE_ANGLE):
        return False
    away = points @ (T[:3, :3] - other[:3, :3]).T + (T[:3, 3] - other[:3, 3])
    return float(np.einsum("ni,ni->n", away, away).max()) <= (slack * AGREE_DISTANCE) ** 2


def find_pairs(scans: SiteScans, views: Views) -> tuple[Pair, ...]:
    """Find the hypotheses of every pair of LiDARs."""
    return tuple(
        _pair(scans, views, first, second)
        for first, second in combinations(range(len(scans.by_lidar)), 2)
    )


def poles_of(scans: SiteScans, lidar: int) -> Array:
    """(N, 3) middles of all poles that a LiDAR sees, in its frame; its origin without any."""
    points = [pole.point for scan in scans.used(lidar) for pole in scan.poles]
    return np.array(points) if points else np.zeros((1, 3))


def _pair(scans: SiteScans, views: Views, first: int, second: int) -> Pair:
    """Match the poles of every placement, combine equal poses, and score them by the scene."""
    found: list[tuple[Match, dict[int, int]]] = []
    reason: Reason | None = None
    at = poles_of(scans, second)
    for placement in range(len(scans.by_lidar[first])):
        target, source = scans.poles(first, placement), scans.poles(second, placement)
        if min(len(target), len(source)) < 2:
            continue
        try:
            matches = match_poles(target, source)
        except Refusal as refusal:
            reason = Reason(refusal.code, refusal.message, refusal.values)
            continue
        for match in matches:
            if match.exact:
                _add(found, match, placement, at)
    if not found:
        return Pair((first, second), (), False, reason or _too_few_poles(scans, (first, second)))
    return _scored((first, second), found, views.first(first), views.first(second))


def _too_few_poles(scans: SiteScans, lidars: tuple[int, int]) -> Reason:
    """Report that two LiDARs have no two poles in common, and why, if a recording shows it."""
    message = "in no placement do both LiDARs see the same two poles"
    for which, i in zip(("first", "second"), lidars, strict=True):
        whys = [why_few_poles(scan) for scan in scans.by_lidar[i] if scan and len(scan.poles) < 2]
        if any(whys):
            message += f"; of the {which} LiDAR, {next(filter(None, whys))}"
    return Reason("too_few_poles", message, {})


def _add(
    found: list[tuple[Match, dict[int, int]]], match: Match, placement: int, at: Array
) -> None:
    """Add a match to the pose that it equals, or as another one; more poles determine a pose
    better."""
    T = match.T_target_source
    for k, (known, poles) in enumerate(found):
        if is_same_pose(T, known.T_target_source, at):
            better = known if len(known.pairs) >= len(match.pairs) else match
            found[k] = (better, {placement: len(match.pairs), **poles})
            return
    found.append((match, {placement: len(match.pairs)}))


def _scored(
    lidars: tuple[int, int],
    found: Sequence[tuple[Match, dict[int, int]]],
    target: View | None,
    source: View | None,
) -> Pair:
    assert target is not None
    assert source is not None
    some = [replace(view, points=view.points[::SPARSE]) for view in (target, source)]
    rough = [_by_scene(match, poles, *some) for match, poles in found]
    first = max(rough, key=lambda each: each.score)
    first = _by_scene(first.match, first.poles, target, source)
    scored = [
        _by_scene(each.match, each.poles, target, source) if _may_remain(each, first) else each
        for each in rough
    ]
    scored.sort(key=lambda each: -each.score)
    best = scored[0]
    hypotheses = tuple(
        replace(
            each,
            stands=each is best or _is_not_ruled_out(each, best),
            possible=each is best or _is_possible(each, best),
        )
        for each in scored
    )
    return Pair(lidars, hypotheses, _overlaps(best))


def _by_scene(match: Match, poles: Mapping[int, int], target: View, source: View) -> Hypothesis:
    seen = compare_views(target, source, match.T_target_source, within=OVERLAP_DISTANCE)
    return Hypothesis(
        match,
        None,
        None,
        seen.overlap,
        seen.free_space_violation,
        seen.overlap - seen.free_space_violation,
        seen.covisible_overlap,
        poles=poles,
    )


def _overlaps(best: Hypothesis) -> bool:
    try:
        check_overlap(best)
    except Refusal:
        return False
    return True


def _is_not_ruled_out(each: Hypothesis, best: Hypothesis) -> bool:
    """Whether the scene does not rule out a hypothesis, as in `choice` for one pair.

    Scenes that do not overlap distinguish no poses.
    """
    return (_is_possible if best.overlap < LEAST_OVERLAP else is_as_possible)(each, best)


def _may_remain(each: Hypothesis, best: Hypothesis) -> bool:
    """Whether the whole scene may not rule out a hypothesis, judged by a part of the points."""
    at_best = replace(
        each,
        overlap=each.overlap + SPARSE_ERROR,
        free_space_violation=each.free_space_violation - SPARSE_ERROR,
        score=each.score + 2 * SPARSE_ERROR,
    )
    return _is_not_ruled_out(at_best, best) or _is_possible(at_best, best)


def _is_possible(each: Hypothesis, best: Hypothesis) -> bool:
    uncontradicted = (
        each.free_space_violation <= best.free_space_violation + MAX_CONFIRMED_VIOLATION
    )
    return uncontradicted and each.score >= best.score - MIN_OVERLAP
