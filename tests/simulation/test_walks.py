"""Simulated walks: returns lie on the pole where it is when they are measured."""

import numpy as np

from retropole.base.sensors import find_sensor
from retropole.simulation import EXACT, draw_device
from retropole.simulation.scenes import bare
from retropole.simulation.walks import REST, Recorder, draw_walk, record_walk

RNG = np.random.default_rng


def test_returns_are_where_the_pole_is_at_their_time() -> None:
    sensor = find_sensor("VLP-16")
    pose = np.eye(4)
    pose[:3, 3] = [-4.5, 0.0, 1.2]
    walk = draw_walk(RNG(2), 0.3, (2.0, 2.0), [pose[:3, 3]])
    recorder = Recorder(sensor, draw_device(sensor, EXACT, RNG(0)), pose, EXACT, clock=7.0)
    for cloud in record_walk([walk], bare(RNG(0)).surfaces, recorder, RNG(1)):
        assert cloud.intensity is not None
        assert cloud.time is not None
        tape = cloud.intensity >= sensor.threshold
        times = cloud.time[tape] - 7.0
        off = cloud.xyz[tape] + pose[:3, 3] - walk.hand(times)
        along = walk.axis(times)
        across = off - np.einsum("ni,ni->n", off, along)[:, None] * along
        assert tape.sum() >= 5
        assert np.allclose(np.linalg.norm(across, axis=1), walk.size[0])


def test_nobody_runs_or_swings_the_pole() -> None:
    walk = draw_walk(RNG(5), 30.0, (3.0, 3.0), [np.array([5.0, 0.0, 1.0])])
    times = np.linspace(0.0, 30.0, 600)
    assert np.linalg.norm(walk.hand(times, 1), axis=1).max() < 2.0
    lean = np.arccos(walk.axis(times)[:, 2])
    assert 0.1 < lean.mean() < 0.6


def test_a_pole_that_is_put_down_rests_as_often_as_said() -> None:
    walk = draw_walk(RNG(4), 20.0, (3.0, 3.0), [np.full(3, 9.0)], stops=2)
    for middle in (5.0, 15.0):
        at = np.linspace(middle - 0.8 * REST / 2, middle + 0.8 * REST / 2, 50)
        assert np.ptp(walk.hand(at), axis=0).max() < 1e-3
        assert np.ptp(walk.lean(at), axis=0).max() < 1e-3
    assert np.linalg.norm(walk.hand(np.array([8.0, 12.0]), 1), axis=1).min() > 0.02
