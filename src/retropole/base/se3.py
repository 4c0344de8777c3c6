"""Rigid transforms as 4×4 matrices, and their exponential coordinates.

A pose error is split, not a twist: ``R_true = Exp(φ) R`` and ``t_true = t + δ``, both in the axes
of the target frame. `retract` and `local` are the two directions of that chart. Of several
LiDARs in one frame, `relative` gives the pose of one in another's, with the covariance of both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import ReadError

Array = NDArray[np.float64]

RIGID_TOLERANCE = 1e-4
"""How far from rigid a transform that was read may be: four printed decimals make 1e-4."""

FARTHEST = 1e8
"""Nothing is farther away, metres: the coordinates of maps stay below 1e7."""

TINY = 1e-300
"""Square of an angle, rad², that keeps quotients at none from being 0/0."""

HALF_TURN = -1.9
"""Twice the cosine of an angle beyond which, near π, its sine hardly shows the axis."""


def from_rt(rotation: Array, translation: Array) -> Array:
    """Build transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), metres."""
    T = np.zeros((*rotation.shape[:-2], 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Array) -> Array:
    """Invert rigid transforms (..., 4, 4): ``inverse(T_a_b)`` is ``T_b_a``."""
    back = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rt(back, -(back @ T[..., :3, 3:])[..., 0])


def apply(T: Array, xyz: Array) -> Array:
    """Map (N, 3) points by a 4×4 transform: ``apply(T_a_b, points_b)`` gives points in ``a``."""
    return np.asarray(xyz @ T[:3, :3].T + T[:3, 3])


def rigid(matrix: Array) -> Array:
    """Check that a 4×4 matrix is rigid, and give the rigid transform nearest to it.

    Parameters
    ----------
    matrix
        (4, 4), as read.

    Raises
    ------
    ReadError
        If it is not (4, 4), not finite, larger than `FARTHEST`, has another last row than
        0 0 0 1, or where its rotation is mirrored or further than `RIGID_TOLERANCE` from
        orthonormal.
    """
    T = np.asarray(matrix, dtype=float)
    if T.shape != (4, 4):
        raise ReadError(f"no rigid transform: {T.shape} numbers instead of (4, 4)")
    if not np.isfinite(T).all():
        raise ReadError(f"no rigid transform: {int((~np.isfinite(T)).sum())} entries not finite")
    if np.abs(T).max() > FARTHEST:
        raise ReadError(f"no rigid transform: {np.abs(T).max():.3g} is beyond {FARTHEST:g}")
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ReadError(f"no rigid transform: its last row is {T[3].tolist()}, not 0 0 0 1")
    R = T[:3, :3]
    off = float(np.abs(R.T @ R - np.eye(3)).max())
    det = float(np.linalg.det(R))
    if off > RIGID_TOLERANCE or det < 0:
        raise ReadError(
            f"no rigid transform: its determinant is {det:.6g} (1 is rigid, -1 mirrors), and RᵀR "
            f"is off the identity by {off:.3g} (at most {RIGID_TOLERANCE:g} is rounding)"
        )
    if off < 1e-12:
        return T
    U, _, Vt = np.linalg.svd(R)
    return from_rt(U @ Vt, T[:3, 3])


def exp_so3(phi: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=float)
    x, y, z = phi[..., 0], phi[..., 1], phi[..., 2]
    half = np.sqrt(x * x + y * y + z * z + TINY) / 2
    a = np.sin(2 * half) / (2 * half)
    b = (np.sin(half) / half) ** 2 / 2
    out = np.empty((*phi.shape, 3))
    out[..., 0, 0], out[..., 0, 1] = 1 - b * (y * y + z * z), b * x * y - a * z
    out[..., 0, 2], out[..., 1, 0] = b * x * z + a * y, b * x * y + a * z
    out[..., 1, 1], out[..., 1, 2] = 1 - b * (x * x + z * z), b * y * z - a * x
    out[..., 2, 0], out[..., 2, 1] = b * x * z - a * y, b * y * z + a * x
    out[..., 2, 2] = 1 - b * (x * x + y * y)
    return out


def log_so3(R: Array) -> Array:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3), in radians, at most π long."""
    R = np.asarray(R, dtype=float)
    axis = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    sine = np.sqrt((axis * axis).sum(axis=-1) + TINY)
    # Both are twice what they are called.
    cosine = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0
    phi = axis * (np.arctan2(sine, cosine) / sine)[..., None]
    turned = cosine < HALF_TURN
    if turned.any():
        q = quaternion_xyzw(R[turned])
        sine = np.linalg.norm(q[..., :3], axis=-1)
        phi = phi.copy()
        phi[turned] = q[..., :3] * (2.0 * np.arctan2(sine, q[..., 3]) / sine)[..., None]
    return np.asarray(phi)


def lengths(vectors: Array) -> Array:
    """Lengths (N,) of vectors (N, 3), column by column: `np.linalg.norm` takes four times as long
    over rows so short, for the same digits.
    """
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


class PrincipalAxes(NamedTuple):
    """Centroid (3,) of points, and unit directions (3, 3; columns) from least to widest spread."""

    centre: Array
    axes: Array


def principal_axes(xyz: Array) -> PrincipalAxes:
    """Find the directions in which points (N, 3) spread about their centroid."""
    centre = xyz.mean(axis=0)
    offset = xyz - centre
    return PrincipalAxes(centre, np.asarray(np.linalg.eigh(offset.T @ offset)[1]))


def hat(v: Array) -> Array:
    """Skew matrices (..., 3, 3) of vectors (..., 3): ``hat(a) @ b == cross(a, b)``."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def retract(T: Array, step: Array) -> Array:
    """Move transforms (..., 4, 4) by steps ``[φ, δ]`` (..., 6): ``Exp(φ) R`` and ``t + δ``."""
    turned = exp_so3(step[..., :3]) @ T[..., :3, :3]
    return from_rt(turned, T[..., :3, 3] + step[..., 3:])


def local(T: Array, T_other: Array) -> Array:
    """Step ``[φ, δ]`` (..., 6) that `retract` takes from ``T`` to ``T_other``, in rad and m."""
    turned = log_so3(T_other[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2))
    return np.concatenate([turned, T_other[..., :3, 3] - T[..., :3, 3]], axis=-1)


def local_jacobian(step: Array) -> Array:
    """Derivative (..., 6, 6) of `local` by a further step of the other transform, at ``[φ, δ]``.

    ``Exp(ε) Exp(φ)`` has the rotation vector ``φ + J ε`` to first order in ε, J the inverse of the
    left Jacobian of SO(3).
    """
    angle = np.linalg.norm(step[..., :3], axis=-1)
    across = hat(step[..., :3])
    half = np.maximum(angle, 1e-4) / 2
    share = np.where(angle < 1e-4, 1 / 12, (1 - half / np.tan(half)) / (4 * half**2))
    J = np.zeros((*angle.shape, 6, 6))
    J[...] = np.eye(6)
    J[..., :3, :3] += share[..., None, None] * across @ across - across / 2
    return J


class PoseDifference(NamedTuple):
    """How far from each other two poses are: angle of the rotation, rad, and translation,
    metres."""

    rotation: float
    translation: float


def difference(T: Array, T_other: Array) -> PoseDifference:
    """Angle, rad, and length, m, of the step that `local` gives."""
    step = local(T, T_other)
    return PoseDifference(float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:])))


def difference_at(T: Array, T_other: Array, points: Array) -> PoseDifference:
    """Angle between two poses, rad, and the largest distance of where they put points (N, 3), m."""
    moved = np.linalg.norm(apply(T, points) - apply(T_other, points), axis=1)
    angle = rotation_angle(T[:3, :3] @ T_other[:3, :3].T)
    return PoseDifference(angle, float(moved.max()))


def rotation_angle(R: Array) -> float:
    """Angle in radians of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(log_so3(R)))


def rpy_from_rotation(R: Array) -> Array:
    """Roll, pitch and yaw (3,) in radians of a rotation matrix (3, 3).

    About fixed axes, x first, as in ROS and URDF: ``R = R_z(yaw) R_y(pitch) R_x(roll)``. Where the
    pitch is ± 90° only roll ± yaw is determined; roll is therefore read off what is left of the
    rotation once the yaw is removed, so that the three always give the rotation back.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    # Second row of R_z(yaw)ᵀ R = R_y(pitch) R_x(roll), which is (0, cos roll, −sin roll).
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def rotation_from_rpy(rpy: Array) -> Array:
    """Rotation matrix (3, 3) of roll, pitch and yaw (3,) in radians; see `rpy_from_rotation`."""
    about_x, about_y, about_z = exp_so3(np.diag(rpy))
    return np.asarray(about_z @ about_y @ about_x)


def quaternion_xyzw(R: Array) -> Array:
    """Unit quaternions ``x y z w`` (..., 4) of rotation matrices (..., 3, 3), with w ≥ 0.

    ``4 q qᵀ`` is linear in R (Bar-Itzhack 2000); its column of the largest diagonal is the least
    rounded.
    """
    R = np.asarray(R, dtype=float)
    square = np.empty((*R.shape[:-2], 4, 4))
    square[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    square[..., range(3), range(3)] += (1.0 - trace)[..., None]
    square[..., 3, 3] = 1.0 + trace
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        square[..., k, 3] = square[..., 3, k] = R[..., i, j] - R[..., j, i]
    best = np.argmax(square[..., range(4), range(4)], axis=-1)
    q = np.take_along_axis(square, best[..., None, None], axis=-1)[..., 0]
    q *= np.where(q[..., 3:] < 0, -1.0, 1.0) / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    return np.asarray(q)


def from_quaternion_xyzw(quaternion: Array, translation: Array) -> Array:
    """Build a 4×4 transform from a quaternion ``x y z w`` (normalised here) and a translation."""
    q = np.asarray(quaternion, dtype=float)
    q = q / np.linalg.norm(q)
    across = hat(q[:3])
    R = np.eye(3) + 2 * (q[3] * across + across @ across)
    return from_rt(R, np.asarray(translation))


def random(rng: np.random.Generator, max_translation: float = 10.0) -> Array:
    """Draw a transform: uniform rotation, translation within ± ``max_translation`` m."""
    # Imported where it is used: it takes long.
    from scipy.spatial.transform import Rotation

    R = Rotation.random(None, rng).as_matrix()
    return from_rt(np.asarray(R), rng.uniform(-max_translation, max_translation, 3))


class RelativePose(NamedTuple):
    """Pose of LiDAR j in the frame of LiDAR i.

    Attributes
    ----------
    T_i_j
        (4, 4) maps points of j into the frame of i.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of i: ``R_true = Exp(φ) R``, ``t_true = t + δ``.
    """

    T_i_j: Array
    covariance: Array


def relative(T_i: Array, T_j: Array, joint: Array) -> RelativePose:
    """Compute the pose of one LiDAR in another's frame, with its covariance.

    What both poses have in common (the datum, poles that both saw) cancels, so that two LiDARs far
    from the origin of the site may be certain to each other.

    Parameters
    ----------
    T_i, T_j
        (4, 4) map points of LiDARs i and j into one frame.
    joint
        (12, 12) covariance of both poses together, over ``[φ_i, δ_i, φ_j, δ_j]``, rad and m, axes
        of that frame.

    Returns
    -------
    RelativePose
        ``T_i_j`` and its covariance to first order.
    """
    J = relative_jacobian(T_i, T_j)
    covariance = J @ joint @ J.T
    return RelativePose(inverse(T_i) @ T_j, (covariance + covariance.T) / 2)


def relative_jacobian(T_i: Array, T_j: Array) -> Array:
    """(..., 6, 12) derivative of `relative` by steps of both poses, ``[φ_i, δ_i, φ_j, δ_j]``."""
    to_i = np.swapaxes(T_i[..., :3, :3], -1, -2)
    arm = T_j[..., :3, 3] - T_i[..., :3, 3]
    # R_iᵀ Exp(−φ_i) Exp(φ_j) R_j, and R_iᵀ Exp(−φ_i) (arm + δ_j − δ_i), to first order.
    J = np.zeros((*T_i.shape[:-2], 6, 12))
    J[..., :3, :3], J[..., :3, 6:9] = -to_i, to_i
    J[..., 3:, :3] = to_i @ hat(arm)
    J[..., 3:, 3:6], J[..., 3:, 9:] = -to_i, to_i
    return J


def joint_of(covariance: Array, i: int, j: int) -> Array:
    """Cut out (12, 12) for LiDARs i and j of the (6 L, 6 L) covariance of all poses of a site."""
    rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
    return np.asarray(covariance[np.ix_(rows, rows)])
