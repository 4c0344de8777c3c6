"""Clouds of nothing but points show their rings and their origin, or nothing is made up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.io.beams import Cones
from retropole.io.scan_lines import chains, levels, with_rings_shown
from tests.io.test_beams import recorded

T = se3.random(np.random.default_rng(1), 20.0)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return recorded("VLP-16")


def only_points(cloud: PointCloud) -> PointCloud:
    return PointCloud(se3.apply(T, cloud.xyz), cloud.intensity)


def test_points_alone_show_rings_and_origin_in_any_order(cloud: PointCloud) -> None:
    order = np.random.default_rng(0).permutation(len(cloud))
    found = with_rings_shown(only_points(cloud).select(order))
    np.testing.assert_allclose(found.origin, T[:3, 3], atol=1e-6)
    assert abs(found.axis @ T[:3, 2]) > 1 - 1e-9
    assert found.ring is not None
    assert cloud.ring is not None
    both = np.unique(np.stack([found.ring, cloud.ring[order]]), axis=1).shape[1]
    assert both == len(np.unique(cloud.ring)) == len(np.unique(found.ring))


def test_an_origin_that_is_right_is_kept(cloud: PointCloud) -> None:
    found = with_rings_shown(replace(cloud, ring=None))
    np.testing.assert_array_equal(found.origin, cloud.origin)
    assert found.ring is not None
    assert with_rings_shown(cloud) is cloud


def test_points_that_lie_on_no_cones_show_nothing(cloud: PointCloud) -> None:
    rng = np.random.default_rng(0)
    bare = only_points(cloud)
    blurred = replace(bare, xyz=bare.xyz + rng.normal(0.0, 0.02, bare.xyz.shape))
    few = bare.select(np.arange(10))
    for each in (blurred, few):
        assert with_rings_shown(each) is each


def test_a_chain_is_of_one_ring_where_rings_are_far_apart(cloud: PointCloud) -> None:
    chain = chains(cloud.xyz)
    assert cloud.ring is not None
    assert np.mean(chain >= 0) > 0.5
    pieces = [cloud.ring[chain == each] for each in np.unique(chain[chain >= 0])]
    assert np.mean([len(np.unique(each)) == 1 for each in pieces]) > 0.9


def test_no_levels_are_seen_from_far_away_or_from_a_wrong_apex(cloud: PointCloud) -> None:
    axis = np.array([0.0, 0.0, 1.0])
    seen = levels(cloud.xyz, Cones(np.zeros(3), axis, 0.0))
    assert seen is not None
    for apex in ([0.3, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1e4]):
        assert levels(cloud.xyz, Cones(np.array(apex), axis, 0.0)) is None
