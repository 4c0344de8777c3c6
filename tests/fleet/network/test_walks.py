"""LiDARs before which one pole is carried, two by two: their loops close, and a network has all."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.carried.walk import calibrate_tracks
from retropole.fleet.network.adjustment import adjust_network
from retropole.fleet.network.graph import Edges, Graph
from tests.carried.walks import RADIUS, seen_by_all

pytestmark = pytest.mark.full

CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""


def test_three_lidars_before_one_pole_are_one_network() -> None:
    tracks, truth = seen_by_all()
    i, j = np.array([[0, 1], [0, 2], [1, 2]]).T
    pairs = [
        calibrate_tracks((tracks[a], tracks[b]), (None, None), RADIUS)
        for a, b in zip(i, j, strict=True)
    ]
    first, second, third = pairs
    # Loops close in poses and in clocks.
    around = first.T_target_source @ third.T_target_source @ se3.inverse(second.T_target_source)
    step = se3.local(around, np.eye(4))
    stated = sum(np.trace(each.covariance[:3, :3]) for each in pairs)
    assert np.linalg.norm(step[:3]) < 2.5 * np.sqrt(stated)
    clocks = first.offset + third.offset - second.offset
    assert abs(clocks) < 4 * np.sqrt(sum(each.offset_sigma**2 for each in pairs))
    edges = Edges(
        i,
        j,
        np.array([each.T_target_source for each in pairs]),
        np.array([each.covariance for each in pairs]),
    )
    found = adjust_network(Graph(3, edges))
    assert found.used.all()
    assert found.chi2.max() < 16.8
    for k in (1, 2):
        T = se3.inverse(found.T_world_node[0]) @ found.T_world_node[k]
        off = se3.local(T, se3.inverse(truth[0]) @ truth[k])
        assert off @ np.linalg.solve(pairs[k - 1].covariance, off) < CHI2
