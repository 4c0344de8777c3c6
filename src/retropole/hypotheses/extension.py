"""Which further poles a match of two takes in, which it leaves out, and how well it fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..alignment.point_to_line import Lines, align_each, equivalent_points
from ..base import se3
from ..base.datatypes import Array, Match, Pole

EXACT_RMS = 0.05
"""Pole residual, metres, up to which a start counts as an exact match of the lines. The
facing sides of a 2 cm pole leave up to 31 mm between two LiDARs, noise a little more."""

EXTENSION_RMS = 3 * EXACT_RMS
"""Distance within which further poles fall into place under a match of two, metres."""

MOVED = 0.5
"""Poles that a match leaves out are one that moved where less lies between them, metres."""

MAX_MATCH_LEAN, MAX_MATCH_GAP = np.radians(10.0), 1.0
"""Two poles of a match are one only if they lean against each other by less, rad, and if less lies
between them along the line, metres: two lines far apart along themselves are two posts."""


def solved_each(
    target: Sequence[Pole],
    source: Sequence[Pole],
    pairs: Sequence[tuple[tuple[int, int], ...]],
    starts: Sequence[Array],
) -> list[Match]:
    """Lay paired poles on each other by least squares, each set of pairs from its start (4, 4)."""
    if len(pairs) == 0:
        return []
    most = max(len(each) for each in pairs)
    # A set with fewer pairs than the largest has its first one again, with no weight.
    index = np.array([[*each, *(each[:1] * (most - len(each)))] for each in pairs])
    counts = np.array([len(pole.xyz) for pole in source]) / 6.0
    weights = counts[index[:, :, 1]] * (np.arange(most) < [[len(each)] for each in pairs])
    points = np.stack([equivalent_points(pole.xyz) for pole in source])[index[:, :, 1]]
    on = np.stack([pole.point for pole in target])[index[:, :, 0]]
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
            own, fit.T_target_source, fit.rms, fit.rms <= EXACT_RMS, fit.converged, fit.information
        )
        for own, fit in zip(pairs, fits, strict=True)
    ]


def extended(
    target: Sequence[Pole], source: Sequence[Pole], T: Array, gate: float
) -> tuple[tuple[int, int], ...]:
    """Pair all poles one to one that lie on each other under ``T``, within ``gate`` metres."""
    # Imported here: it takes a quarter of a second, and two poles on each side do not need it.
    from scipy.optimize import linear_sum_assignment

    # Between all poles (T) of the target and all (S) of the source at once.
    ends = np.stack([np.stack([pole.xyz[0], pole.point, pole.xyz[-1]]) for pole in source])
    moved = se3.apply(T, ends.reshape(-1, 3)).reshape(-1, 3, 3)
    along = np.stack([pole.direction for pole in source]) @ T[:3, :3].T
    points = np.stack([pole.point for pole in target])
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
    """Find the poles that a match does not pair though they are one: they moved by a little.

    Returns
    -------
    list of (i, j, distance)
        Pole of the target, of the source, and how far apart they lie under the match, metres.
    """
    rest_target, rest_source = (
        [k for k in range(len(poles)) if k not in {pair[side] for pair in match.pairs}]
        for side, poles in enumerate((target, source))
    )
    if not rest_target or not rest_source:
        return []
    T, found = match.T_target_source, []
    others = [target[i] for i in rest_target], [source[j] for j in rest_source]
    for i, j in extended(*others, T, MOVED):
        pole, other = others[0][i], others[1][j]
        offset = se3.apply(T, other.point) - pole.point
        distance = float(np.linalg.norm(np.cross(offset, pole.direction)))
        found.append((rest_target[i], rest_source[j], distance))
    return found
