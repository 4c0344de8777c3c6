"""Matches that give nearly the same pose are one: which of them is kept, and in which order."""

from __future__ import annotations

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Match

SAME_POSE_ANGLE, SAME_POSE_DISTANCE = np.radians(10.0), 0.5
"""Matches nearer to each other than this, rad and m, are one."""


def _expected_error(match: Match) -> float:
    """Roughly how far a match may put a point 10 m away, metres: residual times lever."""
    variance = np.diag(np.linalg.inv(match.information))
    lever = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
    return float(max(match.pole_rms, 1e-6) * np.sqrt(np.sum(lever**2 * variance)))


def distinct(matches: list[Match], source_points: Array) -> list[Match]:
    """Sort matches, most poles and least expected error first, and keep one of each pose.

    The right pose and the wrong ones lie half a turn apart; what lies nearer is the same pose by
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
        alike = np.flatnonzero(rotations[:k] @ rotations[k] > least)
        apart = np.linalg.norm(places[alike] - places[k], axis=2).max(axis=1)
        if not np.any(apart < SAME_POSE_DISTANCE):
            kept.append(match)
    return kept


def same_pose(one: Match, other: Match, source_points: Array) -> bool:
    """Whether two matches put the source, and points (N, 3) of it, in nearly the same place."""
    apart = se3.difference_at(one.T_target_source, other.T_target_source, source_points)
    return apart.rotation < SAME_POSE_ANGLE and apart.translation < SAME_POSE_DISTANCE
