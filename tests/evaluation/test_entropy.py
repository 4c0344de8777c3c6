"""The entropy against the plain double sum, and the bound on what it leaves out."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.cli.evaluate import evaluate as command
from retropole.evaluation.entropy import KERNEL_WIDTH, rqe
from tests.evaluation.surfaces import floor_and_wall


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
