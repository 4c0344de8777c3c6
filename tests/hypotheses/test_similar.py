"""Poles of mirrored and scaled clouds, and the scales that poles allow."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, Pole
from retropole.base.errors import Refusal
from retropole.hypotheses.correspondence import DISTANCE_TOLERANCE, match_poles
from retropole.hypotheses.similar import MAX_FACTOR, Change, changed_cloud, changed_pole, factors_of
from tests.conftest import PoleMaker

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
    scaled = [changed_pole(pole, Change(factor)) for pole in source]
    assert factors_of(target, scaled, 3)[0] == pytest.approx(1 / factor, rel=1e-6)
    assert factors_of(scaled, target, 3)[0] == pytest.approx(factor, rel=1e-6)


def test_no_factor_beyond_the_limit_and_none_of_lines_that_nearly_meet(
    make_pole: PoleMaker,
) -> None:
    target, source, _ = seen_twice(make_pole, 2)
    assert not factors_of(target, [changed_pole(p, Change(1.1 * MAX_FACTOR)) for p in source], 3)
    p, n = AXES[0]
    across = np.cross(n, AXES[1][1])
    across /= np.linalg.norm(across)
    for gap, told in ((0.5 * DISTANCE_TOLERANCE, 0), (2 * DISTANCE_TOLERANCE, 1)):
        near = [make_pole(p, n), make_pole(p + gap * across, AXES[1][1])]
        assert len(factors_of(near, near, 3)) == told


def test_mirrored_poles_match_only_once_mirrored_again(make_pole: PoleMaker) -> None:
    target, source, T = seen_twice(make_pole, 2)
    mirror = Change(mirrored=True)
    image = [changed_pole(pole, mirror) for pole in source]
    with pytest.raises(Refusal):
        match_poles(target, image)
    again = match_poles(target, [changed_pole(pole, mirror) for pole in image])
    assert min(se3.difference(m.T_target_source, T).rotation for m in again) < 1e-6


def test_a_change_of_a_cloud_and_its_inverse_leave_it() -> None:
    rng = np.random.default_rng(0)
    axis = np.array([0.6, 0.0, 0.8])
    cloud = PointCloud(rng.normal(size=(5, 3)), origin=rng.normal(size=3), axis=axis)
    changed = changed_cloud(cloud, Change(2.5, mirrored=True))
    np.testing.assert_allclose(np.linalg.norm(changed.axis), 1.0)
    np.testing.assert_allclose(changed.xyz[:, 0], -2.5 * cloud.xyz[:, 0])
    back = changed_cloud(changed, Change(1 / 2.5, mirrored=True))
    for one, other in ((back.xyz, cloud.xyz), (back.origin, cloud.origin), (back.axis, cloud.axis)):
        np.testing.assert_allclose(one, other)
