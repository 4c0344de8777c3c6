"""Poses from planes: an exact closed form, and a refinement that ends at the truth or says so."""

from itertools import combinations

import numpy as np
import pytest

from retropole.base import se3
from studies.planes import poses
from studies.planes.extraction import Plane
from studies.planes.poses import agreement, candidate_poses, linearised, refine
from tests.studies.planes.staged import assert_close, transformed, walls

NEARBY = np.array([0.01, -0.01, 0.01, 0.02, 0.02, -0.02])


@pytest.fixture
def planes() -> list[Plane]:
    return walls()


@pytest.mark.parametrize("seed", range(5))
def test_closed_form_is_exact_for_exact_planes(planes: list[Plane], seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    source = transformed(planes, se3.inverse(T))
    for three in combinations(range(4), 3):
        poses = candidate_poses([planes[k] for k in three], [source[k] for k in three[::-1]])
        assert np.min(np.max(np.abs(poses - T), axis=(1, 2))) < 1e-9


def test_every_candidate_is_a_rigid_transform(planes: list[Plane]) -> None:
    T = se3.random(np.random.default_rng(1))
    poses = candidate_poses(planes, transformed(planes, T))
    R = poses[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_a_reflection_is_no_candidate(planes: list[Plane]) -> None:
    mirrored = transformed(planes[1:], np.diag([1.0, -1.0, 1.0, 1.0]))
    assert len(candidate_poses(planes[1:], mirrored)) == 0
    assert len(candidate_poses(planes[1:], planes[1:])) > 0


def test_the_truth_ranks_first_among_the_candidates(planes: list[Plane]) -> None:
    T = se3.random(np.random.default_rng(5))
    source = transformed(planes, se3.inverse(T))
    poses = candidate_poses(planes, source)
    best = poses[np.argmax(agreement(planes, source, poses))]
    assert_close(best, T, 1e-4, 1e-6)


def test_refinement_ends_at_the_truth_from_nearby(planes: list[Plane]) -> None:
    T = se3.random(np.random.default_rng(2))
    source = transformed(planes, se3.inverse(T))
    found = refine(planes, source, se3.retract(T, NEARBY))
    assert found is not None
    assert found.converged
    assert_close(found.pose.T_target_source, T, 1e-5, 1e-6)
    assert found.pose.rms < 1e-6
    assert refine(planes[:2], source[:2], T) is None, "two planes determine no pose"


def test_swapping_the_clouds_inverts_the_refined_pose(planes: list[Plane]) -> None:
    rng = np.random.default_rng(6)
    T = se3.random(rng)
    noisy = [
        Plane(p.normal, p.offset, p.xyz + rng.normal(0, 0.01, p.xyz.shape), p.support)
        for p in transformed(planes, se3.inverse(T))
    ]
    there, back = refine(planes, noisy, T), refine(noisy, planes, se3.inverse(T))
    assert there is not None
    assert back is not None
    assert_close(back.pose.T_target_source @ there.pose.T_target_source, np.eye(4), 1e-4, 1e-6)
    assert there.pose.rms == pytest.approx(back.pose.rms, rel=1e-6)


def test_a_refinement_that_still_moves_reports_it(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses, "MAX_REFINE_STEPS", 1)
    source = transformed(planes, se3.inverse(se3.retract(np.eye(4), NEARBY)))
    rng = np.random.default_rng(7)
    noisy = [
        Plane(p.normal, p.offset, p.xyz + rng.normal(0, 0.02, p.xyz.shape), p.support)
        for p in source
    ]
    found = refine(planes, noisy, np.eye(4))
    assert found is not None
    assert not found.converged


def test_derivative_of_the_distances(planes: list[Plane]) -> None:
    rng = np.random.default_rng(3)
    T = se3.retract(np.eye(4), 0.1 * rng.normal(size=6))
    pairs = [(plane, plane) for plane in planes]
    residuals, jacobian = linearised(pairs, T)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        ahead = linearised(pairs, se3.retract(T, step)).residuals
        behind = linearised(pairs, se3.retract(T, -step)).residuals
        np.testing.assert_allclose(jacobian[:, k], (ahead - behind) / 2e-6, atol=1e-6)
    assert residuals.shape == (2 * sum(len(plane.xyz) for plane in planes),)
