"""Planes of a box, strips that are none, and searches that are given up."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from studies.planes import extraction
from studies.planes.extraction import (
    MAX_PLANES,
    MIN_EXTENT,
    extract_planes,
    fit_plane,
    triples,
)
from tests.studies.planes.staged import ROOM, box, transformed, walls

pytestmark = pytest.mark.full


def strips(rng: np.random.Generator, count: int) -> PointCloud:
    """Scan skew strips, each half as wide as a plane must be: no two share a plane."""
    parts = []
    for k in range(count):
        along, across = rng.uniform(-5, 5, 2000), rng.uniform(-0.25, 0.25, 2000) * MIN_EXTENT
        c, s = np.cos(0.7 * k), np.sin(0.7 * k)
        parts.append(
            np.stack([c * along - s * across, s * along + c * across, 0 * along + 3 * k], 1)
        )
    return PointCloud(np.concatenate(parts))


def test_planes_of_a_box_are_found_and_face_the_sensor() -> None:
    rng = np.random.default_rng(4)
    cloud = box(rng, ROOM, "xyz").transformed(se3.random(rng))
    search = extract_planes(cloud, rng)
    assert search.complete
    distances = sorted(float(p.normal @ cloud.origin + p.offset) for p in search.planes)
    assert distances == pytest.approx([1.5, 1.5, 2.5, 2.5, 4.0, 4.0], abs=0.05)
    for plane in search.planes:
        assert abs(fit_plane(plane.xyz).normal @ plane.normal) > np.cos(1e-3)
        assert plane.support == len(plane.xyz)
    supports = [plane.support for plane in search.planes]
    assert supports == sorted(supports, reverse=True)


def test_a_fit_is_the_plane_of_its_points() -> None:
    for plane in walls():
        fitted = fit_plane(plane.xyz)
        assert abs(fitted.normal @ plane.normal) == pytest.approx(1.0)
        assert fitted.distances(plane.xyz).max() < 1e-9


def test_no_cloud_and_no_plane() -> None:
    rng = np.random.default_rng(0)
    for xyz in (np.zeros((0, 3)), np.zeros((500, 3)), rng.uniform(-50, 50, (500, 3))):
        assert extract_planes(PointCloud(xyz), rng).planes == ()
    line = np.stack([np.linspace(0, 50, 2000), np.zeros(2000), np.zeros(2000)], axis=1)
    assert extract_planes(PointCloud(line), rng).planes == ()


def test_strips_are_no_planes_and_a_search_that_only_finds_strips_reports_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(1)
    cloud = strips(rng, 4)
    complete = extract_planes(cloud, rng)
    assert complete.planes == ()
    assert complete.complete
    monkeypatch.setattr(extraction, "MAX_ROUNDS", 2)
    given_up = extract_planes(cloud, rng)
    assert given_up.planes == ()
    assert not given_up.complete


def test_a_search_that_ends_with_all_planes_it_may_find_is_complete() -> None:
    rng = np.random.default_rng(2)
    rooms = [
        box(rng, ROOM, "xyz").transformed(se3.from_rt(np.eye(3), np.array([30.0 * k, 9.0 * k, k])))
        for k in range(3)
    ]
    search = extract_planes(PointCloud(np.concatenate([room.xyz for room in rooms])), rng)
    assert len(search.planes) == MAX_PLANES
    assert search.complete


def test_a_sample_of_a_plane_lies_on_it() -> None:
    for plane in walls():
        sample = plane.sampled(30)
        assert 15 < len(sample.xyz) <= 30
        assert sample.support == plane.support
        assert set(map(tuple, sample.xyz)) <= set(map(tuple, plane.xyz))


def test_two_planes_or_parallel_ones_make_no_triple() -> None:
    four = walls()
    assert len(triples(four)) == 4
    assert len(triples(four[:2])) == 0
    parallel = transformed(four[:1], se3.from_rt(np.eye(3), np.ones(3)))
    assert len(triples([*four[:2], *parallel])) == 0
