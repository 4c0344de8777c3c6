"""e_rt of plain errors, scores that are best at the truth, the entropy against the plain sum."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.checking.metrics import KERNEL_WIDTH, e_rt, errors_of, evaluate, rqe
from retropole.cli.evaluate import evaluate as command
from retropole.simulation import simulate_pair
from tests.checking.surfaces import floor_and_wall


def rotation(axis: int, angle: float) -> Array:
    """Rotate about an axis (4, 4)."""
    return se3.from_rt(se3.exp_so3(angle * np.eye(3)[axis]), np.zeros(3))


@pytest.mark.full
def test_e_rt_is_zero_for_the_truth() -> None:
    T = se3.random(np.random.default_rng(0))
    assert e_rt(T, T) == 0.0


@pytest.mark.full
def test_e_rt_of_a_translation_is_its_length() -> None:
    T_true = se3.random(np.random.default_rng(1))
    T = T_true.copy()
    T[:3, 3] += [0.03, 0.0, 0.04]
    assert e_rt(T, T_true) == pytest.approx(0.05)


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.full
def test_e_rt_of_a_rotation_across_y_grows_with_the_range(axis: int) -> None:
    T_true = se3.random(np.random.default_rng(2))
    assert e_rt(T_true @ rotation(axis, 0.001), T_true) == pytest.approx(0.001 * 30.5, rel=1e-4)


@pytest.mark.full
def test_e_rt_does_not_see_a_rotation_about_y() -> None:
    T_true = se3.random(np.random.default_rng(3))
    assert e_rt(T_true @ rotation(1, 0.5), T_true) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.full
def test_e_rt_does_not_depend_on_the_target_frame() -> None:
    rng = np.random.default_rng(4)
    T, T_true, A = se3.random(rng), se3.random(rng), se3.random(rng)
    assert e_rt(A @ T, A @ T_true) == pytest.approx(e_rt(T, T_true))
    assert e_rt(T_true, T) == pytest.approx(e_rt(T, T_true))


@pytest.mark.full
def test_errors_of_a_known_step() -> None:
    T = se3.random(np.random.default_rng(1))
    assert errors_of(T, T).e_rt == pytest.approx(0, abs=1e-12)
    off = errors_of(se3.retract(T, np.array([0.0, 0, 0.01, 0.03, 0, 0.04])), T)
    assert off.rotation == pytest.approx(0.01)
    assert off.translation == pytest.approx(0.05)


@pytest.mark.full
def test_the_truth_is_sharper_than_anything_next_to_it() -> None:
    rng = np.random.default_rng(8)
    T = se3.random(rng)
    target = PointCloud(floor_and_wall(20_000, 8))
    source = PointCloud(se3.apply(se3.inverse(T), floor_and_wall(20_000, 9)))
    right = evaluate(target, source, T, rng=np.random.default_rng(0))
    for step in (np.array([0, 0.02, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0, 0.1])):
        wrong = evaluate(target, source, se3.retract(T, step), rng=np.random.default_rng(0))
        assert right.entropy.sum > wrong.entropy.sum
        assert right.plane_residual is not None
        assert wrong.plane_residual is not None
        assert right.plane_residual < wrong.plane_residual


@pytest.mark.full
def test_what_stands_in_the_scene_agrees_at_the_truth_and_denies_elsewhere() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    right, wrong = (
        evaluate(pair.target, pair.source, T, rng=np.random.default_rng(0)).confirmation
        for T in (pair.T_target_source, se3.retract(pair.T_target_source, np.full(6, 0.3)))
    )
    assert right.contradicted < 0.05
    assert wrong.contradicted > 0.2
    assert right.agreeing > 2 * wrong.agreeing


@pytest.mark.full
def test_clouds_that_were_moved_agree_as_well() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    A = se3.retract(np.eye(4), np.r_[0.0, 0.0, 0.4, 3.0, -2.0, 1.0])
    moved = replace(pair.target.transformed(A), origin=np.zeros(3), axis=np.eye(3)[2])
    rng = np.random.default_rng(0)
    plain = evaluate(pair.target, pair.source, pair.T_target_source, rng=rng).confirmation
    found = evaluate(moved, pair.source, A @ pair.T_target_source, rng=rng).confirmation
    assert found.contradicting <= plain.contradicting + 5
    assert found.agreeing == pytest.approx(plain.agreeing, rel=0.1)


@pytest.mark.full
def test_nothing_overlaps_far_away() -> None:
    target, source = (PointCloud(floor_and_wall(2000, seed)) for seed in (10, 11))
    T = np.eye(4)
    T[0, 3] = 500.0
    apart = evaluate(target, source, T, rng=np.random.default_rng(0))
    assert apart.overlap == 0.0
    assert apart.plane_residual is None
    together = evaluate(target, source, np.eye(4), rng=np.random.default_rng(0))
    assert together.overlap > 0.9


@pytest.mark.full
def test_clouds_without_surfaces_are_refused() -> None:
    cloud, empty = PointCloud(floor_and_wall(2000, 12)), PointCloud(np.zeros((0, 3)))
    for target, source in ((empty, cloud), (cloud, empty)):
        with pytest.raises(Refusal) as refusal:
            evaluate(target, source, np.eye(4), rng=np.random.default_rng(0))
        assert refusal.value.code == "too_few_points"


def plain_double_sum(xyz: Array, sigma: float) -> float:
    square = cdist(xyz, xyz, "sqeuclidean")
    kernel = np.exp(-square / (4 * sigma**2)) / (4 * np.pi * sigma**2) ** 1.5
    return float(kernel.sum() / len(xyz) ** 2)


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.5])
@pytest.mark.parametrize("n", [1, 200, 5000])
@pytest.mark.full
def test_it_is_the_plain_double_sum(n: int, sigma: float) -> None:
    xyz = floor_and_wall(n, 5)
    plain = plain_double_sum(xyz, sigma)
    truncated, exact = rqe(xyz, sigma), rqe(xyz, sigma, tolerance=0.0)
    assert truncated.sum == pytest.approx(plain, rel=1e-6)
    assert exact.sum == pytest.approx(plain, rel=1e-10)
    assert exact.error == 0.0
    assert truncated.log == pytest.approx(-np.log(plain), abs=1e-6)
    assert truncated.points == n


def test_it_states_the_error_of_what_it_leaves_out() -> None:
    xyz = floor_and_wall(5000, 6)
    exact = rqe(xyz, 0.05, tolerance=0.0).sum
    for tolerance in (1e-3, 1e-1, 1.0):
        rough = rqe(xyz, 0.05, tolerance=tolerance)
        assert 0.0 <= 1.0 - rough.sum / exact <= rough.error <= tolerance


def test_it_does_not_depend_on_frame_or_order() -> None:
    rng = np.random.default_rng(7)
    xyz = floor_and_wall(3000, 7)
    shuffled = se3.apply(se3.random(rng), rng.permutation(xyz))
    assert rqe(shuffled).sum == pytest.approx(rqe(xyz).sum, rel=1e-6)


def test_points_closer_together_are_sharper() -> None:
    xyz = floor_and_wall(2000, 8)
    sums = [rqe(scale * xyz).sum for scale in (1.0, 0.8, 0.5)]
    assert sums == sorted(sums)
    logs = [rqe(scale * xyz).log for scale in (1.0, 0.8, 0.5)]
    assert logs == sorted(logs, reverse=True)


def test_the_entropy_of_nothing_is_refused() -> None:
    with pytest.raises(Refusal, match="no points") as refusal:
        rqe(np.zeros((0, 3)))
    assert refusal.value.code == "too_few_points"


def test_the_command_offers_the_same_kernel() -> None:
    sigma = next(option for option in command.params if option.name == "sigma")
    assert sigma.default == KERNEL_WIDTH
