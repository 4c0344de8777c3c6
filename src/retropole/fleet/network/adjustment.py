"""A network adjusted by GTSAM: a robust start, least squares, marginals, and a test of each edge.

What an observation misses, and how much of an error of it shows there, follow from the covariance
of its ends alone (Baarda 1968): with A its whitened derivative and Q that covariance, an error
∇ shows as ``(I − A Q Aᵀ) ∇``. How much the sum of squares falls without the observation is its χ².
That with the largest χ² around goes, and all is adjusted and tested anew, until nothing changes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order
from scipy.special import chdtrc, chdtri, chndtrinc, erfcinv

from ...api import Array, BoolArray, IntArray, se3
from ...base.errors import MissingExtraError, RetropoleError
from .graph import Component, Graph, connected, find_components, labels, twice, worst_around

SIGNIFICANCE = 1e-5
"""Probability of a sound observation's χ² to be beyond what is taken for chance: a hundredth of the
largest share of sound edges that may be lost, one in a thousand. w is then 4.4."""

POWER = 0.8
"""With which probability the least detectable error is found (Baarda 1968)."""

LEAST_CHECKED = 1e-5
"""Part of an error that must show in the residuals to be tested: far above the rounding errors of
unchecked observations, far below the least error that any test could find."""

PLAIN = 10.0
"""How far beyond chance an observation must miss at first to be out before any test, as a multiple
of the χ² that chance allows: the tests of nearer ones show better which of two is wrong."""

KERNEL = 15.0
"""From about this many σ on an edge has less weight in the robust start (Cauchy). With 5, 5 more of
16,658 sound edges were lost (benchmarks/fleet_network.py, 1000 nodes, seeds 0 to 7)."""

FAINT = 1e-6
"""Weight of residuals that are left out: GTSAM then still has the covariance of their ends."""

DATUM_SIGMA = 1e-6
"""1 σ of the constraint of the datum, rad and m."""

MOST_ROUNDS = 30
"""Largest number of further adjustments of the network."""


@dataclass(frozen=True, eq=False)
class NetworkAdjustment:
    """A network adjusted; M observations are its edges, then its control points.

    Attributes
    ----------
    T_world_node
        (N, 4, 4) poses: map points of each node into the frame of the network.
    covariance
        (N, 6, 6) over ``[φ, δ]``, rad and m, axes of the network; zero where the datum fixes it.
    cross
        (E, 6, 6) covariance between the first and the second pose of each edge.
    used
        (M,) which observations fit and were adjusted.
    chi2, freedom, w
        (M,) by how much the sum of squares falls without the observation, or would rise with it;
        how many numbers of it the others check; and that as a standard normal number.
    redundancy
        (M,) part of its errors that shows in its residuals, 0 to 1.
    detectable
        (M, 2) least rotation, rad, and translation, m, in the direction in which it shows least,
        that the test finds with `POWER`; infinite where no observation checks one.
    rivals
        For some that are left out, used ones nearby that may be wrong in their stead.
    components
        Nodes that are connected, and what ties them to the ground.
    doubtful
        (N,) poses that are tied to their datum by rivals: they may be wrong.
    unit_variance
        Sum of squares for each degree of freedom: 1 if the covariances given are right.
    rounds
        How often all was adjusted.
    converged
        Whether steps and rounds ended by themselves.
    """

    T_world_node: Array
    covariance: Array
    cross: Array
    used: BoolArray
    chi2: Array
    freedom: IntArray
    w: Array
    redundancy: Array
    detectable: Array
    rivals: dict[int, list[int]]
    components: tuple[Component, ...]
    doubtful: BoolArray
    unit_variance: float
    rounds: int
    converged: bool


def engine() -> ModuleType:
    """Import GTSAM.

    Raises
    ------
    MissingExtraError
        Without the extra ``network``.
    """
    try:
        import gtsam
    except ImportError:
        raise MissingExtraError("network", "a network of a fleet") from None
    module: ModuleType = gtsam
    return module


def adjust_network(
    graph: Graph, progress: Callable[[str], None] = lambda _: None
) -> NetworkAdjustment:
    """Adjust all poses of a network together, without what does not fit.

    Parameters
    ----------
    graph
        Relative poses, and what ties them to the ground. No pose need be known before.
    progress
        Receives each step as it begins.

    Raises
    ------
    MissingExtraError
        Without the extra ``network``.
    UsageError
        Of a covariance that is not positive.
    RetropoleError
        If GTSAM cannot solve it.
    """
    try:
        return _adjusted(graph, progress)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise RetropoleError(f"GTSAM cannot solve the network: {reason}") from None


def _adjusted(graph: Graph, progress: Callable[[str], None]) -> NetworkAdjustment:
    progress("start")
    values, everything = find_start(graph), np.ones(len(graph.ends), dtype=bool)
    residual = _whitened(as_factors(graph).linearize(values), everything)[1]
    squares = np.sum(residual**2, axis=1)
    active = connected(graph, squares <= PLAIN * _critical(graph.numbers), squares)
    returned = ~everything
    progress("tests")
    for rounds in range(1, MOST_ROUNDS + 1):
        factors = as_factors(graph, active)
        values, converged = _solved(graph, factors, values)
        tests = all_tests(graph, values, active)
        beyond = tests.chi2 > _critical(tests.freedom)
        fits = ~active & ~beyond & ~returned
        wanted = (active & ~worst_around(graph, tests.chi2, active & beyond)) | fits
        wanted = connected(graph, wanted, tests.chi2)
        if (stable := bool((wanted == active).all())) or rounds == MOST_ROUNDS:
            break
        returned |= wanted & ~active
        active = wanted
    progress("end")
    T = np.array([values.atPose3(k).matrix() for k in range(graph.nodes)])
    turn, (i, j) = twice(T[:, :3, :3]), (graph.edges.i, graph.edges.j)
    part = np.trace(tests.shows, axis1=1, axis2=2)
    rivals, components = _rivals(graph, tests, active), find_components(graph, active)
    stiff = active.copy()
    stiff[[r for some in rivals.values() for r in some]] = False
    label, doubtful = labels(graph, stiff), np.zeros(graph.nodes, dtype=bool)
    for each in components:
        datum = graph.nodes if len(each.points) else each.nodes[0]
        doubtful[each.nodes] = label[each.nodes] != label[datum]
    return NetworkAdjustment(
        T,
        turn @ tests.own @ np.swapaxes(turn, 1, 2),
        turn[i] @ tests.cross @ np.swapaxes(turn[j], 1, 2),
        active,
        tests.chi2,
        tests.freedom,
        _normalised(tests.chi2, tests.freedom),
        np.clip(part / graph.numbers, 0.0, 1.0),
        _detectable(graph, tests),
        rivals,
        components,
        doubtful,
        float(np.sum(tests.residual[active] ** 2) / max(part[active].sum(), 1e-9)),
        rounds,
        converged and stable,
    )


def as_factors(graph: Graph, active: BoolArray | None = None, robust: bool = False) -> Any:
    """Observations as a graph of GTSAM, those that are active (M,); then what fixes each datum."""
    gtsam, (edges, points) = engine(), (graph.edges, graph.points)
    model, kernels = gtsam.noiseModel, gtsam.noiseModel.mEstimator
    # Far from control a network bends by more than its controls are uncertain at first: none of
    # them is forgotten.
    cauchy, huber = kernels.Cauchy.Create(KERNEL), kernels.Huber.Create(1.0)
    active = np.ones(len(graph.ends), dtype=bool) if active is None else active
    factors, roots = gtsam.NonlinearFactorGraph(), graph.roots.copy()
    roots[~active] *= FAINT

    def noise(root: Array, kernel: Any) -> Any:
        gaussian = model.Gaussian.SqrtInformation(root)
        return model.Robust.Create(kernel, gaussian) if robust else gaussian

    for (i, j), T, root in zip(graph.ends.tolist(), edges.T_i_j, roots, strict=False):
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T), noise(root, cauchy)))
    sights = zip(points.node.tolist(), points.world, points.at, roots[len(edges) :], strict=True)
    for node, world, at, root in sights:
        factors.add(gtsam.GPSFactorArm(node, world, at, noise(root[:3, :3], huber)))
    for each in find_components(graph, active):
        constrained = np.eye(6) * (len(each.points) == 0)
        constrained[:3, :3] = each.held.T @ each.held
        if len(each.held):
            holding = model.Gaussian.SqrtInformation(constrained / DATUM_SIGMA)
            factors.add(gtsam.PriorFactorPose3(int(each.nodes[0]), gtsam.Pose3(), holding))
    return factors


def _ordering(graph: Graph, factors: Any) -> Any:
    """Order fixed variables last: eliminated earlier, it would drown all other information in
    rounding."""
    everything = np.ones(len(graph.ends), dtype=bool)
    last = [int(each.nodes[0]) for each in find_components(graph, everything)]
    gtsam = engine()
    return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(factors, last, False)


def _solved(
    graph: Graph, factors: Any, values: Any, steps: int = 50, until: float = 1e-7
) -> tuple[Any, bool]:
    """Levenberg and Marquardt until half the sum of squares falls by less than that."""
    gtsam = engine()
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(steps)
    options.setRelativeErrorTol(0.0)
    options.setAbsoluteErrorTol(until)
    options.setOrdering(_ordering(graph, factors))
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, options)
    return optimizer.optimize(), optimizer.iterations() < steps


def values_of(T: Array) -> Any:
    """Poses (N, 4, 4) as values of GTSAM."""
    gtsam = engine()
    values = gtsam.Values()
    for k, each in enumerate(T):
        values.insert(k, gtsam.Pose3(each))
    return values


def find_start(graph: Graph) -> Any:
    """Find poses to start from without any guess, as values of GTSAM, in spite of wrong edges.

    Chordal relaxation for the rotations (Martinec and Pajdla 2007), then robust least squares of
    the rotations, of the translations with these, and of all together.
    """
    gtsam, edges, points = engine(), graph.edges, graph.points
    model, ends = gtsam.noiseModel, graph.ends[: len(edges)].tolist()
    components = find_components(graph, np.ones(len(graph.ends), dtype=bool))
    poses, turns, moves = as_factors(graph), *(gtsam.NonlinearFactorGraph() for _ in range(2))
    places = gtsam.Values()
    for k in (int(each.nodes[0]) for each in components):
        poses.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(), model.Isotropic.Sigma(6, 1e-3)))
        turns.add(gtsam.PriorFactorRot3(k, gtsam.Rot3(), model.Isotropic.Sigma(3, 1e-3)))
        moves.add(gtsam.PriorFactorPoint3(k, np.zeros(3), model.Isotropic.Sigma(3, 1e-3)))
    for k in range(graph.nodes):
        places.insert(k, np.zeros(3))

    def within_rounding(variance: Array) -> Any:
        # Two outvote one, however precise that claims to be.
        sigma = float(np.sqrt(np.median(variance))) if len(variance) else 1.0
        fair = model.mEstimator.Fair.Create(1.0)
        return model.Robust.Create(fair, model.Isotropic.Sigma(3, sigma))

    own = np.diagonal(edges.covariance, axis1=1, axis2=2)
    turned, moved = own[:, :3].mean(axis=1), own[:, 3:].mean(axis=1)
    noise = within_rounding(turned)
    for (i, j), T in zip(ends, edges.T_i_j, strict=True):
        turns.add(gtsam.BetweenFactorRot3(i, j, gtsam.Rot3(T[:3, :3]), noise))
    rotations = gtsam.InitializePose3.initializeOrientations(poses)
    rotations, _ = _solved(graph, turns, rotations, 20, 1.0)
    R = np.array([rotations.atRot3(k).matrix() for k in range(graph.nodes)])
    arm = np.einsum("kab,kb->ka", R[edges.i], edges.T_i_j[:, :3, 3])
    # A direction that is off by its σ moves the far end by that much more.
    noise = within_rounding(moved + turned * np.sum(arm**2, axis=1))
    for (i, j), way in zip(ends, arm, strict=True):
        moves.add(gtsam.BetweenFactorPoint3(i, j, way, noise))
    options = gtsam.GaussNewtonParams()
    options.setMaxIterations(10)
    options.setOrdering(_ordering(graph, moves))
    places = gtsam.GaussNewtonOptimizer(moves, places, options).optimize()
    T = se3.from_rt(R, np.array([places.atPoint3(k) for k in range(graph.nodes)]))
    seen = np.einsum("kab,kb->ka", R[points.node], points.at) + T[points.node, :3, 3]
    for each in components:
        if len(each.points):
            T[each.nodes] = _laid(seen[each.points], points.world[each.points]) @ T[each.nodes]
    return _solved(graph, as_factors(graph, robust=True), values_of(T), 20, 1.0)[0]


def _laid(source: Array, target: Array) -> Array:
    """Rigid transform (4, 4) with the least sum of distances: what lies far off counts little."""
    weight = np.ones(len(source))
    for _ in range(20):
        a, b = (np.average(xyz, axis=0, weights=weight) for xyz in (source, target))
        U, _, Vt = np.linalg.svd((target - b).T @ ((source - a) * weight[:, None]))
        U[:, 2] *= np.linalg.det(U @ Vt)
        T = se3.from_rt(U @ Vt, b - U @ Vt @ a)
        weight = 1 / np.maximum(np.linalg.norm(se3.apply(T, source) - target, axis=1), 1e-3)
    return T


def _whitened(linear: Any, active: BoolArray) -> tuple[Array, Array]:
    """Derivatives (M, 6, 12) by steps of both ends, and residuals (M, 6), in σ."""
    A, b = np.zeros((len(active), 6, 12)), np.zeros((len(active), 6))
    for k in range(len(active)):
        derivative, right = linear.at(k).jacobian()
        A[k, : len(right), : derivative.shape[1]], b[k, : len(right)] = derivative, right
    A[~active] /= FAINT
    b[~active] /= FAINT
    return A, b


def _marginals(graph: Graph, linear: Any, ordering: Any) -> tuple[Array, Array]:
    """Covariance of each pose (N, 6, 6) and across each edge (E, 6, 6), in axes of the poses.

    Down the tree of elimination, from the covariance of what each pose is conditioned on (selected
    inversion, Takahashi, Fagan and Chin 1973): GTSAM alone would solve again for each edge.
    """
    net = linear.eliminateSequential(ordering)
    place, below, across = (
        np.empty(graph.nodes, dtype=np.int64),
        defaultdict(list),
        defaultdict(list),
    )
    for k in range(graph.nodes):
        place[net.at(k).keys()[0]] = k
    for k in range(graph.nodes):
        given = net.at(k).keys()[1:]
        below[min(place[given], default=-1)].append(k)
    for k, (i, j) in enumerate(graph.ends[: len(graph.edges)].tolist()):
        across[min(place[i], place[j])].append((k, i, j))
    own, cross = np.zeros((graph.nodes, 6, 6)), np.zeros((len(graph.edges), 6, 6))
    left = [(k, np.zeros((0, 6, 0, 6)), list[int]()) for k in below[-1]]
    while left:
        k, above, known = left.pop()
        conditional = net.at(k)
        keys = conditional.keys()
        some, count = [known.index(each) for each in keys[1:]], 6 * len(keys)
        P = np.empty((count, count))
        P[6:, 6:] = above[some][:, :, some].reshape(count - 6, count - 6)
        root = np.linalg.inv(conditional.R())
        K = root @ conditional.S() if count > 6 else np.zeros((6, 0))
        P[:6, 6:] = -K @ P[6:, 6:]
        P[6:, :6] = P[:6, 6:].T
        P[:6, :6] = root @ root.T - P[:6, 6:] @ K.T
        blocks = P.reshape(len(keys), 6, len(keys), 6)
        own[keys[0]] = blocks[0, :, 0]
        for edge, i, j in across[k]:
            cross[edge] = blocks[keys.index(i), :, keys.index(j)]
        left += [(each, blocks, keys) for each in below[k]]
    return own, cross


class Tests(NamedTuple):
    """Tests of all observations (M,) at some poses, in the axes of these.

    Attributes
    ----------
    own, cross
        Covariance of each pose (N, 6, 6), and across each edge (E, 6, 6).
    residual
        (M, 6) in σ.
    shows
        (M, 6, 6) what part of an error shows in the residual.
    chi2, freedom
        (M,) as of `NetworkAdjustment`.
    """

    own: Array
    cross: Array
    residual: Array
    shows: Array
    chi2: Array
    freedom: IntArray


def all_tests(graph: Graph, values: Any, active: BoolArray) -> Tests:
    """Test all observations at poses, values of GTSAM, against those that are active (M,)."""
    factors, edges = as_factors(graph, active), len(graph.edges)
    linear = factors.linearize(values)
    A, b = _whitened(linear, active)
    own, cross = _marginals(graph, linear, _ordering(graph, factors))
    joint = np.zeros((len(A), 12, 12))
    joint[:, :6, :6] = own[graph.ends[:, 0]]
    joint[:edges, 6:, 6:] = own[graph.edges.j]
    joint[:edges, :6, 6:], joint[:edges, 6:, :6] = cross, np.swapaxes(cross, 1, 2)
    taken_up = A @ joint @ np.swapaxes(A, 1, 2)
    shows = np.eye(6) - taken_up
    # One that is left out would move the poses by this much.
    shows[~active] = np.linalg.inv(np.eye(6) + taken_up[~active])
    measured = np.arange(6) < graph.numbers[:, None]
    shows *= measured[:, :, None] & measured[:, None, :]
    part, way = np.linalg.eigh((shows + np.swapaxes(shows, 1, 2)) / 2)
    is_reported = part > LEAST_CHECKED
    part = np.where(is_reported, part, 0.0)
    along = np.einsum("kab,ka->kb", way, b) ** 2 * is_reported
    chi2 = np.where(active[:, None], along / np.where(is_reported, part, 1.0), along * part).sum(
        axis=1
    )
    shows = (way * part[:, None]) @ np.swapaxes(way, 1, 2)
    return Tests(own, cross, b, shows, chi2, np.count_nonzero(is_reported, axis=1))


def _rivals(graph: Graph, tests: Tests, active: BoolArray) -> dict[int, list[int]]:
    """For what is left out the active ones, without another check, that close a loop with it."""
    lone = active & (tests.freedom == 0)
    label = labels(graph, active & ~lone)
    bridges, (i, j) = np.flatnonzero(lone), label[graph.ends].T
    size = int(label.max()) + 1
    # Its entries are numbers of observations, from 1 on.
    forest = csr_array((bridges + 1, (i[bridges], j[bridges])), shape=(size, size))
    forest = forest + forest.T
    found = {}
    for k in np.flatnonzero(~active & (i != j)).tolist():
        before, at, path = breadth_first_order(forest, i[k])[1], int(j[k]), list[int]()
        while before[at] >= 0:
            path.append(int(forest[at, before[at]]) - 1)
            at = int(before[at])
        if at == i[k]:
            found[k] = path[::-1]
    return found


def _detectable(graph: Graph, tests: Tests) -> Array:
    least = np.array([noncentrality(k) for k in range(7)])[tests.freedom]
    found, roots = np.full((len(least), 2), np.inf), graph.roots
    shown, whole = (np.swapaxes(roots, 1, 2) @ each @ roots for each in (tests.shows, np.eye(6)))
    for k, some in enumerate((slice(0, 3), slice(3, 6))):
        seen, most = (np.linalg.eigvalsh(each[:, some, some])[:, 0] for each in (shown, whole))
        checked = seen > LEAST_CHECKED * most
        found[checked, k] = np.sqrt(least[checked] / seen[checked])
    # The three numbers of a point are a translation.
    found[len(graph.edges) :] = found[len(graph.edges) :, ::-1]
    return found


def _normalised(chi2: Array, freedom: IntArray) -> Array:
    """Give each χ² as a standard normal number of the same probability; 0 without freedom."""
    p = np.where(freedom > 0, chdtrc(np.maximum(freedom, 1), chi2), 1.0)
    # Where the probability is too small for a number, the χ² is the best measure.
    return np.where(p > 1e-300, np.sqrt(2) * erfcinv(np.maximum(p, 1e-300)), np.sqrt(chi2))


def _critical(freedom: IntArray) -> Array:
    return np.where(freedom > 0, chdtri(np.maximum(freedom, 1), SIGNIFICANCE), np.inf)


def noncentrality(freedom: int, power: float = POWER) -> float:
    """Mean by which an error must raise χ² to be found with some probability."""
    if not freedom:
        return np.inf
    return float(chndtrinc(chdtri(freedom, SIGNIFICANCE), freedom, 1 - power))
