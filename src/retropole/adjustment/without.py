"""How the poses change without one placement, to first order: what rests on it alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..alignment.adjustment import MAX_TRANSLATION_SIGMA
from ..alignment.network import Network, about, factor_of
from ..alignment.unknowns import POSE
from ..base.datatypes import Array, IntArray
from .answer import WithoutPlacement
from .descent import End

GONE = 1.0
"""Precision of axes that nothing is left of, to keep the equations solvable."""


def without_placements(network: Network, end: End, placements: int) -> Iterator[WithoutPlacement]:
    """Solve again without the returns of each placement; nothing of a site with one.

    Parameters
    ----------
    network, end
        What was adjusted, and where it ended.
    placements
        How many there are.
    """
    if placements < 2:
        return
    unknowns, poses = network.unknowns, network.unknowns.poses
    index = np.arange(poses, unknowns.kept)
    free = factor_of(network).estimated
    network = about(network, end.T)
    here = np.r_[np.zeros(poses), end.errors]
    for p in range(placements):
        left = {k for k, one in enumerate(network.observations) if one.placement == p}
        factor = factor_of(network.without(left), ridge=GONE)
        information = factor.information
        slope = factor.vector - information @ here
        information[index, index] += end.precision
        slope[index] -= end.precision * end.errors
        for term in end.scene:
            information[np.ix_(term.place, term.place)] += term.information
            np.add.at(slope, term.place, term.slope(here, poses))
        yield _changed(p, information[np.ix_(free, free)], slope[free], free, poses)


def _changed(
    placement: int, information: Array, slope: Array, free: IntArray, poses: int
) -> WithoutPlacement:
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information / np.outer(scale, scale) + 1e-12 * np.eye(len(scale))
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    own = free < poses
    if np.sqrt(np.diag(inverse)[own].max()) > MAX_TRANSLATION_SIGMA:
        return WithoutPlacement(placement, None, None, None)
    step = np.zeros(poses)
    step[free[own]] = (inverse @ slope)[own]
    rows = step.reshape(-1, POSE)
    turned, moved = (np.linalg.norm(rows[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    lidar = int(np.argmax(moved))
    return WithoutPlacement(placement, float(turned.max()), float(moved.max()), lidar)
