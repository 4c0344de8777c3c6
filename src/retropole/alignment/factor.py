"""What the poles say of the pose and of the LiDARs' systematic errors, as one quadratic form.

Near the maximum of the posterior the returns on the poles say

    −log L(x, b) = ½ zᵀ Λ z − ηᵀ z,    z = [x, b],

with x the steps of all poses and b the errors of `systematic`; the axes of the poles are
eliminated (Schur complement). The prior of b is no part of it, so that the scene can share b. Of a
pair the target's pose is the identity and held: it is the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PoseEstimate
from .unknowns import POSE, Unknowns

OF_SOURCE = np.repeat([False, True], POSE)
"""(12,) which parameters of both poses of a pair are estimated."""


@dataclass(frozen=True, eq=False)
class PoleFactor:
    """Quadratic form of all poses and errors that the poles' returns, and a survey, give.

    Attributes
    ----------
    T
        (L, 4, 4) the poses that the steps x start from.
    unknowns
        Order of poses and errors, K in all.
    free
        (6 L,) which parameters of the poses are estimated; the others are the datum.
    information, vector
        (K, K) Λ and (K,) η.
    redundancy
        Returns more than parameters: the degrees of freedom of their noise; infinite where a
        covariance is given.
    depth
        (K, R) how η moves with each error of the depth of a pole, by its 1 σ (`network`).
    left
        (L, 6, 6) covariance of how far each LiDAR's recordings are from where it rests, over
        rotation and translation, axes of its own; empty where all stand.
    """

    T: Array
    unknowns: Unknowns
    free: BoolArray
    information: Array
    vector: Array
    redundancy: float
    depth: Array
    left: Array = field(default_factory=lambda: np.zeros((0, POSE, POSE)))

    def weakened(self, share: float) -> PoleFactor:
        """Give the same with a part of its information."""
        return replace(
            self,
            information=share * self.information,
            vector=share * self.vector,
            depth=np.sqrt(share) * self.depth,
        )

    def with_bands(self, bands: Sequence[IntArray]) -> PoleFactor:
        """Give the same with more bands of elevation of each LiDAR."""
        own = self.unknowns
        union = (np.union1d(a, b) for a, b in zip(own.bands, bands, strict=True))
        unknowns = Unknowns(tuple(each.astype(np.int64) for each in union), 0, 0)
        place = own.places_in(unknowns)
        information, vector = np.zeros((unknowns.kept, unknowns.kept)), np.zeros(unknowns.kept)
        information[np.ix_(place, place)] = self.information
        vector[place] = self.vector
        depth = np.zeros((unknowns.kept, self.depth.shape[1]))
        depth[place] = self.depth
        return replace(self, unknowns=unknowns, information=information, vector=vector, depth=depth)

    def without_bands(self) -> PoleFactor:
        """Give the same as if the errors of single rings were zero."""
        unknowns = Unknowns(tuple(bands[:0] for bands in self.unknowns.bands), 0, 0)
        place = unknowns.places_in(self.unknowns)
        information = self.information[np.ix_(place, place)]
        return replace(
            self,
            unknowns=unknowns,
            information=information,
            vector=self.vector[place],
            depth=self.depth[place],
        )

    def about(self, T: Array) -> PoleFactor:
        """Give the same in steps from other poses (L, 4, 4)."""
        here, by_step = steps_to(self.T, T)
        poses = slice(self.unknowns.poses)
        vector = self.vector - self.information[:, poses] @ here
        vector[poses] = by_step.T @ vector[poses]
        depth = self.depth.copy()
        depth[poses] = by_step.T @ depth[poses]
        information = self.information.copy()
        information[poses] = by_step.T @ information[poses]
        information[:, poses] = information[:, poses] @ by_step
        return replace(self, T=T, information=information, vector=vector, depth=depth)

    @property
    def estimated(self) -> IntArray:
        """Which of the unknowns are estimated: all but the datum."""
        return np.flatnonzero(np.r_[self.free, np.ones(self.unknowns.errors, dtype=bool)])


def steps_to(start: Array, T: Array) -> tuple[Array, Array]:
    """Give the steps (6 L,) from some poses to others, (L, 4, 4) each.

    The second (6 L, 6 L) is their derivative by steps from the others.
    """
    steps = [se3.local(a, b) for a, b in zip(start, T, strict=True)]
    return np.concatenate(steps), block_diag(*map(se3.local_jacobian, steps))


def poses_of_pair(T_target_source: Array) -> Array:
    """(2, 4, 4) poses of both LiDARs of a pair: the target's is the frame."""
    return np.stack([np.eye(4), T_target_source])


def gaussian_factor(pose: PoseEstimate) -> PoleFactor:
    """Give the quadratic form of a pose with a covariance, which says nothing of the errors."""
    assert pose.covariance is not None
    none = np.zeros(0, dtype=np.int64)
    unknowns = Unknowns((none, none), 0, 0)
    information = np.zeros((unknowns.kept, unknowns.kept))
    own = unknowns.pose(1)
    information[np.ix_(own, own)] = np.linalg.inv(pose.covariance)
    T = poses_of_pair(pose.T_target_source)
    nothing = np.zeros(unknowns.kept)
    return PoleFactor(T, unknowns, OF_SOURCE, information, nothing, np.inf, nothing[:, None])
