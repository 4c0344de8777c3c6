"""Beams of both LiDARs of simulated pairs at their poles, and a state near the truth."""

import numpy as np

from retropole.alignment.observations import Beams, beams_of
from retropole.alignment.posterior import State
from retropole.base import se3
from retropole.base.datatypes import Array, Pole
from retropole.simulation import EXACT, SimulatedPair, simulate_pair
from studies.paper.estimator import as_beams, poles_of


def paper(seed: int) -> SimulatedPair:
    return simulate_pair("paper", np.random.default_rng(seed), noise=EXACT)


def beams_at(pair: SimulatedPair, seed: int = 0) -> tuple[Beams, Beams]:
    """Beams at the poles of the paper's set-up, with noise along them."""
    return as_beams(pair, poles_of(pair, "along the beam", np.random.default_rng([seed, 1])))


def beams_in(pair: SimulatedPair, side: int) -> Beams:
    """Beams of one LiDAR at the poles of a scene, those that passed among them."""
    first = len(pair.surfaces) - len(pair.poles)
    cloud = (pair.target, pair.source)[side]
    index = [np.flatnonzero(pair.labels[side] == first + k) for k in range(len(pair.poles))]
    return beams_of([(as_pole(cloud.xyz[i]), cloud) for i in index], pair.sensors[side])


def beams_with_surroundings() -> tuple[SimulatedPair, tuple[Beams, Beams]]:
    """Beams at the poles of a street, of which some passed."""
    pair = simulate_pair("street", np.random.default_rng(1))
    return pair, (beams_in(pair, 0), beams_in(pair, 1))


def as_pole(xyz: Array) -> Pole:
    centre = xyz.mean(axis=0)
    n = np.linalg.svd(xyz - centre, full_matrices=False)[2][0]
    along = (xyz - centre) @ n
    return Pole(centre, n, xyz, float(np.ptp(along)), 0.01, 9, np.arange(len(xyz)))


def state_near(pair: SimulatedPair) -> State:
    """A state a little off the truth, where nothing vanishes."""
    T = se3.inverse(pair.T_world_target)
    return State(
        se3.retract(pair.T_target_source, np.full(6, 1e-3)),
        np.array([0.001, 0.002]),
        pair.poles[0].radius + 0.001,
        se3.apply(T, np.array([pole.centre for pole in pair.poles])),
        np.array([pole.axis for pole in pair.poles]) @ T[:3, :3].T,
    )
