"""What the observations of a network say: residuals and derivatives, each number in its own σ.

Poses move by steps ``[φ, δ]`` in the axes of the network: ``Exp(φ) R`` and ``t + δ``. The
translation does not turn with the rotation, so that coordinates as large as a city's do no harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...api import Array, IntArray, se3
from ...base.se3 import relative_jacobian


@dataclass(frozen=True, eq=False)
class Whitened:
    """Observations at some poses, each number in σ.

    Attributes
    ----------
    residual
        (M, 6) what was measured against what the poses say.
    by_i, by_j
        (M, 6, 6) derivatives by a step of the first pose, and of the second.
    """

    residual: Array
    by_i: Array
    by_j: Array


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of all kinds as relative poses; a control point says nothing of rotations.

    Attributes
    ----------
    i, j
        (M,) the two poses of each; the number behind the last pose is the ground.
    T_i_j
        (M, 4, 4) maps points of j into the frame of i.
    seen
        (M, 3) the point of j that lies at the translation, metres, in its own frame.
    root
        (M, 6, 6) by which residuals are counted in σ, ``WᵀW = C⁻¹``; zero for what is not measured.
    freedom
        (M,) how many numbers each is: 6, or the 3 of the translation.
    """

    i: IntArray
    j: IntArray
    T_i_j: Array
    seen: Array
    root: Array
    freedom: IntArray

    def __len__(self) -> int:
        """How many there are."""
        return len(self.i)

    def only(self, some: IntArray) -> Observations:
        """Give some of them (K,)."""
        return Observations(*(values[some] for values in vars(self).values()))

    def at(self, T: Array) -> Whitened:
        """Hold them against poses (N, 4, 4)."""
        T = with_ground(T)
        T_i, T_j = T[self.i], T[self.j]
        arm = np.einsum("kab,kb->ka", T_j[:, :3, :3], self.seen)
        T_j[:, :3, 3] += arm
        found, measured = se3.inverse(T_i) @ T_j, self.T_i_j.copy()
        points = self.freedom == 3
        measured[points, :3, :3] = found[points, :3, :3]
        step = se3.local(measured, found) if len(self) else np.zeros((0, 6))
        J = self.root @ se3.local_jacobian(step) @ relative_jacobian(T_i, T_j)
        # A step turns the arm too.
        J[:, :, 6:9] -= J[:, :, 9:] @ se3.hat(arm)
        return Whitened(np.einsum("kab,kb->ka", self.root, step), J[:, :, :6], J[:, :, 6:])

    def squares(self, T: Array) -> Array:
        """(M,) squared residuals at poses (N, 4, 4), in σ²."""
        return np.asarray(np.sum(self.at(T).residual ** 2, axis=1))


def with_ground(T: Array) -> Array:
    """Poses (N + 1, 4, 4) with the ground as the last: the frame of the network itself."""
    return np.concatenate([T, np.eye(4)[None]])
