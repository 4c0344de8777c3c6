"""Whether a LiDAR stood still between its recordings."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.swapped import check_places
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.hypotheses.scans import Views
from retropole.simulation.sites import SimulatedSite, simulate_site
from retropole.surfaces.standing import (
    PUSHED,
    SAME_PLACE,
    TURNED,
    elsewhere,
    moved,
    same_place,
    shows_same,
)
from retropole.surfaces.visibility import SCORING_SAMPLE, SCORING_VOXEL, View, view_of
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full


def view(cloud: PointCloud | None, T: Array | None = None) -> View:
    assert cloud is not None
    if T is not None:
        cloud = replace(cloud, xyz=se3.apply(T, cloud.xyz))
    return view_of(cloud, SCORING_VOXEL, SCORING_SAMPLE)


def turn(degrees: float, metres: float = 0.0, seed: int = 0) -> Array:
    way = np.random.default_rng(seed).normal(size=(2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return se3.from_rt(se3.exp_so3(np.radians(degrees) * way[0]), metres * way[1])


def test_one_place_is_told_from_another(steps: Steps) -> None:
    every = steps.views.every
    for i in range(3):
        for j in range(3):
            one, other = every[i][0], every[j][1]
            assert one is not None
            assert other is not None
            assert (same_place(one, other) >= SAME_PLACE) == (i == j)


def test_a_recording_from_elsewhere_is_outvoted_by_two(steps: Steps) -> None:
    (a, b), (c, d) = steps.views.every[:2]
    assert not elsewhere((a, b))
    assert set(elsewhere((a, b, c))) == {2}
    assert set(elsewhere((c, a, None, b))) == {0}
    # Which of two it is, nothing tells.
    assert set(elsewhere((a, d))) == {0, 1}
    assert not elsewhere((a, None))


@pytest.mark.parametrize(("degrees", "metres"), [(1.0, 0.0), (4.0, 0.0), (0.0, 0.2), (2.0, 0.3)])
@pytest.mark.parametrize("lidar", [0, 1, 2])
def test_what_it_moved_by_is_what_a_registration_says(
    simulated: SimulatedSite, lidar: int, degrees: float, metres: float
) -> None:
    first, second = simulated.clouds[lidar]
    one, other = view(first), view(second, turn(degrees, metres, lidar))
    found = moved(one, other)
    assert found is not None
    assert found.rotation == pytest.approx(np.radians(degrees), abs=np.radians(0.05))
    assert found.translation == pytest.approx(metres, abs=0.02)
    assert not shows_same(one, other)
    assert set(elsewhere((one, other))) == {0, 1}


def test_two_that_stood_still_outvote_a_third(simulated: SimulatedSite) -> None:
    first, second = simulated.clouds[0]
    a, b, c = view(first), view(second), view(second, turn(2.0))
    for order in ((a, b, c), (a, c, b), (c, a, b)):
        (where,) = elsewhere(order)
        assert order[where] is c
        step = elsewhere(order)[where]
        assert step is not None
        assert step.rotation == pytest.approx(np.radians(2.0), abs=np.radians(0.05))
    # Of two and two nobody is outvoted.
    assert set(elsewhere((a, b, c, view(first, turn(2.0))))) == {0, 1, 2, 3}


@pytest.mark.parametrize("seed", range(4))
def test_what_sways_a_little_stood_still(simulated: SimulatedSite, seed: int) -> None:
    lidar = seed % 3
    first, second = simulated.clouds[lidar]
    step = turn(0.6 * np.degrees(TURNED), 0.5 * PUSHED, seed)
    assert moved(view(first), view(second, step)) is None
    assert not elsewhere((view(first), view(second, step)))


def test_bare_ground_slides_and_nothing_moved() -> None:
    """Most is ground, and the poles stand elsewhere: seed 612 slid by 0.13 m over half of it."""
    site = simulate_site("ring", np.random.default_rng(612), lidars=3, poles=2)
    for clouds in site.clouds:
        assert not elsewhere([None if cloud is None else view(cloud) for cloud in clouds])


def test_the_refusal_says_who_moved_and_by_how_much(steps: Steps, simulated: SimulatedSite) -> None:
    first, second = simulated.clouds[1]
    rows = [list(row) for row in steps.views.every]
    rows[1] = [view(first), view(second, turn(1.5))]
    with pytest.raises(Refusal) as refused:
        check_places(steps.site, Views(tuple(map(tuple, rows))))
    assert refused.value.code == "lidar_moved"
    assert refused.value.values["lidar"] == "posts-2"
    assert float(refused.value.values["turned_deg"]) == pytest.approx(1.5, abs=0.05)
    assert "another name" in refused.value.message
