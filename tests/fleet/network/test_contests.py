"""Where as many votes stand against each other, nothing tells which are wrong, and names do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, IntArray
from retropole.fleet.network.graph import ControlPoints, Edges, Graph, KnownPoses
from retropole.fleet.network.network import NetworkAdjustment, adjust_network
from tests.fleet.network.networks import in_sigma, network_of
from tests.tiers import first_of

pytestmark = pytest.mark.full

SIGMA = 1e-3
AWAY = np.array([2.0, 0.0, 0.0])


def poses(count: int, rng: np.random.Generator) -> Array:
    return np.array([se3.random(rng) for _ in range(count)])


def shifted(graph: Graph, some: list[int]) -> Graph:
    measured = graph.edges.T_i_j.copy()
    measured[some, :3, 3] += AWAY
    return replace(graph, edges=replace(graph.edges, T_i_j=measured))


def parallel(n: int, rng: np.random.Generator) -> Graph:
    """n edges say one thing of two nodes, and n another; a triangle hangs by the second."""
    ends = np.array([[0, 1]] * (2 * n) + [[1, 2], [2, 3], [1, 3]])
    return shifted(network_of(poses(4, rng), ends, rng), [*range(n, 2 * n)])


def star(n: int, rng: np.random.Generator) -> Graph:
    """A node that 2 n others see, which hold together; what n say is another place."""
    hub, count = 2 * n, 2 * n + 1
    # No cut of the rim has so few edges.
    rim = [[k, (k + apart) % hub] for k in range(hub) for apart in (1, 2, 3)]
    ends = np.array([[hub, k] for k in range(hub)] + rim)
    return shifted(network_of(poses(count, rng), ends, rng), [*range(n)])


def surveyed(n: int, rng: np.random.Generator) -> Graph:
    """Control points of one node, n at one place and n at another; a triangle hangs by it."""
    T = poses(3, rng)
    edges = network_of(T, np.array([[0, 1], [1, 2], [0, 2]]), rng).edges
    return Graph(3, edges, points=points_of(T, 1, 10.0 * rng.normal(size=(2 * n, 3)), rng, n))


def spread(n: int, rng: np.random.Generator) -> Graph:
    """The same where each of 2 n nodes that hold together has one point."""
    T, count = poses(2 * n, rng), 2 * n
    ends = np.array([[k, (k + apart) % count] for k in range(count) for apart in (1, 2, 3)])
    world = T[:, :3, 3] + SIGMA * rng.normal(size=(count, 3))
    world[n:] += AWAY
    covariance = np.tile(np.eye(3) * SIGMA**2, (count, 1, 1))
    edges = network_of(T, ends, rng).edges
    return Graph(count, edges, points=ControlPoints(np.arange(count), world, covariance))


def points_of(
    T: Array, node: int, seen: Array, rng: np.random.Generator, away: int = 0
) -> ControlPoints:
    world = se3.apply(T[node], seen) + SIGMA * rng.normal(size=seen.shape)
    world[len(seen) - away :] += AWAY
    covariance = np.tile(np.eye(3) * SIGMA**2, (len(seen), 1, 1))
    return ControlPoints(np.full(len(seen), node), world, covariance, seen)


def renamed(graph: Graph, rng: np.random.Generator) -> tuple[IntArray, IntArray, IntArray, Graph]:
    number = rng.permutation(graph.nodes)
    order, points = rng.permutation(len(graph.edges)), rng.permutation(len(graph.points))
    e, p, k = graph.edges, graph.points, graph.known
    return (
        number,
        order,
        points,
        Graph(
            graph.nodes,
            Edges(number[e.i[order]], number[e.j[order]], e.T_i_j[order], e.covariance[order]),
            KnownPoses(number[k.node], k.T_world_node, k.covariance),
            ControlPoints(
                number[p.node[points]], p.world[points], p.covariance[points], p.at[points]
            ),
        ),
    )


@pytest.mark.parametrize("scene", [parallel, star, surveyed, spread])
@pytest.mark.parametrize("n", first_of(range(2, 11), 3))
def test_equal_votes_are_rivals_under_any_names(scene: object, n: int) -> None:
    assert callable(scene)
    rng = np.random.default_rng(n)
    graph: Graph = scene(n, rng)
    kind = "control point" if scene in (surveyed, spread) else "edge"
    found = adjust_network(graph)
    out = {one.index for one in found.left_out}
    assert {one.kind for one in found.left_out} == {kind}
    assert out in ({*range(n)}, {*range(n, 2 * n)})
    for one in found.left_out:
        assert {k for _, k in one.rivals} == {*range(2 * n)} - out
        assert "in its stead" in one.reason
    assert found.doubtful.any()
    number, order, points, other = renamed(graph, rng)
    again = adjust_network(other)
    old = order if kind == "edge" else points
    assert {int(old[one.index]) for one in again.left_out} == out
    assert (again.doubtful[number] == found.doubtful).all()
    covariance = found.covariance + 1e-16 * np.eye(6)
    # A rotation that two points leave open is that of the first node, whichever that is.
    if not any(len(component.held) for component in found.components):
        assert in_sigma(found.T_world_node, again.T_world_node[number], covariance) < 0.01


@pytest.mark.parametrize("scene", [parallel, surveyed])
def test_one_vote_more_decides(scene: object) -> None:
    assert callable(scene)
    graph: Graph = scene(4, np.random.default_rng(5))
    if scene is parallel:
        edges = graph.edges
        kept = np.arange(1, len(edges))
        graph = replace(graph, edges=Edges(*(values[kept] for values in vars(edges).values())))
    else:
        p = graph.points
        graph = replace(
            graph, points=ControlPoints(p.node[1:], p.world[1:], p.covariance[1:], p.at[1:])
        )
    found = adjust_network(graph)
    assert {one.index for one in found.left_out} == {0, 1, 2}
    assert not any(one.rivals for one in found.left_out)
    assert not found.doubtful.any()


def mirrored(seed: int) -> tuple[Array, NetworkAdjustment]:
    rng = np.random.default_rng(seed)
    T = poses(2, rng)
    seen = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [8, 9, 0]])
    points = points_of(T, 1, seen, rng)
    # The last one lies on the other side of the line through the first two.
    points.world[3] = se3.apply(T[1], np.array([[8.0, -9, 0]]))[0]
    edges = network_of(T, np.array([[0, 1]]), rng).edges
    return T, adjust_network(Graph(2, edges, points=points))


@pytest.mark.parametrize("seed", range(5))
def test_a_mirrored_point_is_as_likely_as_the_one_that_tells_the_side(seed: int) -> None:
    # Turned by half about the line, three of four points fit as well.
    _, found = mirrored(seed)
    (out,) = found.left_out
    assert {out.index, *(k for _, k in out.rivals)} == {2, 3}
    assert found.doubtful.all()
