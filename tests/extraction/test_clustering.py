"""Groups are what short steps connect; a surface is wide both ways."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.base import se3
from retropole.base.datatypes import Array, IntArray
from retropole.extraction.clustering import (
    LINK,
    MANY,
    PATCH_POINTS,
    PATCH_RADIUS,
    clusters,
    on_surface,
)


def sizes(groups: list[IntArray]) -> list[int]:
    return [len(group) for group in groups]


@pytest.mark.parametrize("count", [200, 5 * MANY])
def test_clusters_are_what_short_steps_connect(count: int) -> None:
    rng = np.random.default_rng(1)
    place = rng.integers(0, 3, count)
    xyz = rng.uniform(0, 1, (count, 3)) + place[:, None] * [5.0, 0, 0]
    groups = clusters(xyz, LINK)
    assert sizes(groups) == sorted(np.bincount(place), reverse=True)
    assert all(len(np.unique(place[group])) == 1 for group in groups)
    assert sorted(np.concatenate(groups)) == list(range(count))


def test_no_points_are_no_cluster() -> None:
    assert clusters(np.zeros((0, 3)), LINK) == []


@pytest.mark.parametrize(("step", "count"), [(0.99 * LINK, 1), (1.01 * LINK, 12)])
def test_a_step_just_longer_than_the_link_divides(step: float, count: int) -> None:
    chain = np.arange(12)[:, None] * [step, 0, 0]
    assert len(clusters(chain, LINK)) == count


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_motion_and_order_change_no_cluster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-4, 4, (60, 3))
    order = rng.permutation(60)
    there = se3.apply(se3.random(rng, 50.0), xyz)[order]
    assert {frozenset(group) for group in clusters(xyz, LINK)} == {
        frozenset(order[group]) for group in clusters(there, LINK)
    }


def plate(width: float, step: float = 0.03, distance: float = 5.0) -> Array:
    """Points of an upright plate 1.5 m high."""
    across, up = np.meshgrid(np.arange(0, width, step), np.arange(0, 1.5, step))
    return np.stack([np.full(across.size, distance), across.ravel(), up.ravel()], axis=1)


def test_a_plate_is_a_surface_and_a_pole_is_not() -> None:
    wide, slim = plate(1.5), plate(0.12, distance=9.0)
    inside = on_surface(np.concatenate([wide, slim]))
    from_edge = np.min([wide[:, 1], 1.5 - wide[:, 1], wide[:, 2], 1.5 - wide[:, 2]], axis=0)
    assert inside[: len(wide)][from_edge > PATCH_RADIUS].all()
    assert not inside[len(wide) :].any()


@pytest.mark.parametrize(("count", "is_surface"), [(PATCH_POINTS, True), (PATCH_POINTS - 1, False)])
def test_few_points_tell_no_surface(count: int, is_surface: bool) -> None:
    bearing = 2 * np.pi * np.arange(count) / count
    ring = 0.14 * np.stack([np.cos(bearing), np.sin(bearing), np.zeros(count)], axis=1)
    assert on_surface(ring).tolist() == [is_surface] * count
