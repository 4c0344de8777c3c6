"""The simulated error: the paper's estimator is biased, the beam model is not."""

import numpy as np
import pytest

from retropole.checking.metrics import e_rt
from retropole.simulation import EXACT, simulate_pair
from studies.paper.estimator import (
    PAPER_E_RT,
    PAPER_SIGMA,
    poles_of,
    simulated_error,
    solve,
)
from tests.studies.paper.exhibits import all_exhibits, number

pytestmark = pytest.mark.full


def test_the_beam_model_is_exact_without_noise_and_the_papers_is_not() -> None:
    rows = {row[:2]: row for row in all_exhibits()["simulated_e_rt"].rows}
    ours, paper = (
        number(rows[name, "none"][3]) for name in ("beam model", "the paper's estimator")
    )
    assert ours < 1e-3 < 1e-2 < paper


def test_noise_is_what_it_says() -> None:
    pair, rng = simulate_pair("paper", np.random.default_rng(0), noise=EXACT), np.random.default_rng
    exact = poles_of(pair, "none", rng(1))
    along = poles_of(pair, "along the beam", rng(1))
    isotropic = poles_of(pair, "isotropic", rng(1))
    for side, cloud in enumerate((pair.target, pair.source)):
        for k, pole in enumerate(exact[side]):
            np.testing.assert_array_equal(pole.xyz, cloud.xyz[pole.index])
            rays = pole.xyz / np.linalg.norm(pole.xyz, axis=1, keepdims=True)
            errors = along[side][k].xyz - pole.xyz
            np.testing.assert_allclose(np.cross(errors, rays), 0.0, atol=1e-12)
            for noisy in (np.sum(errors * rays, axis=1), isotropic[side][k].xyz - pole.xyz):
                assert noisy.std() == pytest.approx(PAPER_SIGMA, rel=0.4)


def test_both_estimators_say_that_they_converged() -> None:
    pair = simulate_pair("paper", np.random.default_rng(2), noise=EXACT)
    both = solve(pair, poles_of(pair, "none", np.random.default_rng(0)))
    assert both.paper.converged
    assert both.beam_model is not None
    assert both.beam_model.converged
    assert e_rt(both.beam_model.T_target_source, pair.T_target_source) < 1e-3


@pytest.mark.nightly
def test_the_papers_figure_lies_between_median_and_mean() -> None:
    rows = {row[:2]: row for row in simulated_error(200).rows}
    _, _, paper, median, mean, *_ = rows["the paper's estimator", "isotropic"]
    assert paper == PAPER_E_RT
    assert number(median) < PAPER_E_RT < number(mean)
