"""From where the search for the refined pose starts again, and when two ends are two minima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ..alignment.certainty import chi2_limit
from ..alignment.factor import poses_of_pair
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, PoseEstimate
from ..surfaces.patch_pairs import MIN_CORRESPONDENCE_DISTANCE, POSE_SIGMAS, every_nth_patch
from .descent import End, RefinementProblem, approach
from .terms import FEW

SEVERAL = chi2_limit(POSE)
"""Squared Mahalanobis distance from which two ends are two minima."""


def distance_sq(covariance: Array, T: Array, T_other: Array) -> float:
    """Squared Mahalanobis distance of one pose (4, 4) from another with a covariance (6, 6)."""
    step = se3.local(T, T_other)
    return float(step @ np.linalg.solve(covariance, step))


def approaches_from_afar(
    problem: RefinementProblem, near: End, poles: PoseEstimate, lever: float
) -> list[End]:
    """Approach from the ends of the poles' uncertainty, and keep what comes out elsewhere.

    Under an uncertainty that is wider than surfaces lie apart that correspond, what the search ends
    at may depend on where it started. The ends are `POSE_SIGMAS` to either side.
    """
    assert poles.covariance is not None
    scale = np.r_[np.full(3, 1.0 / max(lever, 1.0)), np.ones(3)]
    values, vectors = np.linalg.eigh(poles.covariance / np.outer(scale, scale))
    widest = float(np.sqrt(max(values[-1], 0.0)))
    if widest < MIN_CORRESPONDENCE_DISTANCE:
        return []
    step = POSE_SIGMAS * widest * vectors[:, -1] * scale
    found = [
        approach(
            problem,
            poses_of_pair(se3.retract(poles.T_target_source, sign * step)),
            of_source(poles.covariance),
        )
        for sign in (1.0, -1.0)
    ]
    return [end for end in found if end.scene and elsewhere(end, [near])]


def approaches_of_parts(
    problem: RefinementProblem, T: Array, known: Sequence[End], covariance: Array
) -> list[End]:
    """Approach with the parts of the patches not yet asked, and keep what comes out elsewhere.

    Few patches may hold a direction, the ground between two façades: a part of them leads past a
    minimum that the others are caught in, where other starts do not.
    """
    (scene,) = problem.scenes
    kept: list[End] = []
    for k in range(1, FEW):
        part = replace(problem, scenes=(replace(scene, few=every_nth_patch(scene.sets, FEW, k)),))
        end = approach(part, T, covariance)
        if end.scene and elsewhere(end, [*known, *kept]):
            kept.append(end)
    return kept


def elsewhere(end: End, known: Sequence[End]) -> bool:
    """Whether an end is another minimum than any that is known."""
    return all(distance_sq(one.search[POSE:, POSE:], one.T[1], end.T[1]) > SEVERAL for one in known)


def of_source(covariance: Array) -> Array:
    """(12, 12) of both poses of a pair, of which the source's has a covariance (6, 6)."""
    return np.asarray(block_diag(np.zeros((POSE, POSE)), covariance))
