"""Places, poles and LiDARs keep the limits that they are drawn in."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import EXACT, simulate_pair
from retropole.simulation.raycast import Cylinder
from retropole.simulation.scenes import (
    LIDAR_HEIGHTS,
    MAX_LEAN,
    PAPER_RADIUS,
    POLE_DISTANCES,
    POLE_SPACING,
    SURROUNDINGS,
    draw_lidar,
    draw_paper_poles,
    draw_poles,
    paper_lidar_poses,
    rotated_by_180,
    symmetric_poles,
)
from tests.simulation.surfaces import distance_from

ANGLES = float(np.radians(15)), float(np.radians(60))


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_poles_keep_their_angles_and_distances(count: int, seed: int) -> None:
    poles = draw_poles(np.random.default_rng(seed), count, (6.0, 5.0), ANGLES, 0.02)
    assert poles is not None
    assert len(poles) == count
    axes = np.array([pole.axis for pole in poles])
    feet = np.array([pole.centre - pole.axis * pole.length / 2 for pole in poles])
    i, j = np.triu_indices(count, 1)
    between = np.arccos(np.abs(np.sum(axes[i] * axes[j], axis=1)))
    assert np.all((between >= ANGLES[0]) & (between <= ANGLES[1]))
    assert np.all(axes[:, 2] >= np.cos(MAX_LEAN))
    gaps = np.linalg.norm(feet[i] - feet[j], axis=1)
    assert np.all((gaps >= POLE_SPACING[0]) & (gaps <= POLE_SPACING[1]))
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)


def test_where_no_poles_fit_there_are_none() -> None:
    rng = np.random.default_rng(0)
    assert draw_poles(rng, 2, (6.0, 5.0), (np.radians(80), np.radians(85)), 0.02) is None
    assert draw_poles(rng, 2, (0.1, 0.1), ANGLES, 0.02) is None


def test_a_lidar_stands_within_sight_of_the_poles() -> None:
    rng = np.random.default_rng(1)
    poles = draw_poles(rng, 2, (6.0, 5.0), ANGLES, 0.02)
    assert poles is not None
    drawn = [T for T in (draw_lidar(rng, poles, (6.0, 5.0)) for _ in range(400)) if T is not None]
    assert drawn
    for T in drawn:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert LIDAR_HEIGHTS[0] <= T[2, 3] <= LIDAR_HEIGHTS[1]
        for pole in poles:
            distance = np.linalg.norm((pole.centre - T[:3, 3])[:2])
            assert POLE_DISTANCES[0] <= distance <= POLE_DISTANCES[1]
    upside_down = np.mean([T[2, 2] < 0 for T in drawn])
    assert 0.05 < upside_down < 0.35
    assert draw_lidar(rng, [poles[0], far_away(poles[1])], (6.0, 5.0)) is None


def far_away(pole: Cylinder) -> Cylinder:
    return Cylinder(pole.centre + 100.0, pole.axis, pole.radius, pole.length, pole.material)


@pytest.mark.parametrize("scene", sorted(SURROUNDINGS))
def test_half_a_turn_maps_symmetric_scenes_onto_themselves(scene: str) -> None:
    rng = np.random.default_rng(2)
    surfaces = SURROUNDINGS[scene](rng).surfaces
    both = [*surfaces, *rotated_by_180(surfaces)]
    again = rotated_by_180(both)
    for surface, twin in zip(both, [*again[len(surfaces) :], *again[: len(surfaces)]], strict=True):
        assert type(surface) is type(twin)
        np.testing.assert_allclose(surface.centre, twin.centre, atol=1e-12)
        points = surface.centre + rng.normal(size=(50, 3))
        np.testing.assert_allclose(
            distance_from(surface, points), distance_from(twin, points), atol=1e-9
        )
    one, other = symmetric_poles(rng, 0.02)
    points = one.centre + rng.normal(size=(50, 3))
    rotated = points * [-1.0, -1.0, 1.0]
    np.testing.assert_allclose(distance_from(one, points), distance_from(other, rotated), atol=1e-9)


def test_lidars_and_poles_stand_as_in_the_paper() -> None:
    target, source = paper_lidar_poses()
    np.testing.assert_allclose(target[:3, 3], [1, -1, 0])
    np.testing.assert_allclose(source[:3, 3], [1, 1, 0])
    rng = np.random.default_rng(0)
    for _ in range(50):
        first, second = draw_paper_poles(rng)
        for pole in (first, second):
            assert pole.axis[2] > 0.9
            assert pole.centre[2] == 0
            assert 2 <= np.linalg.norm(pole.centre) <= 3
            assert pole.radius == PAPER_RADIUS
        assert 1.5 <= np.linalg.norm(first.centre - second.centre) <= 4


def test_the_truth_is_that_of_the_two_poses() -> None:
    target, source = paper_lidar_poses()
    pair = simulate_pair("paper", np.random.default_rng(0))
    np.testing.assert_allclose(pair.T_target_source, se3.inverse(target) @ source, atol=1e-12)
    assert pair.surroundings == ()
    assert [sensor.name for sensor in pair.sensors] == ["VLP-16", "VLP-16"]


def test_the_noise_is_6_mm_in_each_coordinate() -> None:
    errors = []
    for seed in range(5):
        noisy, exact = (
            simulate_pair("paper", np.random.default_rng(seed), noise=noise)
            for noise in (None, EXACT)
        )
        errors.append(noisy.target.xyz - exact.target.xyz)
    each = np.concatenate(errors)
    assert each.std(axis=0) == pytest.approx(np.full(3, 0.006), rel=0.1)
    assert np.abs(each.mean(axis=0)).max() < 4 * 0.006 / np.sqrt(len(each))
