"""Several placements of the poles before the same two LiDARs: one pose for all of them.

Each placement has its own hypotheses; only the right pose recurs in all. What the scene says of a
pose is averaged over the placements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import se3
from ..datatypes import Array, Hypothesis, PointCloud, Pole
from ..errors import Refusal

AGREE_ANGLE, AGREE_DISTANCE = np.radians(4.0), 0.4
"""Poses of two placements are one if they differ by less, rad, and metres where the poles stand."""


@dataclass(frozen=True, eq=False)
class Choice:
    """A pose that recurs: the joint hypothesis, and the one of each placement."""

    joint: Hypothesis
    each: tuple[Hypothesis, ...]


def _apart(one: Hypothesis, other: Hypothesis, at: Array) -> tuple[float, float]:
    A, B = one.match.T_target_source, other.match.T_target_source
    shift = se3.apply(A, at) - se3.apply(B, at)
    return se3.rotation_angle(A[:3, :3] @ B[:3, :3].T), float(np.linalg.norm(shift, axis=1).max())


def recurring(
    hypotheses: Sequence[Sequence[Hypothesis]], sources: Sequence[Sequence[Pole]]
) -> list[Choice]:
    """Find the poses that recur in all placements, the best score first.

    Parameters
    ----------
    hypotheses
        Of each placement.
    sources
        The source's poles of each placement: poses are compared where these stand.

    Raises
    ------
    Refusal
        ``placements_disagree`` where no pose recurs.
    """
    choices = []
    at = np.array([pole.point for poles in sources for pole in poles])
    nearest = np.inf
    for first in hypotheses[0]:
        if not first.match.exact:
            continue
        each = [first]
        for others in hypotheses[1:]:
            gaps = [(*_apart(first, h, at), h) for h in others if h.match.exact]
            angle, distance, best = min(
                gaps, key=lambda gap: gap[0] / AGREE_ANGLE + gap[1] / AGREE_DISTANCE
            )
            if angle > AGREE_ANGLE or distance > AGREE_DISTANCE:
                nearest = min(nearest, distance)
                break
            each.append(best)
        else:
            overlap = float(np.mean([h.overlap for h in each]))
            free_space = float(np.mean([h.free_space for h in each]))
            joint = replace(
                first, overlap=overlap, free_space=free_space, score=overlap - free_space
            )
            choices.append(Choice(joint, tuple(each)))
    if not choices:
        raise Refusal(
            "placements_disagree",
            f"no pose fits all {len(hypotheses)} placements; the nearest two are {nearest:.2f} m "
            "apart: did a LiDAR move between them, or are the files of a placement swapped?",
            {"placements": len(hypotheses), "nearest_m": nearest},
        )
    return sorted(choices, key=lambda choice: -choice.joint.score)


def merged(clouds: Sequence[PointCloud]) -> PointCloud:
    """Put the clouds of one LiDAR together, for what stands still in all of them."""
    if len(clouds) == 1:
        return clouds[0]
    return PointCloud(np.concatenate([cloud.xyz for cloud in clouds]), origin=clouds[0].origin)
