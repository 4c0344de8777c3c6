"""Loops: which there are, and that the steps around one are what its pairs compose to."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from retropole.adjustment.closures import _edges, _loops, close_loops
from retropole.adjustment.solved import labels_of_places
from retropole.base import se3
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full

ALL_OF_FOUR = list(combinations(range(4), 2))


def test_triangles_and_the_shortest_loops_of_what_is_in_none() -> None:
    assert set(_loops(range(4), ALL_OF_FOUR)) == set(combinations(range(4), 3))
    ring = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)]
    (loop,) = _loops(range(5), ring)
    assert set(loop) == set(range(5))
    around = {frozenset(pair) for pair in zip(loop, (*loop[1:], loop[0]), strict=True)}
    assert around == {frozenset(pair) for pair in ring}
    assert not _loops(range(4), [(0, 1), (1, 2), (1, 3)])
    # A triangle and a square that share an edge.
    found = _loops(range(5), [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (1, 4)])
    assert {frozenset(loop) for loop in found} == {
        frozenset({0, 1, 2}),
        frozenset({1, 2, 3, 4}),
    }


def test_a_loop_misses_by_what_its_pairs_compose_to(steps: Steps) -> None:
    at, end = steps.adjusted.solved, steps.adjusted.end
    edges = {edge.lidars: edge for edge in _edges(at, end)}
    assert set(edges) == {(0, 1), (0, 2), (1, 2)}

    def alone(i: int, j: int) -> np.ndarray:
        """The pose of j for i, by that pair alone."""
        edge = edges[min(i, j), max(i, j)]
        a, b = edge.lidars
        T = se3.inverse(end.T[a]) @ se3.retract(end.T[b], edge.step)
        return T if i < j else se3.inverse(T)

    (loop,) = close_loops(at, end)
    assert loop.lidars == (0, 1, 2)
    around = end.T[0] @ alone(0, 1) @ alone(1, 2) @ alone(2, 0) @ se3.inverse(end.T[0])
    centre = np.mean([end.T[i][:3, 3] for i in loop.lidars], axis=0)
    shift = se3.apply(around, centre[None])[0] - centre
    turned = se3.rotation_angle(around[:3, :3])
    np.testing.assert_allclose(loop.rotation, turned, rtol=0.02)
    np.testing.assert_allclose(loop.translation, np.linalg.norm(shift), rtol=0.02)


def test_pairs_alone_differ_from_the_joint_answer_within_what_they_state(steps: Steps) -> None:
    at, end = steps.adjusted.solved, steps.adjusted.end
    for edge in _edges(at, end):
        assert np.linalg.norm(edge.step[:3]) < np.radians(0.1)
        assert np.linalg.norm(edge.step[3:]) < 0.02
    for loop in close_loops(at, end):
        assert 1e-3 < loop.probability <= 1.0
        assert loop.freedom == 6


def test_residuals_that_places_have_in_common_open_no_loop(steps: Steps) -> None:
    """All of a place are off together, more than their patches' noise."""
    at, end = steps.adjusted.solved, steps.adjusted.end
    rng = np.random.default_rng(5)
    places = labels_of_places(end)
    count = 1 + max(int(own.max()) for own in places)
    found = []
    for _ in range(40):
        off = 0.01 * rng.normal(size=count)
        scene = tuple(
            replace(term, weighed=replace(term.weighed, pairs=pairs))
            for term, own in zip(end.scene, places, strict=True)
            for pairs in [replace(term.pairs, residuals=off[own])]
        )
        now = replace(end, scene=scene)
        found += [loop.chi2 for loop in close_loops(at, now)]
    # Six degrees of freedom, of which the poles' returns hold some: their step is what it was.
    assert 2.0 < np.mean(found) < 7.0
