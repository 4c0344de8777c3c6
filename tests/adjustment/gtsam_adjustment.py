"""The adjustment of a site once more, by GTSAM: its own optimiser, from somewhere else.

The observations are those of `site.network` and `site.refinement` at their end; nothing of how
they are put together and solved there is used here.

- Returns on poles are quadratic forms about the state that they were expanded at, in steps
  ``R = Exp(φ) R₀``, ``t = t₀ + δ``; GTSAM moves poses by steps of its own.
- Surfaces: the residual of a pair of patches is ``r + J P ρ + E b``, with ρ(T_i⁻¹ T_j) how far
  the relative pose is from where patches were paired, composed by GTSAM, b the errors of both
  LiDARs, and J = [x × n, n] rebuilt from where the patch lies. P is the projection onto the steps
  that the surfaces hold: with it the rows are no longer the slope of the distance of a point from
  a surface, so that the residual is taken as linear in ρ; r and E are freed of the other steps as
  well. The weights are those of the last step.
- Survey: each residual written anew, and derived by differences. They are expanded where the
  returns are, as `network` does; `as_they_are` leaves them functions of pose, axis and point.
- Errors have their prior. A pose that the datum holds has a constraint; of one that it holds in
  part the variable is what is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, L, R

from retropole.adjustment.descent import End, SceneTerm
from retropole.adjustment.site import Adjusted
from retropole.base.datatypes import Array
from tests.adjustment.gtsam_survey import of_survey
from tests.adjustment.gtsam_variables import (
    POSE,
    Variable,
    away,
    freedom_of,
    linear,
    moved,
    of_unknowns,
    relative_step,
    variables_of,
    vector_of,
)

NOTHING = 1e-11
"""Eigenvalues of a correlation matrix below this are rounding."""

MIN_HOLD, RIDGE = 6.0, 1e-9
"""As `surfaces.patch_pairs.constrained_directions` has them."""

START_ROTATION, START_TRANSLATION, START_ERROR = 0.01, 0.05, 1.0
"""1 σ of the start about the answer, rad and m, and of errors in their own σ."""

STEPS = 12
"""Of Gauss and Newton; the last ones are rounding."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What GTSAM finds.

    Attributes
    ----------
    T
        (L, 4, 4) the poses.
    errors, axes, points
        (B,), (4 K,) and (3 Q,): the rest of the unknowns, in the order of `site.unknowns`.
    covariance
        (6 L, 6 L) of the poses, over ``[φ, δ]`` each; zero where the datum holds one.
    of_errors
        (B,) their variance.
    last
        The last step of the optimiser, in σ of the poses.
    """

    T: Array
    errors: Array
    axes: Array
    points: Array
    covariance: Array
    of_errors: Array
    last: float


def adjust_with_gtsam(
    adjusted: Adjusted, rng: np.random.Generator, *, as_they_are: bool = False
) -> Adjustment:
    """Adjust what a site was adjusted by, from a start that is drawn about its answer.

    Parameters
    ----------
    adjusted
        The observations, and the answer.
    rng
        For the start.
    as_they_are
        Whether survey is not expanded about the poles' state.
    """
    end, variables = adjusted.end, variables_of(adjusted)
    graph = gtsam.NonlinearFactorGraph()
    for factor in _returns(adjusted, variables):
        graph.push_back(factor)
    for term in end.scene:
        graph.push_back(_surfaces(term, end, variables))
    for factor in of_survey(adjusted, variables, as_they_are):
        graph.push_back(factor)
    for i in np.flatnonzero(~freedom_of(adjusted).any(axis=1)):
        graph.push_back(gtsam.NonlinearEqualityPose3(L(i), gtsam.Pose3(end.T[i])))
    values = _start(adjusted, variables, rng)
    last = gtsam.VectorValues()
    for _ in range(STEPS):
        last = graph.linearize(values).optimize()
        values = values.retract(last)
    return _found(adjusted, variables, graph, values, last)


def _returns(adjusted: Adjusted, variables: Sequence[Variable]) -> list[gtsam.CustomFactor]:
    """Returns on poles, and the prior of the errors.

    A LiDAR in one placement leaves errors free, and what is left of negative curvature pulls at
    them. Each gets its share of their prior, so that it has a minimum; the sum is the same.
    """
    network, end = adjusted.network, adjusted.end
    unknowns = network.unknowns
    prior = np.zeros(unknowns.size)
    prior[unknowns.poses : unknowns.kept] = end.precision
    seen = [one for one in network.observations if one.kind == "returns"]
    shares = np.ones(unknowns.size)
    for one in seen:
        shares[one.place] += 1.0
    share = prior / shares
    factors = []
    for one in seen:
        own = share[one.place]
        information = one.information + np.diag(own)
        # About zero instead of the start.
        vector = one.gradient + one.information @ network.start[one.place]
        short, constant = _root(information, vector)
        rows = np.zeros((len(short), unknowns.size))
        rows[:, one.place] = short
        factors.append(of_unknowns(rows, constant, variables, network.state))
    for variable in variables:
        precision = share[variable.place]
        if precision.any():
            rows = np.zeros((len(precision), unknowns.size))
            rows[:, variable.place] = np.diag(np.sqrt(precision))
            factors.append(of_unknowns(rows, np.zeros(len(precision)), variables, network.state))
    return factors


def _root(information: Array, vector: Array) -> tuple[Array, Array]:
    """Rows A and constant c with ``½|A z + c|² = ½ zᵀ Λ z − ηᵀ z`` up to a constant."""
    scale = np.sqrt(np.diag(information))
    used = np.flatnonzero(scale)
    assert not vector[scale == 0].any()
    by_scale = np.outer(scale[used], scale[used])
    size, way = np.linalg.eigh(information[np.ix_(used, used)] / by_scale)
    pull = way.T @ (vector[used] / scale[used])
    kept = size > NOTHING
    # What moves poses and poles together changes no return.
    assert np.abs(pull[~kept]).max(initial=0.0) < 1e-6, "a direction is pulled at, and not held"
    A = np.zeros((int(kept.sum()), len(vector)))
    A[:, used] = (way[:, kept] * np.sqrt(size[kept])).T * scale[used]
    return A, -pull[kept] / np.sqrt(size[kept])


def _surfaces(term: SceneTerm, end: End, variables: Sequence[Variable]) -> gtsam.CustomFactor:
    """What the patches of two LiDARs say, with their weights as they are."""
    i, j = term.lidars
    pairs = term.pairs
    T_ij = gtsam.Pose3(end.about[i]).between(gtsam.Pose3(end.about[j]))
    arm = pairs.at - T_ij.translation()
    J = np.hstack([np.cross(arm, pairs.normal), pairs.normal])
    held = _held(arm, J, pairs.normal, term.weighed.weights, pairs.tilt)
    size = variables[-1].place.stop
    by_error = np.zeros((len(J), size))
    by_error[:, term.place[2 * POSE :]] = pairs.by_errors(np.eye(pairs.layout.size))
    others = [one for one in variables if by_error[:, one.place].any()]
    blocks = [J, *(by_error[:, one.place] for one in others)]
    table = np.hstack([*blocks, pairs.residuals[:, None]])
    root = np.sqrt(term.weighed.weights)[:, None]
    # What a step would explain of each column, along what the surfaces do not hold, is taken out.
    steps, *_ = np.linalg.lstsq(J * root, table * root)
    table = (table - J @ (np.eye(POSE) - held) @ steps) * root
    # Thousands of rows say what as many rows as columns do.
    table = np.asarray(np.linalg.qr(table, mode="r"))
    stops = np.cumsum([block.shape[1] for block in blocks])
    own = np.split(table, stops, axis=1)
    one, other = variables[i].pose, variables[j].pose
    assert one is not None
    assert other is not None
    keys = [variables[i].key, variables[j].key]
    parts = [(keys, relative_step(one, other, T_ij.matrix()), own[0])]
    parts += [
        ([one.key], vector_of(one.key), rows) for one, rows in zip(others, own[1:-1], strict=True)
    ]
    return linear(parts, own[-1][:, 0])


def _held(arm: Array, J: Array, normal: Array, weights: Array, tilt: Array) -> Array:
    """(6, 6) onto the steps that the surfaces hold, ``Σ f(λ) u uᵀ H_n`` with ``uᵀ H_n u = 1``.

    f(λ) = λ²/(λ² + 6²); ``λ u = H_n⁻¹ H_s u``, H_s the information of the surfaces, and H_n what
    the noise of their normals would imitate. Of singular values: they lose no digits as squares do.
    """
    noise = np.zeros((POSE, POSE))
    for across in np.eye(3):
        lever = np.hstack([np.cross(arm, across), np.broadcast_to(across, arm.shape)])
        lever = lever - (normal @ across)[:, None] * J
        noise += (lever.T * (weights * tilt)) @ lever
    scale = 1.0 / np.sqrt(np.diag(noise))
    noise = noise * np.outer(scale, scale) + RIDGE * np.eye(POSE)
    root = np.linalg.cholesky(noise) / scale[:, None]
    whitened = np.linalg.solve(root, (J * np.sqrt(weights)[:, None]).T).T
    _, singular, ways = np.linalg.svd(whitened, full_matrices=False)
    share = singular**4 / (singular**4 + MIN_HOLD**2)
    return np.asarray(np.linalg.solve(root.T, (ways.T * share) @ ways) @ root.T)


def _start(
    adjusted: Adjusted, variables: Sequence[Variable], rng: np.random.Generator
) -> gtsam.Values:
    """Poses and errors far from the answer; axes and points where the poles alone had them."""
    network, end = adjusted.network, adjusted.end
    values = gtsam.Values()
    lidars = len(end.T)
    for i, free in enumerate(freedom_of(adjusted)):
        by = rng.normal(size=POSE) * np.repeat([START_ROTATION, START_TRANSLATION], 3)
        if free.all() or not free.any():
            values.insert(L(i), moved(gtsam.Pose3(end.T[i]), np.where(free, by, 0.0)))
        else:
            values.insert(L(i), by[free])
    sigma = np.zeros(network.unknowns.size)
    sigma[network.unknowns.poses : network.unknowns.kept] = end.precision**-0.5
    for one in variables[lidars:]:
        own = sigma[one.place]
        values.insert(one.key, START_ERROR * own * rng.normal(size=len(own)))
    return values


def _found(
    adjusted: Adjusted,
    variables: Sequence[Variable],
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    last: gtsam.VectorValues,
) -> Adjustment:
    network = adjusted.network
    count, unknowns = network.unknowns.lidars, network.unknowns
    # From GTSAM's steps to those in the axes of the site.
    by_variable, poses = [], []
    for one in variables[:count]:
        assert one.pose is not None
        pose, J = one.pose(values)
        poses.append(pose.matrix())
        by_variable.append(away(pose, pose)[1] @ J)
    T = np.stack(poses)
    rest = np.concatenate([values.atVector(one.key) for one in variables[count:]])
    marginals = gtsam.Marginals(graph, values)
    free = [i for i, own in enumerate(freedom_of(adjusted)) if own.any()]
    joint = marginals.jointMarginalCovariance([L(i) for i in free])
    covariance = np.zeros((unknowns.poses, unknowns.poses))
    for i in free:
        for j in free:
            block = by_variable[i] @ joint.at(L(i), L(j)) @ by_variable[j].T
            covariance[np.ix_(unknowns.pose(i), unknowns.pose(j))] = block
    of_errors = [np.diag(marginals.marginalCovariance(E(i))) for i in range(count)]
    of_errors.append(np.diag(marginals.marginalCovariance(R(0))))
    steps = np.concatenate([by_variable[i] @ last.at(L(i)) for i in range(count)])
    sigma = np.sqrt(np.diag(covariance))
    errors, axes, points = np.split(rest, [unknowns.errors, unknowns.errors + 4 * unknowns.axes])
    moving = sigma > 0
    return Adjustment(
        T,
        errors,
        axes,
        points,
        covariance,
        np.concatenate(of_errors),
        float(np.abs(steps[moving] / sigma[moving]).max()),
    )
