"""Equations 1 and 2 as printed: the pose found has the least sum of distances."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import EXACT, simulate_pair
from studies.paper.estimator import align_poles, poles_of
from studies.paper.norms import align_by_norms, lines_of, simulated_norms, sum_of_norms
from tests.studies.paper.exhibits import number

pytestmark = pytest.mark.full


def test_no_pose_nearby_has_a_smaller_sum() -> None:
    rng = np.random.default_rng(0)
    for seed in range(3):
        pair = simulate_pair("paper", np.random.default_rng(seed), noise=EXACT)
        target, source = poles_of(pair, "isotropic", rng)
        axes, points = [(p.point, p.direction) for p in target], [p.xyz for p in source]
        squares = align_poles(axes, points, pair.T_target_source).T_target_source
        lines = lines_of(axes, points)
        norms = align_by_norms(lines, squares)
        least = sum_of_norms(norms, lines)
        assert least < sum_of_norms(squares, lines)
        for step in 1e-3 * rng.normal(size=(20, 6)):
            assert least < sum_of_norms(se3.retract(norms, step), lines)


def test_points_on_their_lines_leave_no_error() -> None:
    pair = simulate_pair("paper", np.random.default_rng(1), noise=EXACT)
    T = pair.T_target_source
    rng, axes, points = np.random.default_rng(2), [], []
    for n in ((0.1, 0.0, 1.0), (0.0, -0.3, 1.0)):
        point, direction = rng.normal(size=3), np.array(n) / np.linalg.norm(n)
        on_line = point + np.linspace(-1, 1, 20)[:, None] * direction
        axes.append((point, direction))
        points.append(se3.apply(se3.inverse(T), on_line))
    found = align_by_norms(lines_of(axes, points), se3.retract(T, np.full(6, 0.01)))
    np.testing.assert_allclose(found, T, atol=1e-6)


def test_both_readings_are_listed_for_every_noise() -> None:
    exhibit = simulated_norms(2)
    assert len(exhibit.rows) == 6
    assert all(number(cell) > 0 for row in exhibit.rows for cell in row[2:])
