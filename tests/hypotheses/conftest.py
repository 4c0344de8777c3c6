"""A street with one pole, simulated once."""

from collections.abc import Mapping

import numpy as np
import pytest

from retropole.base.datatypes import Array, Hypothesis, Match
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


def hypothesis_at(
    T: Array, poles: Mapping[int, int], score: float = 0.5, *, stands: bool = True
) -> Hypothesis:
    """A pose that so many poles of each placement allow, and the scene does not rule out."""
    match = Match(((0, 0), (1, 1)), T, 0.0, True, True, np.eye(6))
    return Hypothesis(match, None, None, score, 0.0, score, None, stands, True, poles)
