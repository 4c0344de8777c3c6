import numpy as np
import pytest

from benchmarks.city import SURVEY, simulate_city
from retropole.base import se3

pytestmark = pytest.mark.full


def test_edges_miss_the_truth_by_their_noise_and_by_their_gross_error() -> None:
    city = simulate_city(400, np.random.default_rng(0), wrong=0.05)
    true = np.linalg.inv(city.T_world_node[city.i]) @ city.T_world_node[city.j]
    missed = np.array([se3.local(a, b) for a, b in zip(city.T_i_j, true, strict=True)])
    chi2 = np.einsum("ka,kab,kb->k", missed, np.linalg.inv(city.covariance), missed)
    assert 5 < chi2[~city.wrong].mean() < 7
    assert chi2[~city.wrong].max() < 40
    assert not city.error[~city.wrong].any()
    assert city.error[city.wrong].any(axis=1).all()
    assert city.wrong.sum() == round(0.05 * len(city.i))


def test_a_city_has_two_edges_for_each_lidar_and_a_survey() -> None:
    city = simulate_city(2000, np.random.default_rng(1), controls=50)
    assert 1.9 < len(city.i) / len(city.T_world_node) < 2.1
    away = (city.surveyed - city.T_world_node[city.control, :3, 3]) / SURVEY
    assert 0.8 < away.std() < 1.2
    assert len(np.unique(city.control)) == 50
