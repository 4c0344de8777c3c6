"""Surfaces are laid on surfaces, with a factor where it is free."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.surfaces.registration import voxel_downsample
from retropole.surfaces.similarity_fit import MAX_CHANGE, fit_similarity, planes_of, support

Views = tuple[PointCloud, PointCloud, Array]
NEAR = np.array([0.02, -0.01, 0.03, 0.1, -0.08, 0.05])


@pytest.mark.parametrize("factor", [0.94, 1.0, 1.06])
def test_the_factor_is_found_where_it_is_free(views: Views, factor: float) -> None:
    target, source, T = views
    planes = planes_of(cKDTree(voxel_downsample(target.xyz, 0.2)))
    assert planes is not None
    points = factor * voxel_downsample(source.xyz, 0.2)
    start = se3.retract(T, NEAR)
    fit = fit_similarity(planes, points, start, free_factor=True)
    assert fit is not None
    assert fit.factor == pytest.approx(1 / factor, abs=0.003)
    off = se3.difference(fit.T, T)
    assert off.rotation < 0.005
    assert off.translation < 0.03
    rigid = fit_similarity(planes, points, start, free_factor=False)
    assert rigid is not None
    assert rigid.factor == 1.0
    supported = [support(planes, se3.apply(f.T, f.factor * points)) for f in (fit, rigid)]
    assert supported[0] > 0.8 * len(points)
    if factor == 1.0:
        assert supported[1] == pytest.approx(supported[0], rel=0.02)
    else:
        assert supported[1] < 0.8 * supported[0]


def test_nothing_is_found_far_off_or_where_clouds_would_shrink(views: Views) -> None:
    target, source, T = views
    planes = planes_of(cKDTree(voxel_downsample(target.xyz, 0.2)))
    assert planes is not None
    points = voxel_downsample(source.xyz, 0.2)
    far = se3.retract(T, np.r_[np.zeros(3), 100.0, 0.0, 0.0])
    assert fit_similarity(planes, points, far, free_factor=True) is None
    larger = points * np.exp(2 * MAX_CHANGE)
    assert fit_similarity(planes, larger, T, free_factor=True) is None
    assert planes_of(cKDTree(points[:10])) is None
