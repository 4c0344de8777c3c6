import numpy as np
import pytest

from benchmarks.city import City
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.fleet.network.graph import ControlPoints, Edges, Graph, KnownPoses
from retropole.fleet.network.network import adjust_network
from tests.fleet.network.networks import city, in_sigma, ladder, network_of, spoiled

pytestmark = pytest.mark.full

CHI2_6_95 = 12.59


def rotated(covariance: Array, R: Array) -> Array:
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = R
    return np.asarray(turned @ covariance @ turned.T)


@pytest.fixture(scope="module")
def drawn() -> tuple[City, Graph]:
    return city(20, 200, wrong=0.015, controls=10)


def test_gross_errors_are_named_and_poses_are_as_certain_as_told(
    drawn: tuple[City, Graph],
) -> None:
    truth, graph = drawn
    found = adjust_network(graph)
    assert found.settled
    out = {one.index for one in found.left_out if one.kind == "edge"}
    told = out | {k for one in found.left_out for kind, k in one.rivals if kind == "edge"}
    sigma = np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
    large = np.flatnonzero((np.abs(truth.error) > 30 * sigma).any(axis=1))
    assert len(large)
    assert set(large.tolist()) <= told
    assert out <= set(np.flatnonzero(truth.wrong).tolist()) | told
    step = np.array(
        [se3.local(a, b) for a, b in zip(found.T_world_node, truth.T_world_node, strict=True)]
    )
    some = ~found.doubtful
    apart = np.einsum("ka,kab,kb->k", step, np.linalg.inv(found.covariance), step)[some]
    assert (apart < CHI2_6_95).mean() > 0.8
    assert 0.8 < found.unit_variance < 1.2


def test_moving_the_frame_moves_the_poses_and_nothing_else(drawn: tuple[City, Graph]) -> None:
    _, graph = drawn
    T = se3.random(np.random.default_rng(1), 500.0)
    points = graph.points
    turned = T[:3, :3] @ points.covariance @ T[:3, :3].T
    other = Graph(
        graph.nodes,
        graph.edges,
        points=ControlPoints(points.node, se3.apply(T, points.world), turned),
    )
    one, two = adjust_network(graph), adjust_network(other)
    assert in_sigma(T @ one.T_world_node, two.T_world_node, two.covariance) < 1e-3
    expected = np.array([rotated(C, T[:3, :3]) for C in one.covariance])
    np.testing.assert_allclose(two.covariance, expected, atol=1e-6 * expected.max())
    assert [o.index for o in one.left_out] == [o.index for o in two.left_out]


def test_the_numbers_of_nodes_and_edges_do_not_matter(drawn: tuple[City, Graph]) -> None:
    _, graph = drawn
    rng = np.random.default_rng(2)
    number, order = rng.permutation(graph.nodes), rng.permutation(len(graph.edges))
    e, p = graph.edges, graph.points
    edges = Edges(number[e.i[order]], number[e.j[order]], e.T_i_j[order], e.covariance[order])
    other = Graph(graph.nodes, edges, points=ControlPoints(number[p.node], p.world, p.covariance))
    one, two = adjust_network(graph), adjust_network(other)
    assert in_sigma(one.T_world_node, two.T_world_node[number], one.covariance) < 1e-3
    np.testing.assert_allclose(two.covariance[number], one.covariance, rtol=1e-3, atol=1e-10)
    assert {o.index for o in one.left_out} == {int(order[o.index]) for o in two.left_out}
    np.testing.assert_allclose(two.edges.w, one.edges.w[order], atol=1e-2)


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
    other = Graph(graph.nodes, Edges(i, j, T_i_j, covariance), graph.known)
    one, two = adjust_network(graph), adjust_network(other)
    assert [o.index for o in one.left_out] == [o.index for o in two.left_out] == [4]
    assert in_sigma(one.T_world_node, two.T_world_node, one.covariance) < 0.01
    sigma = np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2))
    apart = np.abs(two.covariance - one.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    assert apart.max() < 0.01


def test_parts_are_told_with_their_datum() -> None:
    rng = np.random.default_rng(3)
    T = np.array([se3.random(rng) for _ in range(7)])
    found = adjust_network(network_of(T, np.array([[0, 1], [1, 2], [0, 2], [4, 5], [6, 5]]), rng))
    assert [component.nodes.tolist() for component in found.components] == [
        [0, 1, 2],
        [3],
        [4, 5, 6],
    ]
    assert [component.datum for component in found.components] == [
        "1 controls",
        "no control: pose 3 is held",
        "no control: pose 4 is held",
    ]
    assert not found.covariance[[3, 4]].any()
    np.testing.assert_allclose(found.T_world_node[3], np.eye(4), atol=1e-12)
    assert found.settled


def test_in_a_single_loop_the_wrong_edge_has_rivals_and_what_hangs_by_them_is_doubtful() -> None:
    rng = np.random.default_rng(4)
    T = np.array([se3.random(rng) for _ in range(4)])
    ends = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    found = adjust_network(spoiled(network_of(T, ends, rng), 2, np.array([0, 0, 1.0, 0, 0, 0])))
    (out,) = found.left_out
    assert {out.index} | {k for _, k in out.rivals} == {0, 1, 2, 3}
    assert "in its stead" in out.reason
    assert found.doubtful.tolist() == [False, True, True, True]


def test_the_joint_covariance_of_an_edge_is_that_of_its_ends() -> None:
    _, graph = ladder(4, np.random.default_rng(5))
    found = adjust_network(graph)
    joint = found.joint(graph, 3)
    assert joint.shape == (12, 12)
    assert np.linalg.eigvalsh(joint)[0] > 0
    np.testing.assert_array_equal(joint[6:, 6:], found.covariance[graph.edges.j[3]])


def test_a_network_without_edges_stays_where_it_is_known() -> None:
    T = se3.random(np.random.default_rng(6))[None]
    none = np.zeros(0, dtype=np.int64)
    edges = Edges(none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    covariance = np.eye(6)[None] * 1e-4
    found = adjust_network(Graph(1, edges, KnownPoses(np.array([0]), T, covariance)))
    np.testing.assert_allclose(found.T_world_node, T, atol=1e-12)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-18)


@pytest.mark.parametrize(
    "nodes", [60, pytest.param(2500, marks=pytest.mark.full)], ids=["small", "2500"]
)
def test_gtsam_finds_the_same(nodes: int) -> None:
    gtsam_network = pytest.importorskip(
        "tests.fleet.network.gtsam_network", reason="gtsam is not installed", exc_type=ImportError
    )
    truth, graph = city(21, nodes, controls=max(nodes // 100, 5))
    found = adjust_network(graph)
    assert not found.left_out
    other = gtsam_network.adjust(graph, truth.T_world_node, np.arange(graph.nodes))
    # What edges miss is some 0.1°: its second order is a hundredth of a σ at most.
    assert in_sigma(found.T_world_node, other.T, found.covariance) < 0.02
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    apart = np.abs(found.covariance - other.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    assert apart.max() < 0.005
