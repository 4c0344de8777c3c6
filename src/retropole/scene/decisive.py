"""Whether one place alone decides a direction of the pose, and what the rest of the scene says.

A robust loss bounds how far one residual pulls, not how much a far surface, seen by few beams,
holds of a rotation: it then fits by itself, and its residual tells nothing. So the answer is sought
again without each such place, with weights and partners anew, and what is stated covers both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..alignment.factor import POSE
from ..base import se3
from ..base.datatypes import Array, IntArray
from .descent import End, LinearProblem, RefinementProblem, settle
from .patch_pairs import part_of

MAX_SHARE = 0.3
"""Most of the information along any direction that one place may hold without a word."""

MOST_LEFT_OUT = 3
"""So many places can hold so much of one direction."""


@dataclass(frozen=True, eq=False)
class Decisive:
    """A place that alone decides a direction of the pose.

    Attributes
    ----------
    share
        Part of all information along that direction that it holds.
    at
        (3,) its middle in the target's frame, metres.
    apart
        (6,) step from the answer to the one without it (`se3.local`).
    """

    share: float
    at: Array
    apart: Array


@dataclass(frozen=True, eq=False)
class Places:
    """What each place says of the pose, with the errors of the LiDARs eliminated.

    Attributes
    ----------
    marginal
        (6, 6) information of the pose, of poles and scene together.
    information
        (C, 6, 6) what each place has of it.
    gradients
        (C, 6) how it pulls at the answer.
    moves
        (C, 6) how far a step of all its residuals by 1 m moves the answer.
    """

    marginal: Array
    information: Array
    gradients: Array
    moves: Array


def places_of(linear: LinearProblem) -> Places:
    """Sum what the pairs of patches of each place say."""
    inverse, cluster = linear.inverse, linear.pairs.cluster
    marginal = np.asarray(np.linalg.inv(inverse[:POSE, :POSE]))
    J = linear.rows @ inverse[:, :POSE] @ marginal
    residuals = linear.residuals + linear.rows[:, POSE:] @ linear.errors
    JW = J * linear.weights[:, None]
    outer = (JW[:, :, None] * J[:, None, :]).reshape(-1, POSE**2)
    return Places(
        marginal,
        _summed(outer, cluster).reshape(-1, POSE, POSE),
        _summed(JW * residuals[:, None], cluster),
        _summed(JW, cluster) @ inverse[:POSE, :POSE],
    )


def leverage(places: Places) -> Array:
    """Largest share (C,) of the information along any direction that each place holds.

    The largest eigenvalue of ``S^-½ S_c S^-½``: whatever the frame and the units.
    """
    root = np.linalg.cholesky(places.marginal)
    half = np.linalg.solve(root, places.information)
    whole = np.linalg.solve(root, half.transpose(0, 2, 1))
    return np.asarray(np.linalg.eigvalsh(whole)[:, -1])


def without_decisive(
    problem: RefinementProblem, end: End, covariance: Array
) -> Iterator[tuple[Decisive, RefinementProblem, End]]:
    """Seek the answer again without each place that decides a direction alone.

    Parameters
    ----------
    problem, end
        The problem, and the answer.
    covariance
        (6, 6) of the poles' pose.

    Yields
    ------
    Decisive, RefinementProblem, End
        The place, and problem (but for its `few`) and answer without it; places without which the
        rest of the scene says nothing are left out.
    """
    pairs = end.linear.pairs
    shares = leverage(places_of(end.linear))
    for c in np.argsort(-shares)[:MOST_LEFT_OUT]:
        if shares[c] <= MAX_SHARE:
            return
        kept = problem.sets.clusters != pairs.places[c]
        rest = replace(problem, sets=part_of(problem.sets, kept))
        found = settle(rest, end, covariance)
        if found is not None:
            own = pairs.cluster == c
            at = np.average(pairs.at[own], axis=0, weights=end.linear.weights[own])
            yield Decisive(float(shares[c]), at, se3.local(end.T, found.T)), rest, found


def _summed(rows: Array, label: IntArray) -> Array:
    """Sums of rows (P, D) over each label."""
    return np.stack([np.bincount(label, column) for column in rows.T], axis=1)
