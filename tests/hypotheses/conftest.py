"""A street with one pole, simulated once."""

import numpy as np
import pytest

from retropole.simulation import SimulatedPair, simulate_pair


@pytest.fixture(scope="session")
def one_pole() -> SimulatedPair:
    """A street with one pole."""
    return simulated_with_one_pole("street", 1)


def simulated_with_one_pole(scene: str, seed: int) -> SimulatedPair:
    """A scene with one pole, seen by LiDARs of few returns."""
    return simulate_pair(
        scene,
        np.random.default_rng(seed),
        sensor_target="XT32",
        sensor_source="VLP-16",
        poles=1,
    )
