"""Whether both LiDARs saw the poles stand alike: told where one moved, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest
from threadpoolctl import threadpool_limits

from retropole.alignment.adjustment import align_beams
from retropole.alignment.axes_test import AxesTest
from retropole.alignment.observations import Beams
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.simulation import EXACT, SimulatedPair, simulate_pair
from retropole.simulation.pairs import Arrangement, Recorders, record
from studies.paper.estimator import NO_ERRORS
from tests.alignment.beams import beams_at, beams_in, paper
from tests.tiers import first_of

SKEW = (2, 4)
"""Set-ups of the paper whose poles are at 33°, and nearest to each other where they are seen."""


def axes_of(pair: SimulatedPair, beams: tuple[Beams, Beams], start: Array) -> AxesTest:
    """The test of LiDARs that have no systematic errors."""
    known = (NO_ERRORS, NO_ERRORS)
    # Many small matrices: the threads of BLAS would only get in the way.
    with threadpool_limits(1, user_api="blas"):
        return align_beams(*beams, start, radius=pair.poles[0].radius, sizes=known).axes_test


@pytest.mark.full
def test_axes_that_stood_alike() -> None:
    """χ² with two degrees of freedom: the distance and the angle of two poles."""
    values = []
    for seed in range(40):
        pair = paper(seed)
        found = axes_of(pair, beams_at(pair, seed), pair.T_target_source)
        assert found.freedom == 2
        assert found.by_pole.shape == (2,)
        # Freeing one pole is freeing less than both.
        assert 0 <= found.by_pole.max() <= found.chi2 + 1e-6
        values.append(found.chi2)
    assert 1.3 < np.mean(values) < 2.8
    assert kstest(values, chi2(2).cdf).pvalue > 0.01


def with_pole_moved(pair: SimulatedPair, which: int, step: Array) -> SimulatedPair:
    """Record again where one pole stands elsewhere: step (3,) in the world frame."""
    poles = list(pair.poles)
    poles[which] = replace(poles[which], centre=poles[which].centre + step)
    poses = pair.T_world_target, pair.T_world_source
    at = Arrangement(pair.surroundings, poles, poses, pair.clear)
    recorders = Recorders(pair.sensors, pair.devices, pair.noise, 1)
    return record(at, recorders, np.random.default_rng(0))


@pytest.mark.parametrize("seed", first_of(SKEW))
def test_a_pole_that_was_displaced_between_the_recordings(seed: int) -> None:
    """By 5 cm across both poles, their distance tells; along their plane, the pose has it all."""
    pair = paper(seed)
    a, b = (pole.axis for pole in pair.poles)
    across = np.cross(a, b) / np.linalg.norm(np.cross(a, b))

    def displaced(step: Array) -> float:
        beams = beams_at(pair)[0], beams_at(with_pole_moved(pair, 1, step))[1]
        return axes_of(pair, beams, pair.T_target_source).chi2

    assert displaced(np.zeros(3)) < 14
    for sign in (-1, 1):
        assert displaced(sign * 0.05 * across) > 30
    assert displaced(0.05 * np.cross(across, b)) < 14


@pytest.mark.full
def test_freeing_the_displaced_pole_of_three_explains_all() -> None:
    only_range = replace(EXACT, range_noise=0.6)
    pair = simulate_pair("street", np.random.default_rng(2), poles=3, noise=only_range)
    still = axes_of(pair, (beams_in(pair, 0), beams_in(pair, 1)), pair.T_target_source)
    assert still.freedom == 6
    assert 0.5 < still.chi2 < 22
    for which in range(3):
        other = with_pole_moved(pair, which, np.array([0.06, 0.0, 0.0]))
        found = axes_of(pair, (beams_in(pair, 0), beams_in(other, 1)), pair.T_target_source)
        assert found.chi2 > 60
        assert found.chi2 - found.by_pole[which] < 16


def test_moving_both_clouds_does_not_move_the_test() -> None:
    pair, rng = paper(4), np.random.default_rng(0)
    A, B = se3.random(rng), se3.random(rng)
    plain = axes_of(pair, beams_at(pair), pair.T_target_source)
    target, source = (
        replace(
            beams,
            origin=se3.apply(T, beams.origin[None])[0],
            directions=beams.directions @ T[:3, :3].T,
        )
        for beams, T in zip(beams_at(pair), (A, B), strict=True)
    )
    moved = axes_of(pair, (target, source), A @ pair.T_target_source @ se3.inverse(B))
    assert moved.chi2 == pytest.approx(plain.chi2, rel=0.05)
    np.testing.assert_allclose(moved.by_pole, plain.by_pole, rtol=0.05)


def test_exchanging_the_lidars_does_not_change_the_test() -> None:
    pair = paper(6)
    target, source = beams_at(pair)
    forth = axes_of(pair, (target, source), pair.T_target_source)
    back = axes_of(pair, (source, target), se3.inverse(pair.T_target_source))
    assert back.chi2 == pytest.approx(forth.chi2, rel=0.05)
