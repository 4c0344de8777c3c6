"""Where beams meet a taped pole, and what that does to a line fitted to the returns.

Xue et al. 2019 walk along the facing arc of the pole by solving eq. 5 for each step. Intersecting
every beam with the cylinder in closed form gives the same points, is exact, and holds for beams
off the middle, which sweep a cone and not the plane of eq. 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .datatypes import Array, BoolArray

OUTLIERS, OUTLIER_REACH = 0.02, 0.3
"""Share of returns that may be no part of a pole, and how far from it they may lie, metres."""

NODES = 20
"""Of the integral over the arc that returns come from."""

_GAUSS, _GAUSS_WEIGHT = np.polynomial.legendre.leggauss(NODES)


@dataclass(frozen=True, eq=False)
class Passage:
    """How beams pass an axis, before the radius of the pole comes in.

    Attributes
    ----------
    nearest
        (N,) range along the beam at which it is nearest to the axis, metres.
    miss
        (N,) signed distance between beam and axis there, metres.
    sine
        (N,) sine of the angle between beam and axis.
    nearest_axis, miss_axis, sine_axis
        (N, 6) derivatives with respect to the axis: its point, then its direction.
    """

    nearest: Array
    miss: Array
    sine: Array
    nearest_axis: Array
    miss_axis: Array
    sine_axis: Array


def _cross(a: Array, b: Array) -> Array:
    """Cross products of (N, 3) rows; np.cross takes twice as long over so few."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def pass_axis(origin: Array, directions: Array, point: Array, axis: Array) -> Passage:
    """Pass beams by an axis.

    Parameters
    ----------
    origin
        (3,) or (N, 3) where the beams start, metres.
    directions
        (N, 3) unit vectors of the beams.
    point, axis
        (3,) or (N, 3) a point on the axis and its unit direction.

    Returns
    -------
    Passage
        Derivatives take the direction as free; a caller that keeps it of unit length projects.
        A beam along the axis has ``sine`` 0 and nothing else of it is finite.
    """
    d, n = np.broadcast_arrays(directions, axis)
    w = np.broadcast_to(origin - point, d.shape)
    cosine = np.sum(d * n, axis=1)
    w_axis = np.sum(w * n, axis=1)
    square = 1.0 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        sine = np.sqrt(square)
        b = np.sum(w * d, axis=1) - w_axis * cosine
        nearest = -b / square
        miss = np.sum(w * _cross(d, n), axis=1) / sine
        sine_n = -(cosine / sine)[:, None] * d
        b_q = -d + cosine[:, None] * n
        b_n = -cosine[:, None] * w - w_axis[:, None] * d
        nearest_q = -b_q / square[:, None]
        nearest_n = -b_n / square[:, None] + (2 * b / (square * sine))[:, None] * sine_n
        miss_q = -_cross(d, n) / sine[:, None]
        miss_n = _cross(w, d) / sine[:, None] - (miss / sine)[:, None] * sine_n
    return Passage(
        nearest,
        miss,
        sine,
        np.concatenate([nearest_q, nearest_n], axis=1),
        np.concatenate([miss_q, miss_n], axis=1),
        np.concatenate([np.zeros_like(sine_n), sine_n], axis=1),
    )


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where beams meet a cylinder.

    Attributes
    ----------
    ranges
        (N,) range to the near side, metres; infinite where the beam misses, runs along the axis
        or would have to go backwards.
    hit
        (N,) whether the beam meets it.
    jacobian
        (N, 6) derivative of the range with respect to the axis: its point, then its direction.
        Zero where missed; it grows without bound towards the edge.
    """

    ranges: Array
    hit: BoolArray
    jacobian: Array


def meet_cylinder(
    origin: Array, directions: Array, point: Array, axis: Array, radius: float
) -> Meeting:
    """Range at which beams meet an infinite cylinder (eq. 3–6, in closed form).

    ``s = nearest − √(r² − miss²) / sine`` with the quantities of `pass_axis`, which describes the
    first four parameters. ``radius`` is in metres.
    """
    by = pass_axis(origin, directions, point, axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        chord = np.sqrt(radius**2 - by.miss**2)
        ranges = by.nearest - chord / by.sine
        hit = np.isfinite(ranges) & (chord > 0) & (ranges > 0)
        jacobian = (
            by.nearest_axis
            + (by.miss / (chord * by.sine))[:, None] * by.miss_axis
            + (chord / by.sine**2)[:, None] * by.sine_axis
        )
    return Meeting(np.where(hit, ranges, np.inf), hit, np.where(hit[:, None], jacobian, 0.0))


def line_error(centre: Array, direction: Array, heights: tuple[float, float]) -> float:
    """Mean-square distance of a line from the z axis between two heights, square metres.

    ``E = n_z/(z_max − z_min) ∫ [(x_c + n_x s)² + (y_c + n_y s)²] ds`` with s from
    ``(z_min − z_c)/n_z`` to ``(z_max − z_c)/n_z``. Xue et al. 2019 print a product between the two
    squares; only the sum gives their Table II.

    Parameters
    ----------
    centre, direction
        (3,) a point on the line (x_c, y_c, z_c) and its direction, which must not be level.
    heights
        z_min and z_max, metres.
    """
    slope = direction[:2] / direction[2]
    # In z the integrand is a parabola: its mean is the middle squared plus slope² · span²/12.
    middle = centre[:2] + slope * (0.5 * (heights[0] + heights[1]) - centre[2])
    span = heights[1] - heights[0]
    return float(middle @ middle + slope @ slope * span**2 / 12.0)


def expected_line_error(radius: float) -> float:
    """Mean-square distance of a fitted line from the axis that `line_error` tends to: (π r/4)².

    Beams evenly spaced across the pole meet it π r/4 in front of the axis on average: a bias
    towards the sensor, which no number of returns averages away.
    """
    return (np.pi * radius / 4.0) ** 2


@dataclass(frozen=True, eq=False)
class ArcLikelihood:
    """Log-likelihood of returns on a pole, and its derivatives.

    Attributes
    ----------
    log
        (N,) logarithm of p(g, m), per square metre.
    score
        (N, 2) its derivative with respect to g and m.
    information
        (N, 2, 2) its negative second derivative.
    inlier
        (N,) probability that the return is one of the pole.
    noise
        (N, 2) expected square of the noise in g and in m, in units of its variance.
    noise_variance
        (N, 2) variance of those squares, given the return.
    """

    log: Array
    score: Array
    information: Array
    inlier: Array
    noise: Array
    noise_variance: Array


def arc_likelihood(
    depth: Array, miss: Array, sigma_depth: Array, sigma_miss: Array, radius: float, facing: bool
) -> ArcLikelihood:
    """Likelihood of returns that beams made on a pole; see the head of this module.

    Parameters
    ----------
    depth, miss
        (N,) g and m, metres.
    sigma_depth, sigma_miss
        (N,) noise of g and m, metres.
    radius
        Of the pole, metres.
    facing
        Whether returns come from the facing half only, or from all around.
    """
    if facing:
        # Only what lies within a few sigma sideways counts; the integral is cut to that.
        reach = 5.0 * sigma_miss
        low = np.clip(miss - reach, -radius, radius - np.minimum(reach, radius))
        high = np.clip(miss + reach, np.minimum(reach, radius) - radius, radius)
        safe = max(radius, 1e-300)
        start, end = np.arcsin(low / safe), np.arcsin(high / safe)
        theta = start[:, None] + (end - start)[:, None] * (0.5 + 0.5 * _GAUSS)
        weight = (end - start)[:, None] * 0.25 * _GAUSS_WEIGHT * np.cos(theta)
        if radius <= 1e-9:
            weight = np.full_like(theta, 1.0 / NODES)
    else:
        theta = np.broadcast_to(np.arange(2 * NODES) * (np.pi / NODES), (len(depth), 2 * NODES))
        weight = np.full_like(theta, 0.5 / NODES)
    inverse = np.stack([1.0 / sigma_depth, 1.0 / sigma_miss], axis=1)
    off_depth = (radius * np.cos(theta) - depth[:, None]) * inverse[:, :1]
    off_miss = (radius * np.sin(theta) - miss[:, None]) * inverse[:, 1:]
    square_depth, square_miss = off_depth**2, off_miss**2
    exponent = -0.5 * (square_depth + square_miss)
    top = exponent.max(axis=1)
    part = weight * np.exp(exponent - top[:, None])
    total = part.sum(axis=1)
    part /= total[:, None]
    log_pole = top + np.log(total * (1 - OUTLIERS) / (2 * np.pi) * inverse[:, 0] * inverse[:, 1])
    log = np.logaddexp(log_pole, np.log(OUTLIERS / (np.pi * OUTLIER_REACH**2)))
    inlier = np.exp(log_pole - log)

    def mean(values: Array) -> Array:
        return np.asarray(np.einsum("nk,nk->n", part, values))

    noise = np.stack([mean(square_depth), mean(square_miss)], axis=1)
    fourth = np.stack([mean(square_depth**2), mean(square_miss**2)], axis=1)
    score = inlier[:, None] * inverse * np.stack([mean(off_depth), mean(off_miss)], axis=1)
    information = np.empty((len(depth), 2, 2))
    information[:, 0, 0] = inlier * (1.0 - noise[:, 0]) * inverse[:, 0] ** 2
    information[:, 1, 1] = inlier * (1.0 - noise[:, 1]) * inverse[:, 1] ** 2
    cross = -inlier * mean(off_depth * off_miss) * inverse[:, 0] * inverse[:, 1]
    information[:, 0, 1] = information[:, 1, 0] = cross
    information += score[:, :, None] * score[:, None, :]
    return ArcLikelihood(log, score, information, inlier, noise, fourth - noise**2)
