import numpy as np
import pytest

from retropole.base import se3
from retropole.fleet.network.adjustment import find_layout
from retropole.fleet.network.start import find_start, narrowed
from retropole.fleet.network.testing import critical
from tests.fleet.network.networks import city

pytestmark = pytest.mark.full


def test_poses_are_found_without_any_guess_in_spite_of_wrong_edges() -> None:
    drawn, graph = city(5, 120, wrong=0.03, controls=10)
    layout = find_layout(graph)
    T = find_start(graph, layout)
    apart = [se3.difference(a, b) for a, b in zip(T, drawn.T_world_node, strict=True)]
    assert np.median([one.rotation for one in apart]) < np.radians(1)
    assert np.median([one.translation for one in apart]) < 1.0
    T = narrowed(graph, layout, T, critical(graph.observed.freedom))
    squares = graph.observed.squares(T)[: len(graph.edges)]
    assert (squares[~drawn.wrong] < critical(np.array([6]))).mean() > 0.97


def test_a_wrong_survey_does_not_carry_the_network_away() -> None:
    drawn, graph = city(6, 60, controls=8)
    graph.points.world[2] += [300.0, -200.0, 50.0]
    layout = find_layout(graph)
    T = narrowed(graph, layout, find_start(graph, layout), critical(graph.observed.freedom))
    apart = [se3.difference(a, b).translation for a, b in zip(T, drawn.T_world_node, strict=True)]
    assert max(apart) < 0.5
