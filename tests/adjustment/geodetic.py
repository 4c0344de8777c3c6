"""A network of control points alone, as surveyors adjust them: linear, and drawn at will."""

from dataclasses import replace

import numpy as np

from retropole.adjustment.descent import End, RefinementProblem, minimise
from retropole.adjustment.solved import Solved, solve_all
from retropole.alignment.network import Network, Observation, factor_of, observe
from retropole.alignment.posterior import JointState, Posterior
from retropole.base.datatypes import Array
from retropole.base.systematic import ErrorModel, Groups, Sizes
from tests.alignment.test_posterior import drawn
from tests.alignment.test_survey import everything

LIDARS, POINTS = 3, 5


def network(*, first_held: bool = False) -> Network:
    """Five known points that three LiDARs see, and up of one; what is observed is exact."""
    state: JointState = drawn(LIDARS, axes=0, control=POINTS)
    surveyed = everything(state, off=0.0, ends=False)
    end = Posterior(
        state, np.zeros((LIDARS, 2)), 0.0, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), 0.0
    )
    free = np.ones(6 * LIDARS, dtype=bool)
    free[:6] = not first_held
    bands = tuple(np.array([-1, 2]) for _ in range(LIDARS))
    placement = np.zeros(0, dtype=np.int64)
    return observe(end, [], placement, surveyed, state.radius, bands, free)


def with_errors(net: Network, errors: list[Array]) -> Network:
    """Give every observation an error (M,), in units of its 1 σ."""
    found = []
    for one, error in zip(net.observations, errors, strict=True):
        assert one.by_value is not None
        J, _, sigma = one.by_value
        found.append(replace(one, gradient=-J.T @ error, by_value=(J, error, sigma)))
    return replace(net, observations=tuple(found))


def drawn_errors(net: Network, rng: np.random.Generator) -> list[Array]:
    return [rng.normal(size=size_of(one)) for one in net.observations]


def size_of(one: Observation) -> int:
    assert one.by_value is not None
    return len(one.by_value[1])


def adjusted(net: Network) -> tuple[End, Solved]:
    """Adjust it: nothing is known of any LiDAR's errors."""
    groups: Groups = net.unknowns.groups()
    known = ErrorModel((Sizes(),) * LIDARS, 1e-3).sigmas(groups)
    problem = RefinementProblem(factor_of(net), (), groups, known)
    end = minimise(problem)
    return end, solve_all(net, end, groups, ())
