"""Pose from matched poles by the paper's least squares: points of one LiDAR on lines of the other.

Xue et al. 2019, eq. 1–2: ``R*, t* = argmin Σ_n Σ_k π_nk ‖d(R p_n + t, line_k)‖²`` with lines from
the target LiDAR and points from the source LiDAR. It is fast and needs no model of the sensor, so
every hypothesis is solved with it, all of them at once.

Its limit is a bias, not noise: returns lie on the side of a pole that faces the sensor, on average
π r/4 in front of its axis, and each LiDAR errs towards itself. `adjustment` has no such bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.errors import Refusal
from .solver import ROUNDING, Quadratics, levenberg_marquardt_each


@dataclass(frozen=True, eq=False)
class LineAlignment:
    """Least-squares pose of points on lines.

    Attributes
    ----------
    T_target_source
        (4, 4) pose that maps the source points onto the target lines.
    rms
        Root mean square distance of the points from their lines at the solution, metres.
    converged
        Whether the solver came to rest.
    information
        (6, 6) Gauss–Newton matrix ``JᵀJ`` over ``[φ, δ]`` in target axes, per unit variance of a
        point's distance from its line.
    """

    T_target_source: Array
    rms: float
    converged: bool
    information: Array


class PointLineResiduals(NamedTuple):
    """Vectors from lines to moved points, and their derivative.

    Attributes
    ----------
    residuals
        (..., N, 3) ``(I − n nᵀ)(R p + t − q)``, metres.
    jacobian
        (..., N, 3, 6) derivative with respect to ``[φ, δ]`` of `se3.retract`.
    """

    residuals: Array
    jacobian: Array


def point_line_residuals(
    T: Array, points: Array, line_points: Array, line_directions: Array
) -> PointLineResiduals:
    """Move points by a pose, and take the vectors from their lines to them.

    Parameters
    ----------
    T
        (..., 4, 4) poses, target from source.
    points
        (..., N, 3) points in the source frame.
    line_points, line_directions
        (..., N, 3) a point and the unit direction of each point's line, in the target frame.
    """
    rotated = points @ np.swapaxes(T[..., :3, :3], -1, -2)
    across = np.eye(3) - line_directions[..., :, None] * line_directions[..., None, :]
    off = rotated + T[..., None, :3, 3] - line_points
    residuals = (across @ off[..., None])[..., 0]
    jacobian = np.concatenate([across @ -se3.hat(rotated), across], axis=-1)
    return PointLineResiduals(residuals, jacobian)


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


class Lines(NamedTuple):
    """Points of the source, and the lines of the target that they belong to, of B problems.

    Attributes
    ----------
    on_poles
        (B, N, 3) source frame, metres.
    line_points, line_directions
        (B, N, 3) a point and the unit direction of each one's line, target frame.
    counts
        (B, N) how many returns each represents; none where a problem has fewer points than others.
    """

    on_poles: Array
    line_points: Array
    line_directions: Array
    counts: Array


def align_each(lines: Lines, starts: Array) -> list[LineAlignment]:
    """Minimise the squared distances of B problems at once, each from its start (B, 4, 4).

    Raises
    ------
    Refusal
        ``degenerate_poles`` where the lines of one leave a direction of its pose free.
    """
    roots = np.sqrt(lines.counts)[:, :, None]

    def squared_distances(T: Array, which: IntArray) -> Quadratics:
        own = (each[which] for each in lines[:3])
        residuals, jacobian = point_line_residuals(T, *own)
        r = (roots[which] * residuals).reshape(len(T), -1, 1)
        J = (roots[which, :, :, None] * jacobian).reshape(len(T), -1, 6)
        transposed = np.swapaxes(J, 1, 2)
        return Quadratics(np.sum(r**2, axis=(1, 2)), (transposed @ r)[:, :, 0], transposed @ J)

    # A step of rounding, rad and m together, is far below any noise.
    found = levenberg_marquardt_each(starts, squared_distances, se3.retract, tolerance=ROUNDING)
    _check_rank(found.models.curvatures)
    rms = np.sqrt(found.models.costs / lines.counts.sum(axis=1))
    each = zip(found.ends, rms, found.came_to_rest, found.models.curvatures, strict=True)
    return [LineAlignment(T, float(s), bool(rests), H) for T, s, rests, H in each]


def _check_rank(H: Array) -> None:
    """Refuse where poles leave one of B poses free in some direction; H is (B, 6, 6)."""
    scale = np.sqrt(np.einsum("bii->bi", H) + 1e-300)
    eigenvalues = np.linalg.eigvalsh(H / (scale[:, :, None] * scale[:, None, :]))
    ratio = float(np.min(eigenvalues[:, 0] / eigenvalues[:, -1], initial=1.0))
    if not np.isfinite(ratio) or ratio < ROUNDING:
        raise Refusal(
            "degenerate_poles",
            f"the poles do not determine one direction of the pose (eigenvalue ratio {ratio:.1e}); "
            "lean one pole by 15° or more against the other",
            {"eigenvalue_ratio": ratio},
        )
