"""Pose from matched poles by the paper's least squares: points of one LiDAR on lines of the other.

Xue et al. 2019, eq. 1–2: ``R*, t* = argmin Σ_n Σ_k π_nk ‖d(R p_n + t, line_k)‖²`` with lines from
the target LiDAR and points from the source LiDAR. It is fast and needs no model of the sensor, so
every hypothesis is judged with it.

Its limit is a bias, not noise: returns lie on the side of a pole that faces the sensor, on average
π r/4 in front of its axis, and each LiDAR errs towards itself. `beam_alignment` is without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se3
from ..datatypes import Array
from ..errors import Refusal

MAX_ITERATIONS = 60
STEP_TOLERANCE = 1e-9
"""Stop where the step (rad and m together) is below this."""


@dataclass(frozen=True, eq=False)
class LineAlignment:
    """Least-squares pose of points on lines.

    Attributes
    ----------
    T_target_source
        (4, 4) pose that maps the source points onto the target lines.
    rms
        Root mean square distance of the points from their lines at the solution, metres.
    information
        (6, 6) Gauss–Newton matrix ``JᵀJ`` over ``[φ, δ]`` in target axes, per unit variance of a
        point's distance from its line.
    """

    T_target_source: Array
    rms: float
    information: Array


def point_line_residuals(
    T: Array, points: Array, line_points: Array, line_directions: Array
) -> tuple[Array, Array]:
    """Vectors from lines to moved points, and their Jacobian.

    Parameters
    ----------
    T
        (4, 4) pose, target from source.
    points
        (N, 3) points in the source frame.
    line_points, line_directions
        (N, 3) a point and the unit direction of each point's line, in the target frame.

    Returns
    -------
    residuals : (N, 3)
        ``(I − n nᵀ)(R p + t − q)``, metres.
    jacobian : (N, 3, 6)
        Derivative with respect to ``[φ, δ]`` of `se3.retract`.
    """
    rotated = points @ T[:3, :3].T
    across = np.eye(3) - line_directions[:, :, None] * line_directions[:, None, :]
    residuals = np.einsum("nij,nj->ni", across, rotated + T[:3, 3] - line_points)
    jacobian = np.concatenate([across @ -se3.hat(rotated), across], axis=2)
    return residuals, jacobian


def equivalent_points(xyz: Array) -> Array:
    """Six points (6, 3) with the mean and the scatter of many (N, 3).

    The sum of the squared distances of points from a line is a function of their first two moments:
    N/6 times that of these six is that of all, wherever they are moved.
    """
    mean = xyz.mean(axis=0)
    _, sizes, axes = np.linalg.svd(xyz - mean, full_matrices=False)
    arms = np.zeros((3, 3))
    arms[: len(sizes)] = np.sqrt(3.0 / len(xyz)) * sizes[:, None] * axes
    return np.concatenate([mean + arms, mean - arms])


def align_poles(
    target_lines: Sequence[tuple[Array, Array]], source_points: Sequence[Array], T_start: Array
) -> LineAlignment:
    """Minimise the squared distances of source points from target lines (eq. 1–2).

    Levenberg–Marquardt from ``T_start``; the minimum found is the local one of that start, as each
    hypothesis needs.

    Parameters
    ----------
    target_lines
        A point on each target pole and its unit direction, target frame.
    source_points
        (N_k, 3) the points on each source pole, paired by their order (π_nk of the paper).
    T_start
        (4, 4) start, target from source.

    Raises
    ------
    Refusal
        ``degenerate_poles`` where the lines leave a direction of the pose free (parallel poles, a
        single pole), with the ratio of the singular values.
    """
    points = np.concatenate([equivalent_points(xyz) for xyz in source_points])
    counts = np.array([len(xyz) for xyz in source_points])
    root = np.sqrt(np.repeat(counts, 6) / 6.0)
    q, n = (np.repeat([line[part] for line in target_lines], 6, axis=0) for part in (0, 1))

    def weighted(T: Array) -> tuple[Array, Array]:
        residuals, jacobian = point_line_residuals(T, points, q, n)
        return root[:, None] * residuals, root[:, None, None] * jacobian

    T, damping = T_start, 1e-6
    residuals, J = weighted(T)
    cost = float(np.sum(residuals**2))
    for _ in range(MAX_ITERATIONS):
        H = np.einsum("nij,nik->jk", J, J)
        g = np.einsum("nij,ni->j", J, residuals)
        # Marquardt's scaling keeps radians and metres from being weighed against each other.
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12), g)
        T_new = se3.retract(T, step)
        residuals_new, J_new = weighted(T_new)
        cost_new = float(np.sum(residuals_new**2))
        if cost_new <= cost:
            T, residuals, J, cost = T_new, residuals_new, J_new, cost_new
            damping = max(damping / 10.0, 1e-15)
        else:
            damping *= 10.0
        if np.linalg.norm(step) < STEP_TOLERANCE or damping > 1e8:
            break
    H = np.einsum("nij,nik->jk", J, J)
    _check_rank(H)
    return LineAlignment(T, float(np.sqrt(cost / counts.sum())), H)


def _check_rank(H: Array) -> None:
    """Refuse a pose that the poles leave free in some direction."""
    scale = np.sqrt(np.diag(H) + 1e-300)
    eigenvalues = np.linalg.eigvalsh(H / np.outer(scale, scale))
    ratio = float(eigenvalues[0] / eigenvalues[-1])
    if not np.isfinite(ratio) or ratio < 1e-9:
        raise Refusal(
            "degenerate_poles",
            f"the poles leave one direction of the pose free (eigenvalue ratio {ratio:.1e}); "
            "lean one pole by 15° or more against the other",
            {"eigenvalue_ratio": ratio},
        )
