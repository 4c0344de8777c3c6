"""The posterior of a site: its derivatives, and that it is a sum over LiDARs."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.maximum import JointPriors, Sight, evaluate_joint, maximise_joint, place_of
from retropole.alignment.posterior import JointState, Posterior
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from tests.adjustment.adjusting import Steps
from tests.numeric import numeric_jacobian
from tests.tiers import first_of

pytestmark = pytest.mark.full


def at_answer(steps: Steps) -> tuple[JointState, Array, JointPriors]:
    """A state a little off the answer, where no derivative vanishes; noise, and priors."""
    network = steps.adjusted.network
    rng = np.random.default_rng(1)
    step = 5e-4 * rng.normal(size=network.state.size)
    step[network.state.first_axis - 1] = 0.0
    state = network.state.moved(step)
    log_noise = np.log(np.tile([0.01, 0.006], (len(state.T), 1)))
    priors = JointPriors(
        network.state.T, np.full(len(state.T), 0.004), 0.02, 0.0004, steps.datum.free
    )
    return state, log_noise, priors


def evaluated(
    state: JointState, log_noise: Array, steps: Steps, sights: list[Sight], priors: JointPriors
) -> Posterior[JointState]:
    return evaluate_joint(state, log_noise, sights, steps.datum.surveyed, priors)


@pytest.mark.parametrize("which", first_of(["pair_steps", "steps", "surveyed"]))
def test_gradient_and_information_are_those_of_finite_differences(
    which: str, request: pytest.FixtureRequest
) -> None:
    steps: Steps = request.getfixturevalue(which)
    state, log_noise, priors = at_answer(steps)
    # What the datum holds has no part in it: the first LiDAR's pose where nothing was surveyed.
    free = np.flatnonzero(np.r_[priors.free, np.ones(state.size - len(priors.free), dtype=bool)])
    assert (len(free) < state.size) == (which != "surveyed")
    sights = steps.sights
    here = evaluated(state, log_noise, steps, sights, priors)
    rng = np.random.default_rng(2)
    ways = np.zeros((6, state.size))
    ways[:, free] = rng.normal(size=(6, len(free)))

    def cost(along: Array) -> Array:
        return np.array(evaluated(state.moved(along @ ways), log_noise, steps, sights, priors).cost)

    stated = ways @ here.gradient
    # As for a pair: that the noise in depth depends on the angle of the beam is left out.
    np.testing.assert_allclose(
        stated, numeric_jacobian(cost, 6), rtol=2e-2, atol=2e-3 * np.abs(stated).max()
    )

    def gradient(along: Array) -> Array:
        return evaluated(state.moved(along @ ways), log_noise, steps, sights, priors).gradient

    # The information leaves out how the geometry bends, which residuals of a millimetre multiply.
    differences = ways @ numeric_jacobian(gradient, 6)
    information = ways @ here.information @ ways.T
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    assert np.abs((differences - information) / scale).max() < 0.05
    assert np.all(np.linalg.eigvalsh(here.curvature) > 0)


def test_what_the_datum_holds_does_not_move(steps: Steps) -> None:
    state, log_noise, priors = at_answer(steps)
    here = evaluated(state, log_noise, steps, steps.sights, priors)
    held = np.flatnonzero(~priors.free)
    np.testing.assert_array_equal(held, np.arange(6))
    np.testing.assert_array_equal(here.gradient[held], 0.0)
    np.testing.assert_array_equal(here.information[held], np.eye(state.size)[held])


def test_it_is_a_sum_over_the_lidars(steps: Steps) -> None:
    state, log_noise, priors = at_answer(steps)
    none = evaluated(state, log_noise, steps, [], priors)
    whole = evaluated(state, log_noise, steps, steps.sights, priors)
    each = [evaluated(state, log_noise, steps, [sight], priors) for sight in steps.sights]
    assert whole.cost - none.cost == pytest.approx(sum(one.cost - none.cost for one in each))
    np.testing.assert_allclose(
        whole.gradient - none.gradient,
        sum(one.gradient - none.gradient for one in each),
        atol=1e-6 * float(np.abs(whole.gradient).max()),
    )


def test_a_lidars_parameters_are_its_own_but_for_axes_and_radius(steps: Steps) -> None:
    state = steps.adjusted.network.state
    own = [set(place_of(state, sight).tolist()) for sight in steps.sights]
    for sight, places in zip(steps.sights, own, strict=True):
        assert len(places) == len(place_of(state, sight)) == 6 + 1 + 1 + 4 * len(sight.own)
    assert min(set.intersection(*own)) == state.first_axis - 1
    assert set.union(*own) == set(range(state.size))


def test_it_climbs_back_to_the_maximum(steps: Steps) -> None:
    network = steps.adjusted.network
    state, _, priors = at_answer(steps)
    # As much as the returns are off at the start: less noise may hold a pole where it is.
    log_noise = np.log(np.full((3, 2), 0.03))
    rng = np.random.default_rng(4)
    by = 0.01 * rng.normal(size=state.size)
    by[~np.r_[priors.free, np.ones(state.size - len(priors.free), dtype=bool)]] = 0.0
    by[state.first_axis - 1] = 0.0
    held = network.state.moved(by)
    found = maximise_joint(held, log_noise, steps.sights, steps.datum.surveyed, priors)
    assert found.converged
    end = found.point
    assert end.cost <= evaluated(held, end.log_noise, steps, steps.sights, priors).cost
    np.testing.assert_allclose(end.state.T, network.state.T, atol=2e-3)
    assert np.abs(end.gradient / np.sqrt(np.diag(end.information))).max() < 0.05


def test_returns_on_no_common_pole_are_refused(steps: Steps) -> None:
    state, _, priors = at_answer(steps)
    rng = np.random.default_rng(0)
    beams = steps.sights[1].beams
    wild = replace(beams, ranges=beams.ranges + rng.normal(0, 1.0, len(beams.ranges)))
    sights = [replace(steps.sights[1], beams=wild)]
    with pytest.raises(Refusal) as refused:
        maximise_joint(state, np.zeros((3, 2)), sights, steps.datum.surveyed, priors)
    assert refused.value.code == "poor_fit"
