"""Correspondence and direction of the poles: every rigid match of two sets of lines.

Pairs of poles of the same shape are aligned in all ways, all at once; to exact matches
every other pole that coincides is added, and all are solved together.

Matches that give nearly the same pose are one. A line has no direction and two poles have no names,
so a pair of poles fits another in 2 × 4 ways (Xue et al. 2019, Fig. 4). Each way has a start in
closed form: the bisectors and the common perpendicular of two skew lines make a frame, the middle
of the common perpendicular its origin, and the two frames are aligned. Of the eight, four are
exact: the symmetry group of the lines is the identity and the half turns about the common
perpendicular and about the two bisectors (the Klein four-group). The other four pair an angle with
its supplement, so they are exact only where the poles are perpendicular and cross.

Also: which further poles a match of two includes, which it leaves out, and how well it fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..alignment.point_to_line import Lines, align_each, equivalent_points
from ..base import se3
from ..base.datatypes import Array, Match, Pole
from ..base.errors import Refusal
from ..base.quantities import counted
from ..extraction.acceptance_shape import MAX_CONFIRMED_RMS
from .placements import Share

SAME_POSE_ANGLE, SAME_POSE_DISTANCE = np.radians(10.0), 0.5
"""Matches nearer to each other than this, rad and m, are one."""


def _expected_error(match: Match) -> float:
    """Roughly how far a match may put a point 10 m away, metres: residual times lever."""
    variance = np.diag(np.linalg.inv(match.information))
    lever = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
    return float(max(match.pole_rms, 1e-6) * np.sqrt(np.sum(lever**2 * variance)))


def distinct(matches: list[Match], source_points: Array) -> list[Match]:
    """Sort matches, most poles and least expected error first, and keep one of each pose.

    The right pose and the wrong ones differ by half a turn; nearer ones are the same pose by
    other poles.
    """
    kept: list[Match] = []
    # 1 + 2 cos is the trace of R₁ᵀ R₂, the sum of the products of their entries.
    least = 1 + 2 * np.cos(SAME_POSE_ANGLE)
    rotations = np.zeros((len(matches), 9))
    places = np.zeros((len(matches), len(source_points), 3))
    for match in sorted(matches, key=lambda m: (not m.exact, -len(m.pairs), _expected_error(m))):
        k, T = len(kept), match.T_target_source
        rotations[k], places[k] = T[:3, :3].reshape(-1), se3.apply(T, source_points)
        similar = np.flatnonzero(rotations[:k] @ rotations[k] > least)
        apart = np.linalg.norm(places[similar] - places[k], axis=2).max(axis=1)
        if not np.any(apart < SAME_POSE_DISTANCE):
            kept.append(match)
    return kept


def same_pose(one: Match, other: Match, source_points: Array) -> bool:
    """Whether two matches put the source, with points (N, 3), at nearly the same position."""
    apart = se3.difference_at(one.T_target_source, other.T_target_source, source_points)
    return apart.rotation < SAME_POSE_ANGLE and apart.translation < SAME_POSE_DISTANCE


@dataclass(frozen=True, eq=False)
class LinePair:
    """The invariants of two skew lines under rigid motion, and the frame that moves with them.

    Attributes
    ----------
    angle
        Between the lines, in (0, π/2], radians.
    distance
        Along the common perpendicular, metres.
    handedness
        Sign of the screw from one line to the other, times `distance`: no proper motion changes it.
    frame
        (4, 4) bisector, other bisector, common perpendicular; origin midway between the lines.
    """

    angle: float
    distance: float
    handedness: float
    frame: Array


def line_pair(p1: Array, n1: Array, p2: Array, n2: Array) -> LinePair:
    """Measure two lines, with ``n1`` and ``n2`` directed as given.

    Parameters
    ----------
    p1, n1, p2, n2
        (3,) a point and the unit direction of each line.

    Raises
    ------
    Refusal
        ``parallel_poles`` if the lines have no unique common perpendicular.
    """
    cross = np.cross(n1, n2)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-6:
        raise Refusal(
            "parallel_poles",
            "two poles are parallel; lean one by 15° or more against the other",
            {"angle_deg": float(np.degrees(np.arcsin(sine)))},
        )
    e1 = (n1 + n2) / np.linalg.norm(n1 + n2)
    e3 = cross / sine
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = e1, np.cross(e3, e1), e3
    # Feet of the common perpendicular: solve p1 + a n1 + h e3 = p2 + b n2.
    a, b, h = np.linalg.solve(np.stack([n1, -n2, e3], axis=1), p2 - p1)
    frame[:3, 3] = (p1 + a * n1 + p2 + b * n2) / 2
    cosine = float(n1 @ n2)
    angle = float(np.arctan2(sine, abs(cosine)))
    return LinePair(angle, abs(float(h)), float(h) * (1.0 if cosine >= 0 else -1.0), frame)


def pair_starts(
    target: tuple[Pole, Pole], source: tuple[Pole, Pole]
) -> list[tuple[Array, tuple[int, int]]]:
    """Align one pair of poles with another in the paper's eight ways, in closed form.

    Returns
    -------
    list of (T_target_source, order)
        ``order`` gives the source pole (0 or 1) that goes to the first and to the second target
        pole.
    """
    frames = [_frame_of(pair) for pair in (target, source)]
    return [(frames[0] @ way, order) for way, order in pair_ways(frames[1])]


def _frame_of(pair: tuple[Pole, Pole]) -> Array:
    first, second = pair
    return line_pair(first.inner_point, first.direction, second.inner_point, second.direction).frame


WAYS = tuple(
    (se3.from_rt(np.array(axes, dtype=np.float64).T, np.zeros(3)), order)
    for order, *axes in (
        ((0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 1), (0, -1, 0), (-1, 0, 0), (0, 0, -1)),
        ((0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, 1)),
        ((1, 0), (1, 0, 0), (0, -1, 0), (0, 0, -1)),
        ((1, 0), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((1, 0), (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((1, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    )
)
"""The frame of two lines under the eight ways of naming and directing them, by its axes in the
original one: the bisectors exchange their roles if one line is reversed, the common perpendicular
its direction if that or the order changes."""


def pair_ways(frame: Array) -> list[tuple[Array, tuple[int, int]]]:
    """Express points in the frame (4, 4) of two poles, in the eight ways to name and direct them.

    Returns
    -------
    list of (T_frame_lidar, order)
        (4, 4), and which pole (0 or 1) is the first and which the second.
    """
    return [(se3.inverse(frame @ way), order) for way, order in WAYS]


def direction_sigma(pole: Pole) -> float:
    """Roughly how well the points of a pole fix its direction, 1 σ in radians."""
    return float(pole.rms * np.sqrt(12.0 / len(pole.xyz)) / max(pole.length, 1e-3))


EXACT_RMS = 0.05
"""Pole residual, metres, up to which a start is treated as an exact match of the lines. The
facing sides of a 2 cm pole leave up to 31 mm between two LiDARs, noise a little more."""


def exact_rms(
    target: Sequence[Pole], source: Sequence[Pole], pairs: Sequence[tuple[int, int]]
) -> float:
    """Residual of paired poles, metres, up to which they are an exact match.

    `EXACT_RMS`, plus the scatter of the source's poles about their lines beyond that
    of confirmed poles, plus three sigma of the target's lines where the others lie
    on them: for thick, far and short poles.
    """
    count = variance = 0.0
    for i, j in pairs:
        line, other = target[i], source[j]
        open_variance = line.rms**2 / len(line.xyz) + (
            direction_sigma(line) ** 2 * other.length**2 / 12.0
        )
        count += len(other.xyz)
        variance += len(other.xyz) * (other.rms**2 + 9.0 * open_variance)
    return float(np.sqrt(EXACT_RMS**2 + max(variance / count - MAX_CONFIRMED_RMS**2, 0.0)))


EXTENSION_RMS = 3 * EXACT_RMS
"""Distance within which further poles coincide under a match of two, metres."""

MAX_MATCH_LEAN, MAX_MATCH_GAP = np.radians(10.0), 1.0
"""Two poles of a match are the same only if the angle between them is less, rad, and the gap
between them along the line is less, metres: two lines at a large distance along the same axis are
two posts."""


def solved_each(
    target: Sequence[Pole],
    source: Sequence[Pole],
    pairs: Sequence[tuple[tuple[int, int], ...]],
    starts: Sequence[Array],
) -> list[Match]:
    """Align paired poles by least squares, each set of pairs from its start (4, 4)."""
    if len(pairs) == 0:
        return []
    most = max(len(each) for each in pairs)
    # A set with fewer pairs than the largest has its first one again, with no weight.
    index = np.array([[*each, *(each[:1] * (most - len(each)))] for each in pairs])
    counts = np.array([len(pole.xyz) for pole in source]) / 6.0
    weights = counts[index[:, :, 1]] * (np.arange(most) < [[len(each)] for each in pairs])
    points = np.stack([equivalent_points(pole.xyz) + pole.to_axis for pole in source])
    points = points[index[:, :, 1]]
    on = np.stack([pole.inner_point for pole in target])[index[:, :, 0]]
    along = np.stack([pole.direction for pole in target])[index[:, :, 0]]
    fits = align_each(
        Lines(
            points.reshape(len(pairs), -1, 3),
            np.repeat(on, 6, axis=1),
            np.repeat(along, 6, axis=1),
            np.repeat(weights, 6, axis=1),
        ),
        np.stack(starts),
    )
    return [
        Match(
            own,
            fit.T_target_source,
            fit.rms,
            fit.rms <= exact_rms(target, source, own),
            fit.converged,
            fit.information,
        )
        for own, fit in zip(pairs, fits, strict=True)
    ]


def extended(
    target: Sequence[Pole], source: Sequence[Pole], T: Array, gate: float
) -> tuple[tuple[int, int], ...]:
    """Pair all poles one to one that coincide under ``T``, within ``gate`` metres."""
    # Imported here: it takes a quarter of a second, and two poles on each side do not need it.
    from scipy.optimize import linear_sum_assignment

    # Between all poles (T) of the target and all (S) of the source at once.
    ends = np.stack([np.stack([pole.xyz[0], pole.point, pole.xyz[-1]]) for pole in source])
    ends += np.stack([pole.to_axis for pole in source])[:, None]
    moved = se3.apply(T, ends.reshape(-1, 3)).reshape(-1, 3, 3)
    along = np.stack([pole.direction for pole in source]) @ T[:3, :3].T
    points = np.stack([pole.inner_point for pole in target])
    directions = np.stack([pole.direction for pole in target])
    offset = moved[None] - points[:, None, None]
    across = np.cross(offset, directions[:, None, None])
    gap = np.abs(np.einsum("tsi,ti->ts", offset[:, :, 1], directions))
    gap -= np.add.outer([pole.length for pole in target], [pole.length for pole in source]) / 2
    misfit = np.linalg.norm(across, axis=-1).max(axis=-1)
    leaning = np.linalg.norm(np.cross(along[None], directions[:, None]), axis=-1)
    is_one = (leaning < np.sin(MAX_MATCH_LEAN)) & (gap < MAX_MATCH_GAP)
    distance = np.where(is_one, misfit, np.inf)
    rows, columns = linear_sum_assignment(np.where(np.isfinite(distance), distance, 1e6))
    return tuple(
        (int(i), int(j)) for i, j in zip(rows, columns, strict=True) if distance[i, j] <= gate
    )


def exact_part(target: Sequence[Pole], source: Sequence[Pole], first: Match, whole: Match) -> Match:
    """Leave out of an inexact match, one by one, the pairs without which the others fit best."""
    while not whole.exact and len(whole.pairs) > len(first.pairs) + 1:
        rest = [
            tuple(pair for pair in whole.pairs if pair != other)
            for other in whole.pairs
            if other not in first.pairs
        ]
        fits = solved_each(target, source, rest, [first.T_target_source] * len(rest))
        whole = min(fits, key=lambda match: match.pole_rms)
    return whole if whole.exact else first


def left_out(
    target: Sequence[Pole], source: Sequence[Pole], match: Match
) -> list[tuple[int, int, float]]:
    """Find the poles that a match does not pair although they are the same: they moved slightly.

    Returns
    -------
    list of (i, j, distance)
        Pole of the target, of the source, and their distance under the match, metres.
    """
    rest_target, rest_source = (
        [k for k in range(len(poles)) if k not in {pair[side] for pair in match.pairs}]
        for side, poles in enumerate((target, source))
    )
    if not rest_target or not rest_source:
        return []
    T, found = match.T_target_source, []
    others = [target[i] for i in rest_target], [source[j] for j in rest_source]
    for i, j in extended(*others, T, SAME_POSE_DISTANCE):
        pole, other = others[0][i], others[1][j]
        offset = se3.apply(T, other.inner_point) - pole.inner_point
        distance = float(np.linalg.norm(np.cross(offset, pole.direction)))
        found.append((rest_target[i], rest_source[j], distance))
    return found


MIN_ANGLE = np.radians(5.0)
"""Pairs of poles nearer to parallel than this start no hypothesis: along their common direction a
pose error grows with 1/sin(angle), which is more than tenfold here."""

ANGLE_TOLERANCE = np.radians(3.0)
"""Largest difference between two LiDARs in the angle between two poles, beyond three sigma."""

DISTANCE_TOLERANCE = 0.08
"""The same for the distance between two poles, metres. Each LiDAR sees a line up to 16 mm in front
of the axis of a 2 cm pole, towards itself."""

MAX_PAIR_MATCHES = 200
"""Number of pairs of pole pairs that are tried, the most similar first."""

ENOUGH_PAIR_MATCHES = 72
"""Number tried at once, twice that of four poles on each side; no more are tried if one of them
gives a match of three poles or more. Next to a row of posts hundreds are similar, and the right
one is among the first."""

MAX_HYPOTHESES = 16
"""Number of hypotheses that are scored by the scene: most poles, least expected error first."""


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
        points = np.stack([first.inner_point, second.inner_point])
        pair = line_pair(points[0], first.direction, points[1], second.direction)
        sigma = float(np.hypot(direction_sigma(first), direction_sigma(second)))
        # The common perpendicular of leaning poles can lie metres beyond the visible parts;
        # there an error of direction moves the feet with that lever arm.
        feet = np.linalg.norm(pair.frame[:3, 3] - points, axis=1)
        index.append((i, j))
        frames.append(pair.frame)
        rows.append((pair.angle, pair.distance, pair.handedness, sigma, float(feet.max())))
    return Pairs(index, frames, *np.array(rows).reshape(-1, 5).T)


def _similar(target: Pairs, source: Pairs) -> list[tuple[int, int]]:
    """Rows of the pairs that agree in angle, distance and hand, within noise; most similar
    first."""
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


def are_similar(poles: Sequence[Pole], others: Sequence[Pole]) -> bool:
    """Whether two of some poles may, within noise, lie relative to each other as two others do."""
    return bool(_similar(all_pairs(poles), all_pairs(others)))


def _angle_between(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def widest_angle(directions: Sequence[Array]) -> float:
    """Largest angle between any two directions (3,) of poles, radians; 0 for fewer than two."""
    return max((_angle_between(a, b) for a, b in combinations(directions, 2)), default=0.0)


class EveryMatch(NamedTuple):
    """Matches, the best first, and how many of the pairs of poles of similar shape were tried."""

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
    match, which includes all other poles that fall into place and is solved with them together.

    Parameters
    ----------
    target, source
        Poles of the two LiDARs, each in the frame of its LiDAR.
    count
        How many poles both LiDARs see, if known: only matches of this number are kept.
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
        ``too_few_poles``, ``parallel_poles``, ``no_match`` if no pair of poles of one LiDAR has the
        shape of a pair of the other, or ``pole_count`` if some agree, but not ``count`` poles.
    """
    _check_poles(target, source, count or 2)
    pairs_target, pairs_source = all_pairs(target), all_pairs(source)
    every = _similar(pairs_target, pairs_source)
    similar = every[:MAX_PAIR_MATCHES]
    laid = Share(len(similar), len(every))
    found: list[tuple[Match, Match]] = []
    for k in range(0, len(similar), ENOUGH_PAIR_MATCHES):
        found += _matched(
            target, source, similar[k : k + ENOUGH_PAIR_MATCHES], pairs_target, pairs_source
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
            "in angle and distance: the LiDARs do not see the same two poles, or one moved; check "
            "with 'retropole detect' which poles were found",
            {"poles_target": len(target), "poles_source": len(source)},
        )
    agreeing = len(matches[0].pairs)
    matches = [match for match in matches if count in (None, len(match.pairs))]
    if not matches:
        raise Refusal(
            "pole_count",
            f"{counted(agreeing, 'pole agrees', 'poles agree')} between the LiDARs but "
            f"{count} were requested; check with 'retropole "
            "detect' which, and cover or remove other objects",
            {"agreeing": agreeing, "asked": int(count or 0)},
        )
    return EveryMatch(matches, laid)


def _matched(
    target: Sequence[Pole],
    source: Sequence[Pole],
    similar: Sequence[tuple[int, int]],
    pairs_target: Pairs,
    pairs_source: Pairs,
) -> list[tuple[Match, Match]]:
    """Align pairs of poles in all ways, and include the other poles that then fit.

    Returns
    -------
    list of (Match, Match)
        Of two poles, and of all that fall into place; of more than two and two only exact ones.
    """
    ways = {column: pair_ways(pairs_source.frame[column]) for _, column in similar}
    pairs, starts = [], []
    for row, column in similar:
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
                f"the poles seen by the {name} LiDAR differ by {np.degrees(angle):.1f}°; lean one "
                "by 15° or more against the other",
                {"lidar": name, "angle_deg": float(np.degrees(angle))},
            )
