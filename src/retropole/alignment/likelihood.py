"""Likelihood of the axis of a taped pole given a return, and given a beam that passed it.

Xue et al. 2019, eq. 3 and 4, walk along the facing arc of the pole and solve eq. 4 for each step.
Here every beam is compared with the cylinder in closed form. That is exact, and covers beams off
the middle too, which sweep a cone and not the plane of eq. 3.

In the plane across the axis, seen from the LiDAR, a return lies a depth g in front of the axis and
has a lateral offset m from it. Without noise ``g = √(r² − m²)`` with ``|m| ≤ r``. With noise σ_g in
depth and σ_m sideways, and beams evenly spaced across the pole,

    p(g, m) = 1/2(r+w) ∫_{−r−w}^{r+w} N(g; √max(r² − x², 0), σ_g²) N(m; x, σ_m²) dx,

the facing half of the circle, blurred; w is how far outside the pole the middle of a wide beam may
be and still return from its edge. For σ_m → 0 its logarithm is the squared difference of the
measured range from that at which the beam hits the pole; a return whose beam would miss the pole
is penalised smoothly in σ_m. A beam that went on to something behind the pole has the likelihood

    P(passed) = 1 − Φ((r + w − m)/σ_m) + Φ((−r − w − m)/σ_m).

The factor 1/2(r+w) states that all beams of which anything is known hit the pole: a wider one must
then share them out further. Where the beams next to the pole are recorded as well, it is known
where beams went, and each counts by its outcome: p(g, m) without that factor, or P(passed). With
both, the pole would be found too slim, by the more of its 1 σ the more returns there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from ..base.datatypes import DEFAULT_RADIUS, Array

OUTLIERS, OUTLIER_RADIUS = 0.02, 0.3
"""Share of returns that may be no part of a pole, and how far from it they may lie, metres: what is
farther behind it is something else."""

MISSED_SHARE = 0.05
"""Share of the beams towards a pole that may return from behind it all the same."""

NODES, FEW_NODES = 20, 6
"""Of the integral over the arc; over each edge outside it, and over the uncertainty of
an axis. With 16 the derivatives of the arc no longer agree with its differences."""

MAX_SIDEWAYS_SIGMAS = 6.0
"""The integral leaves out what is further than this many σ_m away sideways: 2e-9 of a normal
distribution."""

_GAUSS, _GAUSS_WEIGHT = np.polynomial.legendre.leggauss(NODES)
_EDGE, _EDGE_WEIGHT = np.polynomial.legendre.leggauss(FEW_NODES)


@dataclass(frozen=True, eq=False)
class ClosestApproach:
    """Where beams come closest to an axis; the radius of the pole plays no part.

    Attributes
    ----------
    ranges
        (N,) range along the beam of the point closest to the axis, metres.
    lateral_offset
        (N,) signed distance between beam and axis there, metres.
    sine
        (N,) sine of the angle between beam and axis.
    ranges_by_axis, lateral_offset_by_axis, sine_by_axis
        (N, 6) derivatives with respect to the axis: its point, then its direction.
    """

    ranges: Array
    lateral_offset: Array
    sine: Array
    ranges_by_axis: Array
    lateral_offset_by_axis: Array
    sine_by_axis: Array


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of (N, 3) rows; a sum over so short an axis takes four times as long."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def _cross(a: Array, b: Array) -> Array:
    """Cross products of (N, 3) rows; np.cross takes twice as long for few rows."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def closest_approach(
    origin: Array, directions: Array, point: Array, axis: Array
) -> ClosestApproach:
    """Find where beams come closest to an axis.

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
    ClosestApproach
        Derivatives take the direction as free; a caller that keeps it of unit length projects.
        A beam along the axis has ``sine`` 0 and no other value is finite.
    """
    d, n = np.broadcast_arrays(directions, axis)
    w = np.broadcast_to(origin - point, d.shape)
    across = _cross(d, n)
    cosine = _dot(d, n)
    w_axis = _dot(w, n)
    square = 1.0 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        sine = np.sqrt(square)
        b = _dot(w, d) - w_axis * cosine
        ranges = -b / square
        lateral_offset = _dot(w, across) / sine
        sine_n = -(cosine / sine)[:, None] * d
        b_q = -d + cosine[:, None] * n
        b_n = -cosine[:, None] * w - w_axis[:, None] * d
        ranges_q = -b_q / square[:, None]
        ranges_n = -b_n / square[:, None] + (2 * b / (square * sine))[:, None] * sine_n
        lateral_q = -across / sine[:, None]
        lateral_n = _cross(w, d) / sine[:, None] - (lateral_offset / sine)[:, None] * sine_n
    return ClosestApproach(
        ranges,
        lateral_offset,
        sine,
        np.concatenate([ranges_q, ranges_n], axis=1),
        np.concatenate([lateral_q, lateral_n], axis=1),
        np.concatenate([np.zeros_like(sine_n), sine_n], axis=1),
    )


@dataclass(frozen=True, eq=False)
class ArcLikelihood:
    """Log-likelihood of returns on a pole, and its derivatives.

    Attributes
    ----------
    log
        (N,) logarithm of p(g, m), per square metre.
    score
        (N, 3) its derivative with respect to g, m and r.
    information
        (N, 3, 3) its negative second derivative.
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
    depth: Array,
    lateral_offset: Array,
    sigma_depth: Array,
    sigma_lateral: Array,
    radius: float,
    half_width: Array | float = 0.0,
    passed_share: Array | float = 0.0,
) -> ArcLikelihood:
    """Likelihood of returns that beams made on a pole; see the head of this module.

    Parameters
    ----------
    depth, lateral_offset
        (N,) g and m, metres.
    sigma_depth, sigma_lateral
        (N,) noise of g and m, metres.
    radius
        Of the pole, metres; zero is a line.
    half_width
        (N,) w, metres: half of the beam's width at the pole.
    passed_share
        (N,) share of the beams next to the pole that were recorded there, 0 to 1: the factor
        1/2(r+w) counts with the rest.
    """
    alone = 1.0 - np.asarray(passed_share, dtype=np.float64)
    w = np.broadcast_to(np.asarray(half_width, dtype=np.float64), depth.shape)
    safe = max(radius, 1e-9)
    # Half of what the beams are shared out over, to the power of those next to which none are
    # known: of a usual pole, so that as large a share of its beams are outliers.
    room = DEFAULT_RADIUS + w
    room = room * ((safe + w) / room) ** alone
    span = MAX_SIDEWAYS_SIGMAS * sigma_lateral
    cosine, sine, beyond, weight = _nodes(lateral_offset, span, radius, w, room)
    arc = len(cosine)
    inverse_depth, inverse_lateral = 1.0 / sigma_depth, 1.0 / sigma_lateral
    x = np.empty_like(weight)
    x[:arc], x[arc:] = (radius * cosine - depth) * inverse_depth, -depth * inverse_depth
    y = (radius * sine - lateral_offset) * inverse_lateral
    y[arc:] += beyond * inverse_lateral
    xx, yy = x * x, y * y
    exponent = -0.5 * (xx + yy)
    top = exponent.max(axis=0)
    part = weight * np.exp(exponent - top)
    total = part.sum(axis=0)
    part /= total
    scale = (1 - OUTLIERS) / (2 * np.pi) / (sigma_depth * sigma_lateral)
    log_pole = top + np.log(total * scale)
    log = np.logaddexp(log_pole, np.log(OUTLIERS / (np.pi * OUTLIER_RADIUS**2)))
    inlier = np.exp(log_pole - log)

    def mean(weighted: Array, values: Array) -> Array:
        return np.asarray(np.einsum("kn,kn->n", weighted, values))

    # Derivatives of a node's exponent with respect to g, m, r, of which x and y are the first two
    # in units of the noise, and the mean of what they leave. Weights depend on r too: what the
    # gradient and the curvature of their logarithm have on the arc in addition to those of
    # 1/2(r+w).
    z = -(y * sine) * inverse_lateral
    z[:arc] += 1 / safe - x[:arc] * cosine * inverse_depth
    px, py, pz = part * x, part * y, part * z
    whole = alone / (safe + w)
    mean_z = pz.sum(axis=0)
    of = np.stack(
        [px.sum(axis=0) * inverse_depth, py.sum(axis=0) * inverse_lateral, mean_z - whole]
    )
    score = inlier * of
    mean_xx, mean_yy = mean(px, x), mean(py, y)
    on_arc = part[:arc]
    second = np.empty((3, 3, len(depth)))
    second[0, 0] = (1.0 - mean_xx) * inverse_depth**2
    second[1, 1] = (1.0 - mean_yy) * inverse_lateral**2
    second[0, 1] = second[1, 0] = -mean(px, y) * inverse_depth * inverse_lateral
    second[0, 2] = whole * of[0] - mean(px, z) * inverse_depth
    second[0, 2] -= mean(on_arc, cosine) * inverse_depth**2
    second[1, 2] = whole * of[1] - mean(py, z) * inverse_lateral
    second[1, 2] -= mean(part, sine) * inverse_lateral**2
    second[2, :2] = second[:2, 2]
    second[2, 2] = mean(on_arc, cosine**2) * inverse_depth**2
    second[2, 2] += mean(part, sine**2) * inverse_lateral**2 + on_arc.sum(axis=0) / safe**2
    second[2, 2] -= mean(pz, z) - 2.0 * whole * mean_z + whole**2 + alone / (safe + w) ** 2
    information = inlier * second + score[:, None] * score
    noise = np.stack([mean_xx, mean_yy], axis=1)
    fourth = np.stack([mean(part * xx, xx), mean(part * yy, yy)], axis=1)
    by_return = np.ascontiguousarray(information.transpose(2, 0, 1))
    return ArcLikelihood(log, score.T.copy(), by_return, inlier, noise, fourth - noise**2)


def _nodes(
    lateral_offset: Array, span: Array, radius: float, half_width: Array, room: Array
) -> tuple[Array, Array, Array, Array]:
    """Nodes of the integral over the arc, ``x = r sin θ``, and over the edges outside it.

    Parameters
    ----------
    lateral_offset, span
        (N,) of each return, and how far from it the arc is cut, metres.
    radius, half_width, room
        Of the pole, (N,) w, and (N,) half of what beams are shared out over, metres.

    Returns
    -------
    cosine, sine, beyond, weight
        (A, N) of nodes on the arc; (K, N) of all, ± 1 on the edges; (K − A, N) how far those of the
        edges lie outside it, metres; and (K, N). A row is a node: sums over short rows would take
        several times as long.
    """
    low = np.clip(lateral_offset - span, -radius, radius - np.minimum(span, radius))
    high = np.clip(lateral_offset + span, np.minimum(span, radius) - radius, radius)
    safe = max(radius, 1e-9)
    start, end = np.arcsin(low / safe), np.arcsin(high / safe)
    theta = start + (end - start) * (0.5 + 0.5 * _GAUSS[:, None])
    cosine = np.cos(theta)
    count = 2 * FEW_NODES if radius > 1e-9 and half_width.any() else 0
    sine, weight = np.empty((2, NODES + count, len(start)))
    np.sin(theta, out=sine[:NODES])
    if radius <= 1e-9:
        weight[:NODES] = 1.0 / NODES
    else:
        by_angle = (end - start) * (radius / (4 * room))
        weight[:NODES] = by_angle * _GAUSS_WEIGHT[:, None] * cosine
    if not count:
        return cosine, sine, np.zeros((0, len(start))), weight
    sine[NODES : NODES + FEW_NODES], sine[NODES + FEW_NODES :] = 1.0, -1.0
    beyond = 0.5 * half_width * (1 + _EDGE[:, None])
    edge = 0.5 * _EDGE_WEIGHT[:, None] * (half_width / (2 * room))
    weight[NODES:] = np.concatenate([edge, edge])
    return cosine, sine, np.concatenate([beyond, -beyond]), weight


@dataclass(frozen=True, eq=False)
class PassedBeamLikelihood:
    """Log-probability that beams passed next to a pole, and its derivatives.

    Attributes
    ----------
    log
        (N,) logarithm of the probability.
    score
        (N, 2) its derivative with respect to m and r.
    information
        (N, 2, 2) its negative second derivative.
    """

    log: Array
    score: Array
    information: Array


def passed_beam_likelihood(
    lateral_offset: Array, sigma_lateral: Array, radius: float, half_width: Array | float = 0.0
) -> PassedBeamLikelihood:
    """Probability that beams passed next to a pole; see the head of this module.

    Parameters
    ----------
    lateral_offset, sigma_lateral
        (N,) m and its noise, metres.
    radius
        Of the pole, metres.
    half_width
        (N,) w, metres. An edge that a wide beam touches may return or not, so the middle of its
        part counts.
    """
    s = 1.0 / sigma_lateral
    right, left = (
        (radius + half_width - lateral_offset) * s,
        (-radius - half_width - lateral_offset) * s,
    )
    density = [np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi) for x in (right, left)]
    keep = 1.0 - MISSED_SHARE
    p = MISSED_SHARE + keep * (1.0 - ndtr(right) + ndtr(left))
    # First and second derivatives of p with respect to m and r.
    p_m, p_r = keep * s * (density[0] - density[1]), -keep * s * (density[0] + density[1])
    curve = [-x * d * keep * s**2 for x, d in zip((right, left), density, strict=True)]
    p_mm, p_mr, p_rr = curve[1] - curve[0], curve[0] + curve[1], -curve[0] + curve[1]
    score = np.stack([p_m / p, p_r / p], axis=1)
    second = np.stack([np.stack([p_mm, p_mr], axis=1), np.stack([p_mr, p_rr], axis=1)], axis=1)
    information = score[:, :, None] * score[:, None, :] - second / p[:, None, None]
    return PassedBeamLikelihood(np.log(p), score, information)
