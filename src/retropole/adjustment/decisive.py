"""Whether one place alone decides a direction of the pose, and what the rest of the scene says.

A robust loss bounds how far one residual pulls, not how much a far surface, seen by few beams,
holds of a rotation: it then fits by itself, and its residual tells nothing. So the answer is sought
again without each such place, with weights and partners anew, and what is stated covers both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..surfaces.patch_pairs import some_of
from .descent import End, RefinementProblem, converge
from .places import Places, places_of_poses

MAX_SHARE = 0.3
"""Most of the information along any direction that one place may hold without a word."""


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
        The problem of a pair, and the answer.
    covariance
        (12, 12) of the poles' poses.

    Yields
    ------
    Decisive, RefinementProblem, End
        The place, and problem (but for its `few`) and answer without it; places without which the
        rest of the scene says nothing are left out.
    """
    (term,), (scene,) = end.scene, problem.scenes
    pairs = term.pairs
    shares = leverage(places_of_poses(end))
    for c in np.argsort(-shares):
        if shares[c] <= MAX_SHARE:
            return
        kept = scene.sets.clusters != pairs.places[c]
        rest = replace(problem, scenes=(replace(scene, sets=some_of(scene.sets, kept)),))
        found = converge(rest, end, covariance)
        if found.scene:
            own = pairs.cluster == c
            at = np.average(pairs.at[own], axis=0, weights=term.weighed.weights[own])
            yield Decisive(float(shares[c]), at, se3.local(end.T[1], found.T[1])), rest, found
