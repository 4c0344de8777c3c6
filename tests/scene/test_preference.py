"""Which of two poses the surfaces prefer."""

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, PointCloud
from retropole.scene.preference import preferences
from retropole.simulation import SimulatedPair, simulate_pair

TILT = np.r_[np.radians(0.3), 0.0, 0, 0, 0, 0]
LIFT = np.r_[0.0, 0, 0, 0, 0, 0.03]


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.mark.parametrize("off", [TILT, LIFT])
def test_the_truth_is_preferred_to_a_movement_that_matters(
    street: SimulatedPair, off: Array
) -> None:
    T = street.T_target_source
    there, back = (se3.retract(T, sign * off) for sign in (1.0, -1.0))
    found = preferences(street.target, street.source, T, (there, back))
    assert min(found) > 4.0
    assert preferences(street.target, street.source, there, (T,))[0] == pytest.approx(-found[0])


def test_what_is_below_the_noise_is_not_preferred(street: SimulatedPair) -> None:
    T = street.T_target_source
    near = se3.retract(T, 0.01 * LIFT)
    assert abs(preferences(street.target, street.source, T, (near,))[0]) < 4.0
    assert preferences(street.target, street.source, T, (T,)) == (0.0,)


def test_clouds_without_surfaces_do_not_tell() -> None:
    cloud = PointCloud(np.random.default_rng(0).normal(size=(8, 3)))
    assert preferences(cloud, cloud, np.eye(4), (se3.retract(np.eye(4), LIFT),)) == (0.0,)
