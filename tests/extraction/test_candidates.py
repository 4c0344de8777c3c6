"""Poles in bad places are candidates, other bright things are neither sure nor doubtful."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import IntArray, PointCloud
from retropole.base.sensors import Sensor, find_sensor
from retropole.extraction.candidates import with_candidates, with_dimmer_candidates
from retropole.extraction.line_search import MAX_POLES
from retropole.extraction.poles import extract_poles
from retropole.simulation import Rectangle, Surface
from tests.extraction.scenes import (
    NO_POLES,
    PAINT,
    TAPE,
    Y,
    Z,
    across,
    labels_of,
    pole,
    seen,
    without_rings,
)
from tests.tiers import first_of

WALL = Rectangle(np.array([5.2, 0, 0]), Y, Z, (4, 2), PAINT)
SHORT_AT_A_WALL: list[Surface] = [pole((5, 0), length=0.7), WALL]


def looked_at(
    cloud: PointCloud, labels: IntArray, sensor: Sensor | None = None
) -> tuple[list[int], list[int]]:
    """Surfaces of the sure and of the candidate poles."""
    found = with_candidates(cloud, extract_poles(cloud, sensor=sensor), 0.02)
    return labels_of(found, labels), labels_of(replace(found, poles=found.candidates), labels)


@pytest.mark.parametrize("sensor", ["XT32", "HDL-32E"])
def test_a_short_pole_near_a_wall_is_doubtful(sensor: str) -> None:
    sure, doubtful = looked_at(*seen(SHORT_AT_A_WALL, sensor))
    assert sure == []
    assert doubtful == [0]


@pytest.mark.parametrize("aside", [0.4, 0.6])
def test_a_pole_next_to_a_bright_plate_is_found(aside: float) -> None:
    plate = Rectangle(np.array([4, 0.2 + aside, -0.2]), Y, Z, (0.2, 0.9), TAPE)
    sure, doubtful = looked_at(*seen([pole((4, 0)), plate], "XT32"))
    assert [*sure, *doubtful] == [0]


@pytest.mark.parametrize("count", [3, 4, 5])
def test_three_to_five_returns_on_neighbouring_rings_are_doubtful(count: int) -> None:
    cloud, labels = seen([pole((6, 0))], "VLP-16", seed=3)
    assert cloud.ring is not None
    on_it = np.flatnonzero(labels == 0)
    rings = np.unique(cloud.ring[on_it])
    for kept_rings, is_kept in ((rings[:3], True), (rings[[0, 2, 4]], False)):
        first = [on_it[cloud.ring[on_it] == ring][0] for ring in kept_rings]
        more = [on_it[cloud.ring[on_it] == ring][1] for ring in kept_rings][: count - 3]
        kept = np.sort(np.array([*np.flatnonzero(labels != 0), *first, *more]))
        sure, doubtful = looked_at(cloud.select(kept), labels[kept], find_sensor("VLP-16"))
        assert sure == []
        assert doubtful == ([0] if is_kept else [])


@pytest.mark.parametrize(("rings", "is_kept"), [(3, True), (2, False)])
def test_three_rings_of_a_near_pole_are_doubtful(rings: int, is_kept: bool) -> None:
    cloud, labels = seen([pole((3, 0))], "VLP-16", seed=3)
    assert cloud.ring is not None
    on_it = labels == 0
    middle = np.sort(np.unique(cloud.ring[on_it]))[2 : 2 + rings]
    kept = np.flatnonzero(~on_it | np.isin(cloud.ring, middle))
    sure, doubtful = looked_at(cloud.select(kept), labels[kept], find_sensor("VLP-16"))
    assert sure == []
    assert doubtful == ([0] if is_kept else [])


@pytest.mark.parametrize(("aside", "is_kept"), [(0.3, True), (0.07, False)])
def test_a_few_returns_with_air_close_about_them_are_doubtful(aside: float, is_kept: bool) -> None:
    plate = Rectangle(np.array([6, 0.1 + aside, 0.0]), Y, Z, (0.1, 0.8), TAPE)
    cloud, labels = seen([pole((6, 0)), plate], "VLP-16", seed=3)
    assert cloud.ring is not None
    on_it = np.flatnonzero(labels == 0)
    rings = np.unique(cloud.ring[on_it])[2:6]
    few = [on_it[cloud.ring[on_it] == ring][0] for ring in rings]
    kept = np.sort(np.array([*np.flatnonzero(labels != 0), *few]))
    sure, doubtful = looked_at(cloud.select(kept), labels[kept], find_sensor("VLP-16"))
    assert sure == []
    assert (0 in doubtful) == is_kept


def test_a_pole_close_to_a_large_bright_plate_is_doubtful() -> None:
    plate = Rectangle(np.array([3, 0.5, -0.3]), Y, Z, (0.3, 0.6), TAPE)
    cloud, labels = seen([pole((3, 0), length=1.6), plate], "Pandar64")
    assert np.count_nonzero(labels == 1) > 1000
    sure, doubtful = looked_at(cloud, labels, find_sensor("Pandar64"))
    assert [*sure, *doubtful] == [0]


@pytest.mark.parametrize("sensor", first_of(["VLP-16", "XT32", "OS1", "Pandar64"]))
@pytest.mark.parametrize(
    "name",
    ["vest", "sign seen obliquely", "stripe on a wall", "number plate", "bright ground", "cone"],
)
def test_other_bright_things_are_not_doubtful_poles(name: str, sensor: str) -> None:
    assert looked_at(*seen(NO_POLES[name], sensor)) == ([], [])


def test_sure_poles_stay_and_doubtful_ones_are_not_among_them() -> None:
    cloud, labels = seen([*SHORT_AT_A_WALL, pole((3.4, -1.6), 0.25 * Y)], "XT32")
    before = extract_poles(cloud)
    after = with_candidates(cloud, before, 0.02)
    assert after.poles is before.poles
    assert labels_of(after, labels) == [2]
    assert len(after.candidates) <= MAX_POLES
    index = np.concatenate([p.index for p in (*after.poles, *after.candidates)])
    assert len(np.unique(index)) == len(index)


@pytest.mark.parametrize("sensor", first_of(["XT32", "Pandar64"]))
@pytest.mark.parametrize(("gap", "turn"), first_of([(0.06, 0.0), (0.07, 0.5)]))
def test_a_wall_close_behind_a_pole_is_not_next_to_it(gap: float, turn: float, sensor: str) -> None:
    wall = Rectangle(np.array([4 + gap, 0, 0]), across(np.pi / 2 - turn), Z, (3, 2), PAINT)
    cloud, labels = seen([pole((4, 0)), wall], sensor)
    assert looked_at(cloud, labels, find_sensor(sensor)) == ([], [0])
    # The points alone show the rings; where not even they do, nothing is needed of them.
    bare = without_rings(cloud)
    assert looked_at(bare, labels, find_sensor(sensor)) == ([], [0])
    noise = np.random.default_rng(0).normal(0.0, 0.002, cloud.xyz.shape)
    blurred = replace(bare, xyz=bare.xyz + noise)
    assert looked_at(blurred, labels, find_sensor(sensor)) == ([], [0])


@pytest.mark.parametrize("sensor", ["XT32", "Pandar64"])
@pytest.mark.parametrize("turn", [0.0, 0.5, 0.8, 1.0, 1.2])
def test_the_wall_of_a_stripe_speaks_against_it_however_it_is_turned(
    turn: float, sensor: str
) -> None:
    along, toward = across(np.pi / 2 - turn), across(-turn)
    wall = Rectangle(np.array([4.0, 0, 0]), along, Z, (3, 2), PAINT)
    stripe = Rectangle(wall.centre - 0.01 * toward, along, Z, (0.025, 0.9), TAPE)
    alone = extract_poles(seen([stripe], sensor)[0]).poles[0].log_odds
    cloud, _ = seen([stripe, wall], sensor)
    found = with_candidates(cloud, extract_poles(cloud), 0.02, find_sensor(sensor))
    assert not found.poles
    assert all(each.log_odds < alone - 4.0 for each in found.candidates)


def test_a_far_pole_may_scatter_by_more() -> None:
    """Beams that point beside where they should spread its returns across the line of sight."""
    cloud, labels = seen([pole((14, 0), length=3.0)], "Pandar64")
    shift = 2e-3 * 14.0 * np.random.default_rng(1).normal(size=len(cloud))
    shift[labels != 0] = 0.0
    moved = replace(cloud, xyz=cloud.xyz + shift[:, None] * Y)
    assert looked_at(cloud, labels) == ([0], [])
    assert looked_at(moved, labels) == ([], [0])


@pytest.mark.parametrize("radius", [0.02, 0.055])
def test_a_thick_tube_is_a_pole_of_its_own_radius(radius: float) -> None:
    """Of 11 cm and 3 m, which is a post where poles are 4 cm thick."""
    cloud, labels = seen([pole((6, 0), radius=0.055, length=3.0)], "Pandar64")
    found = extract_poles(cloud, radius=radius)
    assert labels_of(found, labels) == ([0] if radius > 0.02 else [])


VLP = find_sensor("VLP-16")


@pytest.mark.parametrize(("count", "is_found"), [(3, True), (5, True), (2, False)])
def test_few_dim_returns_are_doubtful(count: int, is_found: bool) -> None:
    cloud, labels = seen([pole((6, 0)), pole((3.4, -1.6), 0.25 * Y)], "VLP-16", seed=3)
    assert cloud.ring is not None
    assert cloud.intensity is not None
    on_it = np.flatnonzero(labels == 0)
    rings = np.unique(cloud.ring[on_it])[:count]
    few = [on_it[cloud.ring[on_it] == ring][0] for ring in rings]
    dim = cloud.intensity.copy()
    dim[few] = 0.8 * VLP.threshold
    kept = np.sort(np.array([*np.flatnonzero(labels != 0), *few]))
    cloud, labels = replace(cloud, intensity=dim).select(kept), labels[kept]
    before = extract_poles(cloud, sensor=VLP)
    after = with_dimmer_candidates(cloud, before, 0.02, VLP)
    assert labels_of(before, labels) == labels_of(after, labels) == [1]
    assert labels_of(replace(after, poles=after.candidates), labels) == ([0] if is_found else [])
    given = extract_poles(cloud, sensor=VLP, threshold=VLP.threshold)
    assert not with_dimmer_candidates(cloud, given, 0.02, VLP).candidates
