"""Clouds that are mirrored or scaled: the factors that poles allow, and the fit of surfaces."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, Pole
from retropole.base.errors import Refusal
from retropole.hypotheses.correspondence import DISTANCE_TOLERANCE, match_poles
from retropole.hypotheses.similarity import (
    MAX_CHANGE,
    changed_cloud,
    changed_pole,
    factors_of,
    fit_similarity,
    support,
    surfaces_of,
)
from retropole.surfaces.registration import voxel_downsample
from tests.conftest import PoleMaker
from tests.surfaces.conftest import room

AXES = [
    (np.array([4.0, -1.0, 0.2]), np.array([0.1, 0.25, 1.0])),
    (np.array([5.0, 1.3, -0.1]), np.array([-0.2, -0.3, 1.0])),
    (np.array([3.0, 2.5, 0.0]), np.array([0.45, 0.1, 1.0])),
]


def seen_twice(make_pole: PoleMaker, count: int) -> tuple[list[Pole], list[Pole], Array]:
    T = se3.random(np.random.default_rng(4), 3.0)
    target = [make_pole(p, n) for p, n in AXES[:count]]
    return target, [make_pole(p, n, T=se3.inverse(T)) for p, n in AXES[:count]], T


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("factor", [0.3048, 0.95, 1.0, 1.07, 3.0])
def test_the_factor_is_found_and_swapping_inverts_it(
    make_pole: PoleMaker, count: int, factor: float
) -> None:
    target, source, _ = seen_twice(make_pole, count)
    scaled = [changed_pole(pole, factor) for pole in source]
    assert factors_of(target, scaled)[0] == pytest.approx(1 / factor, rel=1e-6)
    assert factors_of(scaled, target)[0] == pytest.approx(factor, rel=1e-6)


def test_lines_that_nearly_meet_have_no_factor(make_pole: PoleMaker) -> None:
    p, n = AXES[0]
    across = np.cross(n, AXES[1][1])
    across /= np.linalg.norm(across)
    for gap, told in ((0.5 * DISTANCE_TOLERANCE, 0), (2 * DISTANCE_TOLERANCE, 1)):
        near = [make_pole(p, n), make_pole(p + gap * across, AXES[1][1])]
        assert len(factors_of(near, near)) == told


def test_mirrored_poles_match_only_once_mirrored_again(make_pole: PoleMaker) -> None:
    target, source, T = seen_twice(make_pole, 2)
    mirror = -1.0
    image = [changed_pole(pole, mirror) for pole in source]
    with pytest.raises(Refusal):
        match_poles(target, image)
    again = match_poles(target, [changed_pole(pole, mirror) for pole in image])
    assert min(se3.difference(m.T_target_source, T).rotation for m in again) < 1e-6


def test_a_change_of_a_cloud_and_its_inverse_leave_it() -> None:
    rng = np.random.default_rng(0)
    axis = np.array([0.6, 0.0, 0.8])
    cloud = PointCloud(rng.normal(size=(5, 3)), origin=rng.normal(size=3), axis=axis)
    changed = changed_cloud(cloud, -2.5)
    np.testing.assert_allclose(np.linalg.norm(changed.axis), 1.0)
    np.testing.assert_allclose(changed.xyz, -2.5 * cloud.xyz)
    back = changed_cloud(changed, -1 / 2.5)
    for one, other in ((back.xyz, cloud.xyz), (back.origin, cloud.origin), (back.axis, cloud.axis)):
        np.testing.assert_allclose(one, other)


Views = tuple[PointCloud, PointCloud, Array]
NEAR = np.array([0.02, -0.01, 0.03, 0.1, -0.08, 0.05])


@pytest.fixture(scope="module")
def views() -> Views:
    """Two views of one room, with the pose between them."""
    rng = np.random.default_rng(0)
    places = np.array([-2.0, 1.0, 1.5]), np.array([1.0, 0.5, 1.2])
    target, source = (room(place, rng) for place in places)
    return target, source, se3.from_rt(np.eye(3), places[1] - places[0])


@pytest.mark.parametrize("factor", [0.94, 1.0, 1.06])
def test_the_factor_is_found_where_it_is_free(views: Views, factor: float) -> None:
    target, source, T = views
    surfaces = surfaces_of(cKDTree(voxel_downsample(target.xyz, 0.2)))
    assert surfaces is not None
    points = factor * voxel_downsample(source.xyz, 0.2)
    start = se3.retract(T, NEAR)
    fit = fit_similarity(surfaces, points, start, free_factor=True)
    assert fit is not None
    assert fit[1] == pytest.approx(1 / factor, abs=0.003)
    off = se3.difference(fit[0], T)
    assert off.rotation < 0.005
    assert off.translation < 0.03
    rigid = fit_similarity(surfaces, points, start, free_factor=False)
    assert rigid is not None
    assert rigid[1] == 1.0
    supported = [support(surfaces, se3.apply(T, by * points)) for T, by in (fit, rigid)]
    assert supported[0] > 0.8 * len(points)
    if factor == 1.0:
        assert supported[1] == pytest.approx(supported[0], rel=0.02)
    else:
        assert supported[1] < 0.8 * supported[0]


def test_nothing_is_found_far_off_or_where_clouds_would_shrink(views: Views) -> None:
    target, source, T = views
    surfaces = surfaces_of(cKDTree(voxel_downsample(target.xyz, 0.2)))
    assert surfaces is not None
    points = voxel_downsample(source.xyz, 0.2)
    far = se3.retract(T, np.r_[np.zeros(3), 100.0, 0.0, 0.0])
    assert fit_similarity(surfaces, points, far, free_factor=True) is None
    larger = points * np.exp(2 * MAX_CHANGE)
    assert fit_similarity(surfaces, larger, T, free_factor=True) is None
    assert surfaces_of(cKDTree(points[:10])) is None
