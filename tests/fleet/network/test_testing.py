import numpy as np
import pytest
from scipy.special import chdtri
from scipy.stats import ncx2

from retropole.base import se3
from retropole.fleet.network.adjustment import adjust, find_layout
from retropole.fleet.network.graph import Graph, find_components
from retropole.fleet.network.testing import (
    POWER,
    SIGNIFICANT,
    ObservationTests,
    all_tests,
    critical,
    noncentrality,
    normalised,
)
from tests.fleet.network.networks import city, ladder, spoiled

pytestmark = pytest.mark.full


def outcome(
    graph: Graph, T: np.ndarray, out: tuple[int, ...] = ()
) -> tuple[ObservationTests, float]:
    """Tests of a network without some observations, and its sum of squares."""
    active = np.ones(len(graph.observed), dtype=bool)
    active[list(out)] = False
    layout, components = find_layout(graph), find_components(graph, active)
    found = adjust(graph, layout, T, active, components)
    tests = all_tests(graph, layout, found, active)
    return tests, float(graph.observed.squares(found.T)[active].sum())


def test_chi2_is_by_how_much_the_squares_fall_without_the_observation() -> None:
    drawn, graph = city(10, 30)
    T = drawn.T_world_node
    tests, whole = outcome(graph, T)
    last = len(graph.observed) - 1
    for k in (0, 7, 20, last):
        without, rest = outcome(graph, T, (k,))
        np.testing.assert_allclose(tests.chi2[k], whole - rest, rtol=1e-2, atol=1e-3)
        # It says the same of what is out as it said when that was in.
        np.testing.assert_allclose(without.chi2[k], tests.chi2[k], rtol=1e-2, atol=1e-3)
        np.testing.assert_allclose(without.redundancy[k], tests.redundancy[k], rtol=1e-2)


def test_redundancies_add_up_to_the_degrees_of_freedom() -> None:
    drawn, graph = city(11, 40)
    tests, _ = outcome(graph, drawn.T_world_node)
    numbers = 6 * len(graph.edges) + 3 * len(graph.points)
    total = np.sum(tests.redundancy * graph.observed.freedom)
    np.testing.assert_allclose(total, numbers - 6 * graph.nodes, rtol=1e-9)


def test_what_nothing_checks_is_no_test() -> None:
    T, graph = ladder(4, np.random.default_rng(0))
    # Without a rail and the brace of the last field it hangs by the other rail.
    tests, _ = outcome(graph, T, (5, len(graph.edges) - 1))
    alone = np.flatnonzero(tests.freedom == 0)
    # What is known of the first pose is checked by nothing either.
    assert alone.tolist() == [4, 9, len(graph.edges)]
    assert not tests.chi2[alone].any()
    assert not tests.w[alone].any()
    assert np.isinf(tests.detectable_translation[alone]).all()


def test_an_error_of_the_least_detectable_size_raises_chi2_as_told() -> None:
    T, graph = ladder(6, np.random.default_rng(1), sigma=1e-4)
    edges = graph.edges
    edges.T_i_j[:] = np.linalg.inv(T[edges.i]) @ T[edges.j]
    tests, _ = outcome(graph, T)
    for size, axes in (
        (tests.detectable_rotation[4], slice(0, 3)),
        (tests.detectable_translation[4], slice(3, 6)),
    ):
        found = []
        for way in np.random.default_rng(0).normal(size=(4, 3)):
            step = np.zeros(6)
            step[axes] = size * way / np.linalg.norm(way)
            found.append(outcome(spoiled(graph, 4, step), T)[0].chi2[4])
        # In no direction less than in the one in which it shows least.
        assert min(found) > 0.98 * noncentrality(6)


def test_chance_is_as_rare_as_told() -> None:
    assert np.isclose(chdtri(6, SIGNIFICANT), critical(np.array([6]))[0])
    assert np.isinf(critical(np.array([0]))[0])
    for freedom in (3, 6):
        limit, mean = chdtri(freedom, SIGNIFICANT), noncentrality(freedom)
        assert np.isclose(ncx2.sf(limit, freedom, mean), POWER, atol=1e-6)


def test_w_is_a_normal_number_of_the_same_probability() -> None:
    np.testing.assert_allclose(normalised(np.array([4.0]), np.array([1])), [2.0])
    w = normalised(np.array([1e2, 1e3, 1e6]), np.array([6, 6, 6]))
    assert (np.diff(w) > 0).all()


def test_the_pose_that_holds_a_datum_has_no_covariance() -> None:
    T, graph = ladder(4, np.random.default_rng(2))
    active = np.ones(len(graph.observed), dtype=bool)
    active[-1] = False
    components = find_components(graph, active)
    found = adjust(graph, find_layout(graph), T, active, components)
    assert not found.covariance.diagonal[0].any()
    np.testing.assert_allclose(se3.local(T[0], found.T[0]), 0, atol=1e-12)
