"""Poles of a cloud that is mirrored or scaled: what becomes of them, and which scales they allow.

Two skew lines keep their angle in any similarity. Their distance tells its scale, and the sign of
the screw from one to the other its handedness; of lines that nearly meet neither is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import Array, PointCloud, Pole
from .correspondence import ANGLE_TOLERANCE, DISTANCE_TOLERANCE, all_pairs

MAX_FACTOR = 5.0
"""Largest ratio of distances that is tried; pairs that are no pair have any."""

SAME_FACTOR = 0.05
"""Factors nearer to each other than this, as a part of them, are one: the scene refines it."""


@dataclass(frozen=True)
class Change:
    """What is done to a cloud, in its own frame: first mirrored along x, then scaled.

    Any other mirror differs from that along x by a rotation.
    """

    factor: float = 1.0
    mirrored: bool = False

    @property
    def diagonal(self) -> Array:
        """(3,) factor of each coordinate."""
        return self.factor * np.array([-1.0 if self.mirrored else 1.0, 1.0, 1.0])


def changed_cloud(cloud: PointCloud, change: Change) -> PointCloud:
    """Change a cloud, and where its beams start and what they turn about."""
    by = change.diagonal
    return replace(
        cloud, xyz=cloud.xyz * by, origin=cloud.origin * by, axis=cloud.axis * by / change.factor
    )


def changed_pole(pole: Pole, change: Change) -> Pole:
    """Change a pole; its thickness too."""
    by = change.diagonal
    return replace(
        pole,
        point=pole.point * by,
        direction=pole.direction * by / change.factor,
        xyz=pole.xyz * by,
        length=pole.length * change.factor,
        rms=pole.rms * change.factor,
    )


def factors_of(target: Sequence[Pole], source: Sequence[Pole], most: int) -> list[float]:
    """Find by which factors the source's poles may have to be scaled, the most frequent first."""
    pairs, others = all_pairs(target), all_pairs(source)
    sigma = np.hypot(pairs.sigma[:, None], others.sigma[None])
    alike = np.abs(pairs.angle[:, None] - others.angle[None]) <= ANGLE_TOLERANCE + 3 * sigma
    # Lines that are nearer tell no scale. Of a cloud that is scaled down the error is scaled, too.
    alike &= np.maximum(pairs.distance[:, None], others.distance[None]) > DISTANCE_TOLERANCE
    alike &= np.minimum(pairs.distance[:, None], others.distance[None]) > 0
    rows, columns = np.nonzero(alike)
    ratios = np.log(pairs.distance[rows] / others.distance[columns])
    ratios = ratios[np.abs(ratios) < np.log(MAX_FACTOR)]
    near = np.abs(ratios[:, None] - ratios[None]) < SAME_FACTOR
    found: list[float] = []
    for k in np.argsort(-near.sum(axis=1), kind="stable"):
        if all(abs(ratios[k] - other) >= SAME_FACTOR for other in found):
            found.append(float(np.median(ratios[near[k]])))
    return [float(np.exp(each)) for each in found[:most]]
