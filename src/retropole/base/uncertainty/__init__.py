"""What a covariance means where it matters: at the far end of a scan, and at the poles."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from .. import se3
from ..bounded import Number, PartCovariance, Share, Size, Text, Vector
from ..quantities import error
from ..se3 import Array

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute value: 1 / 0.6745."""

SIGMAS = 3.0
"""Whatever is further off, in units of its 1 σ, is left out: once in 370 times by chance."""

RANGES = (1.0, 10.0, 30.0, 60.0)
"""Ranges at which the error is predicted, metres."""

BUDGET_RANGE = 30.0
"""Range at which the shares of the budget are stated, metres."""

LEVER = 10.0
"""Distance at which a rotation is compared with a translation in the condition number, metres."""

FLOOR_ROTATION, FLOOR_TRANSLATION = float(np.radians(0.003)), 0.0008
"""1 σ about and along each axis that are not modelled, rad and m: bent housings, temperature,
grounds that are not flat, time between the recordings."""

SYMMETRIC = 1e-6
"""A covariance that was read is symmetric and positive up to this part: seven printed digits."""

ALONG = np.cos(np.radians(30.0))
"""A direction within this angle of another goes by its name."""


class BudgetEntry(msgspec.Struct, frozen=True):
    """One source of error, and its part in the uncertainty of the pose.

    Attributes
    ----------
    name
        What errs, such as ``range offset`` or ``scatter of the surfaces``.
    sensor
        Whose error it is; None if it is not of a single LiDAR.
    sigma, unit
        1 σ of the error itself, and its unit: ``m``, ``rad`` or ``1``; not of the pose. Of what is
        no single quantity (scatter, surfaces, unmodelled errors), of a point 30 m away, metres.
    estimated
        The error as this data has it, in the same unit, of which the answer is already free; None
        where it is not estimated or is not one number.
    share_at_30m
        Its share of the variance of where a point 30 m away lands. All shares add up to 1.
    """

    name: Text
    sensor: Literal["target", "source"] | None
    sigma: Size
    unit: Literal["m", "rad", "1"]
    estimated: Number | None
    share_at_30m: Share


class ErrorAtRange(msgspec.Struct, frozen=True):
    """Predicted error of a point at a range, 1 σ, both metres."""

    range_m: Size
    sigma_m: Size


class Uncertainty(msgspec.Struct, frozen=True, eq=False, omit_defaults=True):
    """Uncertainty of a pose in its two kinds (GUM, JCGM 100:2008).

    Attributes
    ----------
    random
        (6, 6) over ``[φ, δ]``, rad and m: type A, from the scatter of these data. Recording again
        draws it again.
    systematic
        (6, 6) type B, from the known errors of the instruments and the poles, and from unmodelled
        errors. Recording again repeats it.
    budget
        Every source of error, the largest first.
    """

    random: PartCovariance
    systematic: PartCovariance
    budget: tuple[BudgetEntry, ...] = ()

    @property
    def covariance(self) -> Array:
        """(6, 6) all errors together."""
        return np.asarray(self.random + self.systematic)


class RadiusEstimate(msgspec.Struct, frozen=True, rename=lambda name: f"{name}_m"):
    """The poles' radius as given and as the data have it, each with its 1 σ, metres.

    Attributes
    ----------
    given, given_sigma, estimated, sigma
        The user's value and its uncertainty; and the estimate from it and the data.
    """

    given: Size
    given_sigma: Size
    estimated: Size
    sigma: Size


class WeakDirection(msgspec.Struct, frozen=True, eq=False, rename={"sigma": "sigma_m"}):
    """The direction in which a pose is least certain, at the poles.

    Attributes
    ----------
    direction, sigma
        (3,) unit vector, target axes, and 1 σ of where the poles lie along it, metres.
    words
        The direction, and how far it may be off, for a person.
    condition
        Ratio of the largest to the least 1 σ of the six directions of the pose, in metres at the
        poles (a rotation counts by how far it moves a point 10 m away).
    """

    direction: Vector
    sigma: Size
    words: Text
    condition: Size


def source_words(name: str, sensor: str | None) -> str:
    """Name a source of error with its LiDAR: ``range offset of the source LiDAR``."""
    return name if sensor is None else f"{name} of the {sensor} LiDAR"


def covariance_fault(C: Array, *, is_part: bool = False) -> str | None:
    """State why a matrix (N, N) is not a covariance; None if it is.

    One part of an uncertainty may have no variance; nobody knows a pose without error.
    """
    if not np.isfinite(C).all():
        return "a number is not finite"
    if np.abs(C - C.T).max() > SYMMETRIC * np.abs(C).max():
        return "a covariance is symmetric, this is not"
    variances = np.diag(C)
    if (variances < 0).any():
        return f"a variance is negative ({variances.min():.3g})"
    sigma = np.sqrt(variances)
    is_certain = sigma == 0
    if is_certain.any() and not is_part:
        return "a variance is zero"
    if np.abs(C[is_certain]).max(initial=0.0) > 0:
        return "an entry without variance has correlations"
    scale = np.where(is_certain, 1.0, sigma)
    least = float(np.linalg.eigvalsh(C / np.outer(scale, scale))[0])
    if least < -SYMMETRIC:
        return f"no covariance: its correlations have an eigenvalue of {least:.3g}"
    return None


def floor() -> Array:
    """(6, 6) of unmodelled errors: no pose is stated with less uncertainty."""
    return np.diag(np.r_[np.full(3, FLOOR_ROTATION), np.full(3, FLOOR_TRANSLATION)] ** 2)


def predicted_error(
    covariance: Array | None, ranges: tuple[float, ...] = RANGES
) -> tuple[ErrorAtRange, ...]:
    """Predict the error of where a source point lands in the target frame, by its range.

    Parameters
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m: ``R_true = Exp(φ) R``, ``t_true = t + δ``. None predicts
        nothing.
    ranges
        Distances of the point from the source's origin, metres.

    Returns
    -------
    tuple of ErrorAtRange
        1 σ in metres: the root of the mean square length of ``φ × R p + δ``, over the error and
        over all directions of p.
    """
    if covariance is None:
        return ()
    # Six directions that average as the sphere does, for anything quadratic in the direction.
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    predictions = []
    for distance in ranges:
        J = np.concatenate(
            [-se3.hat(distance * directions), np.broadcast_to(np.eye(3), (6, 3, 3))], axis=2
        )
        variance = np.einsum("mij,jk,mik->m", J, covariance, J)
        predictions.append(ErrorAtRange(distance, float(np.sqrt(variance.mean()))))
    return tuple(predictions)


def covariance_at(covariance: Array, T: Array, point: Array) -> Array:
    """Express a covariance about another point: (6, 6) over ``[φ, δ at the point]``.

    Parameters
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, target axes: δ is the translation of the source's origin.
    T
        (4, 4) the pose, target from source.
    point
        (3,) in the target frame: δ becomes the translation of what is there,
        ``δ + φ × (point − t)``.
    """
    J = np.eye(6)
    J[3:, :3] = -se3.hat(point - T[:3, 3])
    return np.asarray(J @ covariance @ J.T)


def weakest_direction(
    T: Array, covariance: Array, axis_points: Array, axis_directions: Array
) -> WeakDirection:
    """Name the direction in which it is least certain where the poles are.

    Without any, where the source is.

    Parameters
    ----------
    T, covariance
        (4, 4) and (6, 6) the pose, target from source, and its covariance.
    axis_points, axis_directions
        (K, 3) the axes of the poles, target frame.
    """
    middle = axis_points.mean(axis=0) if len(axis_points) else T[:3, 3]
    at = covariance_at(covariance, T, middle)
    values, vectors = np.linalg.eigh(at[3:, 3:])
    direction, sigma = vectors[:, 2], float(np.sqrt(max(values[2], 0.0)))
    mean, between = np.zeros(3), np.zeros(3)
    if len(axis_points):
        # Poles have no sign: their mean direction is that of their scatter.
        mean = np.linalg.eigh(axis_directions.T @ axis_directions)[1][:, 2]
        between = axis_points[-1] - axis_points[0]
        between = between - (between @ mean) * mean
        between = between / max(float(np.linalg.norm(between)), 1e-9)
    if abs(float(direction @ mean)) > ALONG:
        name = "height along the poles"
    elif abs(float(direction @ between)) > ALONG:
        name = "sideways, from pole to pole"
    elif abs(float(direction @ np.cross(mean, between))) > ALONG:
        name = "across the plane of the poles"
    else:
        name = "aslant, along ({:+.2f} {:+.2f} {:+.2f}) of the target".format(*direction)
    scale = np.diag([LEVER, LEVER, LEVER, 1.0, 1.0, 1.0])
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(scale @ at @ scale), 1e-30))
    return WeakDirection(direction, sigma, f"{name}: {error(sigma)}", float(spread[-1] / spread[0]))
