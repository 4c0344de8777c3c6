"""Which pole is which, and which way round: every rigid match of two sets of lines.

Pairs of poles of one shape are laid on each other in all ways (`line_pairs`), all at once; of what
fits exactly, every other pole that falls into place is taken in, and solved with them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, Match, Pole
from ..base.errors import Refusal
from ..base.quantities import counted
from .budget import Share
from .distinct import distinct
from .extension import EXTENSION_RMS, exact_part, extended, solved_each
from .line_pairs import direction_sigma, line_pair, pair_ways

MIN_ANGLE = np.radians(5.0)
"""Pairs of poles nearer to parallel than this start no hypothesis: along their common direction a
pose error grows with 1/sin(angle), which is more than tenfold here."""

ANGLE_TOLERANCE = np.radians(3.0)
"""By how much two LiDARs may disagree on the angle between two poles, beyond three sigma."""

DISTANCE_TOLERANCE = 0.08
"""The same for the distance between two poles, metres. Each LiDAR sees a line up to 16 mm in front
of the axis of a 2 cm pole, towards itself."""

MAX_PAIR_MATCHES = 200
"""How many pairs of pole pairs are tried, the most alike first."""

ENOUGH_PAIR_MATCHES = 72
"""So many are tried at once, twice what four poles have on each side, and no more where one of
them is of a match of three poles or more. Beside a row of posts hundreds are alike, and the right
one is among the first."""

MAX_HYPOTHESES = 16
"""How many hypotheses go on to be scored by the scene: most poles, least expected error first."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """All P pairs of poles of one LiDAR that are far enough from parallel, and their shapes.

    (P, 4, 4) and (P,) each: as `LinePair` has them, and 1 σ of the angle, rad, and how far the
    common perpendicular is from the poles, metres.
    """

    index: list[tuple[int, int]]
    frame: list[Array]
    angle: Array
    distance: Array
    handedness: Array
    sigma: Array
    lever: Array


def all_pairs(poles: Sequence[Pole]) -> Pairs:
    """Measure every pair of poles that are not nearly parallel."""
    index, frames, rows = [], [], []
    for i, j in combinations(range(len(poles)), 2):
        first, second = poles[i], poles[j]
        if _angle_between(first.direction, second.direction) < MIN_ANGLE:
            continue
        pair = line_pair(first.point, first.direction, second.point, second.direction)
        sigma = float(np.hypot(direction_sigma(first), direction_sigma(second)))
        # The common perpendicular of leaning poles can lie metres beyond what is seen of them;
        # there an error of direction moves the feet by that lever.
        feet = np.linalg.norm(pair.frame[:3, 3] - np.stack([first.point, second.point]), axis=1)
        index.append((i, j))
        frames.append(pair.frame)
        rows.append((pair.angle, pair.distance, pair.handedness, sigma, float(feet.max())))
    return Pairs(index, frames, *np.array(rows).reshape(-1, 5).T)


def _alike(target: Pairs, source: Pairs) -> list[tuple[int, int]]:
    """Rows of the pairs that agree in angle, distance and hand, within noise; most alike first."""
    sigma = np.hypot(target.sigma[:, None], source.sigma[None])
    angle_gap = np.abs(target.angle[:, None] - source.angle[None])
    angle_room = ANGLE_TOLERANCE + 3 * sigma
    room = DISTANCE_TOLERANCE + 3 * sigma * np.maximum(target.lever[:, None], source.lever[None])
    distance_gap = np.abs(target.distance[:, None] - source.distance[None])
    hand_gap = np.abs(target.handedness[:, None] - source.handedness[None])
    # The bisectors change roles at 90°, and with them the handedness; only then let it pass.
    right_angle = np.maximum(target.angle[:, None], source.angle[None]) > np.pi / 2 - angle_room
    fits = (angle_gap <= angle_room) & (distance_gap <= room)
    fits &= right_angle | (hand_gap <= 2 * room)
    rows, columns = np.nonzero(fits)
    misfit = (angle_gap / angle_room + distance_gap / room)[rows, columns]
    best = np.argsort(misfit, kind="stable")
    return [(int(rows[k]), int(columns[k])) for k in best]


def are_alike(poles: Sequence[Pole], others: Sequence[Pole]) -> bool:
    """Whether two of some poles may, within noise, stand to each other as two of the others do."""
    return bool(_alike(all_pairs(poles), all_pairs(others)))


def _angle_between(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def widest_angle(directions: Sequence[Array]) -> float:
    """Largest angle between any two directions (3,) of poles, radians; 0 for fewer than two."""
    return max((_angle_between(a, b) for a, b in combinations(directions, 2)), default=0.0)


class EveryMatch(NamedTuple):
    """Matches, the best first, and how many of the pairs of poles that are alike were tried."""

    matches: list[Match]
    laid: Share


def match_poles(
    target: Sequence[Pole], source: Sequence[Pole], count: int | None = None, part: bool = False
) -> list[Match]:
    """Find the rigid matches of the source poles onto the target poles, as `every_match` does.

    Returns
    -------
    list of Match
        Exact ones, most poles, least expected error first; at most `MAX_HYPOTHESES`.
    """
    return every_match(target, source, count, part).matches[:MAX_HYPOTHESES]


def every_match(
    target: Sequence[Pole], source: Sequence[Pole], count: int | None = None, part: bool = False
) -> EveryMatch:
    """Find every rigid match of the source poles onto the target poles.

    With two poles on each side these are the eight local optima of the paper, the exact ones
    first. With more, every pair of pairs that agrees in angle, distance and handedness starts a
    match, which takes in all other poles that fall into place and is solved with them together.

    Parameters
    ----------
    target, source
        Poles of the two LiDARs, each in its own frame.
    count
        How many poles both LiDARs see, where that is known: only matches of so many are kept.
    part
        Whether pairs that others do not fit are left out of a match, as where poles are doubtful:
        a thing near a pole lies near another, too, under the right pose. Otherwise such a match
        is inexact.

    Returns
    -------
    EveryMatch
        Exact ones, most poles, least expected error first.

    Raises
    ------
    Refusal
        ``too_few_poles``, ``parallel_poles``, ``no_match`` where no pair of poles of one LiDAR
        has the shape of a pair of the other, or ``pole_count`` where they agree, but not
        ``count`` of them.
    """
    _check_poles(target, source, count or 2)
    pairs_target, pairs_source = all_pairs(target), all_pairs(source)
    every = _alike(pairs_target, pairs_source)
    alike = every[:MAX_PAIR_MATCHES]
    laid = Share(len(alike), len(every))
    found: list[tuple[Match, Match]] = []
    for k in range(0, len(alike), ENOUGH_PAIR_MATCHES):
        found += _matched(
            target, source, alike[k : k + ENOUGH_PAIR_MATCHES], pairs_target, pairs_source
        )
        if any(len(whole.pairs) > 2 and whole.exact for _, whole in found):
            laid = Share(len(every), len(every))  # the others are not needed
            break
    # Where none is exact, one of three or more may have moved: the others still agree.
    if part or not any(whole.exact for _, whole in found):
        matches = [exact_part(target, source, first, whole) for first, whole in found]
    else:
        matches = [whole for _, whole in found]
    matches = distinct(matches, np.array([pole.point for pole in source]))
    if not any(match.exact for match in matches):
        raise Refusal(
            "no_match",
            f"none of the {counted(len(target), 'pole')} of the target and {len(source)} of the "
            f"source agree "
            "in angle and distance: the LiDARs do not see the same two poles, or one moved; see "
            "which poles were taken with 'retropole detect'",
            {"poles_target": len(target), "poles_source": len(source)},
        )
    agreeing = len(matches[0].pairs)
    matches = [match for match in matches if count in (None, len(match.pairs))]
    if not matches:
        raise Refusal(
            "pole_count",
            f"{counted(agreeing, 'pole agrees', 'poles agree')} between the LiDARs where "
            f"{count} were asked for; see which "
            "with 'retropole detect', and cover or remove what is no pole",
            {"agreeing": agreeing, "asked": int(count or 0)},
        )
    return EveryMatch(matches, laid)


def _matched(
    target: Sequence[Pole],
    source: Sequence[Pole],
    alike: Sequence[tuple[int, int]],
    pairs_target: Pairs,
    pairs_source: Pairs,
) -> list[tuple[Match, Match]]:
    """Lay pairs of poles on each other in all ways, and take in the other poles that then fit.

    Returns
    -------
    list of (Match, Match)
        Of two poles, and of all that fall into place; of more than two and two only exact ones.
    """
    ways = {column: pair_ways(_both(source, pairs_source.index[column])) for _, column in alike}
    pairs, starts = [], []
    for row, column in alike:
        (i, j), both = pairs_target.index[row], pairs_source.index[column]
        for way, (first, second) in ways[column]:
            pairs.append(((i, both[first]), (j, both[second])))
            starts.append(pairs_target.frame[row] @ way)
    twos = solved_each(target, source, pairs, starts)
    if len(target) == len(source) == 2:
        return [(two, two) for two in twos]
    twos = [two for two in twos if two.exact]
    wider = [extended(target, source, two.T_target_source, EXTENSION_RMS) for two in twos]
    grown = [k for k, two in enumerate(twos) if {*two.pairs} < {*wider[k]}]
    starts = [twos[k].T_target_source for k in grown]
    wholes = list(twos)
    for k, whole in zip(
        grown, solved_each(target, source, [wider[k] for k in grown], starts), strict=True
    ):
        wholes[k] = whole
    return list(zip(twos, wholes, strict=True))


def _both(poles: Sequence[Pole], pair: tuple[int, int]) -> tuple[Pole, Pole]:
    return poles[pair[0]], poles[pair[1]]


def _check_poles(target: Sequence[Pole], source: Sequence[Pole], needed: int) -> None:
    for name, poles in (("target", target), ("source", source)):
        if len(poles) < needed:
            raise Refusal(
                "too_few_poles",
                f"the {name} LiDAR sees {len(poles)} pole{'s' * (len(poles) != 1)}, {needed} are "
                "needed; check the tape and the threshold with 'retropole detect'",
                {"lidar": name, "poles": len(poles), "needed": needed},
            )
    for name, poles in (("target", target), ("source", source)):
        angle = widest_angle([pole.direction for pole in poles])
        if angle < MIN_ANGLE:
            raise Refusal(
                "parallel_poles",
                f"the poles seen by the {name} LiDAR are {np.degrees(angle):.1f}° apart; lean one "
                "by 15° or more against the other",
                {"lidar": name, "angle_deg": float(np.degrees(angle))},
            )
