"""Networks adjusted."""

import builtins
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import chdtri

from benchmarks.city import City
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import MissingExtraError
from tests.fleet.network.networks import city, in_sigma, ladder, network_of, spoiled

gtsam = pytest.importorskip("gtsam", reason="needs the extra network")

from retropole.fleet.network.adjustment import (  # noqa: E402
    NetworkAdjustment,
    adjust_network,
    all_tests,
    find_start,
    noncentrality,
    values_of,
)
from retropole.fleet.network.graph import ControlPoints, Edges, Graph  # noqa: E402

pytestmark = pytest.mark.full


def left_out(found: NetworkAdjustment) -> list[int]:
    return np.flatnonzero(~found.used).tolist()


def rotated(covariance: Array, R: Array) -> Array:
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = R
    return np.asarray(turned @ covariance @ turned.T)


@pytest.fixture(scope="module")
def drawn() -> tuple[City, Graph]:
    return city(20, 200, wrong=0.015, controls=10)


def test_gross_errors_are_named_and_poses_are_as_certain_as_stated(
    drawn: tuple[City, Graph],
) -> None:
    truth, graph = drawn
    found = adjust_network(graph)
    assert found.converged
    named = {*left_out(found), *(k for some in found.rivals.values() for k in some)}
    sigma = np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
    large = np.flatnonzero((np.abs(truth.error) > 30 * sigma).any(axis=1))
    assert len(large)
    assert set(large.tolist()) <= named
    # A sound one that is lost has a wrong one beside it.
    near = np.asarray(np.isin(graph.ends, graph.ends[np.flatnonzero(truth.wrong)]).any(axis=1))
    assert set(left_out(found)) <= set(np.flatnonzero(near).tolist())
    assert (~truth.wrong & ~found.used[: len(truth.wrong)]).sum() <= 2
    step = se3.local(found.T_world_node, truth.T_world_node)
    some = ~found.doubtful
    apart = np.einsum("ka,kab,kb->k", step, np.linalg.inv(found.covariance), step)[some]
    assert (apart < chdtri(6, 0.05)).mean() > 0.8
    assert 0.8 < found.unit_variance < 1.2


def test_covariances_are_those_of_the_scatter() -> None:
    T, graph = ladder(3, np.random.default_rng(0))
    exact = np.linalg.inv(T[graph.edges.i]) @ T[graph.edges.j]
    rng, steps = np.random.default_rng(1), []
    survey = se3.apply(T[0], graph.points.at)
    for _ in range(100):
        noise = 1e-3 * rng.normal(size=(len(exact), 6))
        edges = replace(graph.edges, T_i_j=se3.retract(exact, noise))
        points = replace(graph.points, world=survey + 1e-4 * rng.normal(size=survey.shape))
        found = adjust_network(replace(graph, edges=edges, points=points))
        steps.append(se3.local(T, found.T_world_node))
    root = np.linalg.cholesky(np.linalg.inv(found.covariance))
    normal = np.einsum("kba,nkb->nka", root, np.array(steps))
    np.testing.assert_allclose((normal**2).mean(axis=0), 1, atol=0.7)
    np.testing.assert_allclose((normal**2).mean(), 1, atol=0.12)


def test_moving_the_frame_moves_the_poses_and_nothing_else(drawn: tuple[City, Graph]) -> None:
    _, graph = drawn
    T = se3.random(np.random.default_rng(1), 500.0)
    points = graph.points
    turned = T[:3, :3] @ points.covariance @ T[:3, :3].T
    moved = ControlPoints(points.node, se3.apply(T, points.world), turned)
    one, two = adjust_network(graph), adjust_network(replace(graph, points=moved))
    assert in_sigma(T @ one.T_world_node, two.T_world_node, two.covariance) < 1e-3
    expected = np.array([rotated(C, T[:3, :3]) for C in one.covariance])
    np.testing.assert_allclose(two.covariance, expected, atol=1e-5 * expected.max())
    assert left_out(one) == left_out(two)


def test_the_numbers_of_nodes_and_edges_do_not_matter(drawn: tuple[City, Graph]) -> None:
    _, graph = drawn
    rng = np.random.default_rng(2)
    number, order = rng.permutation(graph.nodes), rng.permutation(len(graph.edges))
    e, p = graph.edges, graph.points
    edges = Edges(number[e.i[order]], number[e.j[order]], e.T_i_j[order], e.covariance[order])
    other = Graph(graph.nodes, edges, ControlPoints(number[p.node], p.world, p.covariance))
    one, two = adjust_network(graph), adjust_network(other)
    assert in_sigma(one.T_world_node, two.T_world_node[number], one.covariance) < 1e-3
    np.testing.assert_allclose(two.covariance[number], one.covariance, rtol=1e-3, atol=1e-10)
    assert left_out(one) == sorted(int(order[k]) for k in left_out(two))
    np.testing.assert_allclose(two.w[: len(order)], one.w[order], atol=1e-2)


def test_an_edge_says_the_same_the_other_way_round() -> None:
    # Noise so small that its second order, turned through some 10 m, is none of it.
    _, graph = ladder(6, np.random.default_rng(7), sigma=1e-4)
    graph = spoiled(graph, 4, np.array([0, 0.02, 0, 0.1, 0, 0]))
    e = graph.edges
    T_i_j, covariance = e.T_i_j.copy(), e.covariance.copy()
    turned = np.arange(len(e)) % 2 == 0
    for k in np.flatnonzero(turned):
        T_i_j[k] = se3.inverse(e.T_i_j[k])
        # R_true = Exp(φ) R and t_true = t + δ, inverted to first order.
        to_j = e.T_i_j[k, :3, :3].T
        J = np.zeros((6, 6))
        J[:3, :3], J[3:, 3:] = -to_j, -to_j
        J[3:, :3] = -to_j @ se3.hat(e.T_i_j[k, :3, 3])
        covariance[k] = J @ e.covariance[k] @ J.T
    i, j = np.where(turned, e.j, e.i), np.where(turned, e.i, e.j)
    one = adjust_network(graph)
    two = adjust_network(replace(graph, edges=Edges(i, j, T_i_j, covariance)))
    assert left_out(one) == left_out(two) == [4]
    assert in_sigma(one.T_world_node, two.T_world_node, one.covariance) < 0.01
    sigma = np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2))
    apart = np.abs(two.covariance - one.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    assert apart.max() < 0.01


def test_parts_have_a_datum_of_their_own() -> None:
    rng = np.random.default_rng(3)
    T = np.array([se3.random(rng) for _ in range(7)])
    found = adjust_network(network_of(T, np.array([[0, 1], [1, 2], [0, 2], [4, 5], [6, 5]]), rng))
    assert [each.nodes.tolist() for each in found.components] == [[0, 1, 2], [3], [4, 5, 6]]
    assert [each.datum(range(7)) for each in found.components] == [
        "4 controls",
        "no control points: pose 3 is fixed",
        "no control points: pose 4 is fixed",
    ]
    np.testing.assert_allclose(found.covariance[[3, 4]], 0, atol=1e-11)
    np.testing.assert_allclose(found.T_world_node[[3, 4]], np.tile(np.eye(4), (2, 1, 1)), atol=1e-9)
    assert found.converged


@pytest.mark.parametrize("count", [1, 2])
def test_few_points_hold_what_they_can(count: int) -> None:
    T, graph = ladder(3, np.random.default_rng(8))
    some = np.arange(count)
    world = T[some, :3, 3]
    points = ControlPoints(some, world, np.tile(np.eye(3) * 1e-8, (count, 1, 1)))
    found = adjust_network(replace(graph, points=points))
    assert found.converged
    np.testing.assert_allclose(found.T_world_node[some, :3, 3], world, atol=2e-3)
    between = np.linalg.inv(found.T_world_node[0]) @ found.T_world_node[3]
    np.testing.assert_allclose(between, np.linalg.inv(T[0]) @ T[3], atol=0.05)
    # A turn about the axis that stays open is held, and no other.
    assert (np.linalg.eigvalsh(found.covariance[0, :3, :3]) < 1e-10).sum() == (
        3 if count == 1 else 1
    )


def test_in_a_single_loop_the_wrong_edge_has_rivals_and_what_hangs_by_them_is_doubtful() -> None:
    rng = np.random.default_rng(4)
    T = np.array([se3.random(rng) for _ in range(4)])
    ends = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    found = adjust_network(spoiled(network_of(T, ends, rng), 2, np.array([0, 0, 1.0, 0, 0, 0])))
    (out,) = left_out(found)
    assert {out, *found.rivals[out]} == {0, 1, 2, 3}
    assert found.doubtful.tolist() == [False, True, True, True]


def test_a_wrong_edge_is_left_out_and_nothing_else() -> None:
    _, graph = ladder(10, np.random.default_rng(3))
    assert adjust_network(graph).used.all()
    for size in (0.02, 0.5):
        found = adjust_network(spoiled(graph, 8, size * np.array([0, 1.0, 0, 0, 0, 1.0])))
        assert left_out(found) == [8]
        assert not found.rivals


def test_wrong_edges_far_apart_go_together() -> None:
    _, graph = ladder(30, np.random.default_rng(4))
    for edge in (6, 30, 52):
        graph = spoiled(graph, edge, np.array([0, 0.012, 0, 0, 0, 0.01]))
    found = adjust_network(graph)
    assert left_out(found) == [6, 30, 52]
    assert found.rounds <= 3


def test_wrong_edges_that_contradict_each_other_outvote_no_other() -> None:
    rng = np.random.default_rng(6)
    T, graph = ladder(8, rng)
    # One more node, by three edges, of which one has nothing to do with its pose.
    T = np.concatenate([T, se3.random(rng)[None]])
    ends = np.stack([graph.edges.i, graph.edges.j], axis=1)
    graph = network_of(T, np.concatenate([ends, [[6, 16], [8, 16], [10, 16]]]), rng)
    last = len(graph.edges) - 1
    assert left_out(adjust_network(spoiled(graph, last, rng.normal(size=6)))) == [last]


def test_a_wrong_survey_is_left_out_and_carries_nothing_away() -> None:
    for step in ([0.0, 0.5, 0.0], [300.0, -200.0, 50.0]):
        truth, graph = city(13, 60, controls=10)
        graph.points.world[4] += step
        found = adjust_network(graph)
        assert left_out(found) == [len(graph.edges) + 4]
        steps = se3.local(found.T_world_node, truth.T_world_node)
        assert np.linalg.norm(steps[:, 3:], axis=1).max() < 0.5


def test_poses_are_found_without_any_guess_in_spite_of_wrong_edges() -> None:
    truth, graph = city(5, 120, wrong=0.03, controls=10)
    values = find_start(graph)
    T = np.array([values.atPose3(k).matrix() for k in range(graph.nodes)])
    steps = se3.local(T, truth.T_world_node)
    assert np.median(np.linalg.norm(steps[:, :3], axis=1)) < np.radians(1)
    assert np.median(np.linalg.norm(steps[:, 3:], axis=1)) < 1.0


def outcome(graph: Graph, T: Array, out: tuple[int, ...] = ()) -> tuple[Any, float]:
    """Tests of a network without some observations, and its sum of squares."""
    from retropole.fleet.network.adjustment import _solved, as_factors

    active = np.ones(len(graph.ends), dtype=bool)
    active[list(out)] = False
    values, _ = _solved(graph, as_factors(graph, active), values_of(T), until=1e-10)
    tests = all_tests(graph, values, active)
    return tests, float(np.sum(tests.residual[active] ** 2))


def test_chi2_is_by_how_much_the_squares_fall_without_the_observation() -> None:
    drawn, graph = city(10, 30)
    tests, whole = outcome(graph, drawn.T_world_node)
    for k in (0, 7, 20, len(graph.ends) - 1):
        without, rest = outcome(graph, drawn.T_world_node, (k,))
        np.testing.assert_allclose(tests.chi2[k], whole - rest, rtol=1e-2, atol=1e-2)
        # It says the same of what is out as it said when that was in.
        np.testing.assert_allclose(without.chi2[k], tests.chi2[k], rtol=1e-2, atol=1e-2)
        np.testing.assert_allclose(without.shows[k], tests.shows[k], atol=1e-2)


def test_redundancies_add_up_to_the_degrees_of_freedom() -> None:
    _, graph = city(11, 40)
    found = adjust_network(graph)
    total = np.sum(found.redundancy * graph.numbers)
    np.testing.assert_allclose(total, graph.numbers.sum() - 6 * graph.nodes, rtol=1e-5)


def test_what_nothing_checks_is_no_test() -> None:
    rng = np.random.default_rng(0)
    T = np.array([se3.random(rng) for _ in range(4)])
    found = adjust_network(network_of(T, np.array([[0, 1], [1, 2], [0, 2], [2, 3]]), rng))
    assert found.freedom[:4].tolist() == [6, 6, 6, 0]
    assert (found.chi2[3], found.w[3], found.redundancy[3]) == (0, 0, 0)
    assert np.isinf(found.detectable[3]).all()


def test_an_error_of_the_least_detectable_size_raises_chi2_as_stated() -> None:
    T, graph = ladder(6, np.random.default_rng(1), sigma=1e-4)
    edges = graph.edges
    edges.T_i_j[:] = np.linalg.inv(T[edges.i]) @ T[edges.j]
    least = adjust_network(graph).detectable[4]
    for size, axes in zip(least, (slice(0, 3), slice(3, 6)), strict=True):
        found = []
        for way in np.random.default_rng(0).normal(size=(4, 3)):
            step = np.zeros(6)
            step[axes] = size * way / np.linalg.norm(way)
            found.append(outcome(spoiled(graph, 4, step), T)[0].chi2[4])
        # In no direction less than in the one in which it shows least.
        assert min(found) > 0.98 * noncentrality(6)


def test_marginals_are_those_of_gtsam() -> None:
    from retropole.fleet.network.adjustment import as_factors

    _, graph = city(21, 60)
    found = adjust_network(graph)
    assert found.used.all()
    values, T = values_of(found.T_world_node), found.T_world_node
    theirs = gtsam.Marginals(as_factors(graph), values)
    for k in range(graph.nodes):
        expected = rotated(theirs.marginalCovariance(k), T[k, :3, :3])
        np.testing.assert_allclose(found.covariance[k], expected, rtol=1e-4, atol=1e-10)
    i, j = int(graph.edges.i[3]), int(graph.edges.j[3])
    keys = gtsam.KeyVector([i, j])
    expected = theirs.jointMarginalCovariance(keys).at(i, j)
    turn = np.kron(np.eye(2), T[i, :3, :3]), np.kron(np.eye(2), T[j, :3, :3])
    np.testing.assert_allclose(found.cross[3], turn[0] @ expected @ turn[1].T, atol=1e-9)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "gtsam":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"retropole\[network\]"):
        adjust_network(city(0, 20)[1])
