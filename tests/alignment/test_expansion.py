"""What the poles say, as a quadratic form: its derivatives, its elimination, and the axes' test."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest
from threadpoolctl import threadpool_limits

from retropole.alignment.adjustment import align_beams
from retropole.alignment.certainty import prior_precision, solve_factor
from retropole.alignment.expansion import AxesTest, Expansion, expand, pole_factor
from retropole.alignment.factor import MANY, gaussian_factor
from retropole.alignment.likelihood import arc_likelihood, passed_beam_likelihood
from retropole.alignment.observations import Beams, beams_of
from retropole.alignment.posterior import State, beam_geometry
from retropole.alignment.unknowns import POSE, Unknowns
from retropole.alignment.views import View, exact_view
from retropole.base import se3
from retropole.base.datatypes import Array, Pole, PoseEstimate
from retropole.base.systematic import (
    DEVICE,
    NO_ERRORS,
    RADIUS,
    RING,
    TAPE,
    WIDTH,
    ErrorModel,
    Layout,
    band_of,
)
from retropole.simulation import EXACT, SimulatedPair, simulate_pair
from retropole.simulation.recording import Arrangement, Recorders, record
from studies.paper.estimator import as_beams, poles_of
from tests.numeric import numeric_jacobian

SKEW = (2, 4)
"""Set-ups of the paper whose poles are at 33°, and nearest to each other where they are seen."""


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


def bent(azimuth: Array, b: Array) -> Array:
    """How far scan lines are bent up, of periods 180° and 120°."""
    c2, s2, c3, s3 = b
    return np.asarray(
        c2 * np.cos(2 * azimuth)
        + s2 * np.sin(2 * azimuth)
        + c3 * np.cos(3 * azimuth)
        + s3 * np.sin(3 * azimuth)
    )


def corrected(
    directions: Array, ranges: Array, b: Array, lidar: int, layout: Layout
) -> tuple[Array, Array]:
    """Directions and ranges without the errors b, as the head of `systematic` defines them."""
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(directions[:, 2])
    own = b[layout.device(lidar)]
    (zero, scale, _, encoder_c, encoder_s, wobble_c, wobble_s), (tape, _) = own[:7], own[-2:]
    by_band = np.zeros((RING, len(directions)))
    for kind in range(RING):
        for band, value in zip(layout.bands[lidar], b[layout.rings(lidar, kind)], strict=True):
            by_band[kind, band_of(directions, np.array([0.0, 0.0, 1.0])) == band] = value
    ranges = ranges - zero - scale * ranges - tape - by_band[0]
    turned = azimuth + encoder_c * np.cos(azimuth) + encoder_s * np.sin(azimuth) + by_band[2]
    raised = elevation + wobble_c * np.cos(azimuth) + wobble_s * np.sin(azimuth) + by_band[1]
    raised += bent(azimuth, own[7:-2])
    level = np.cos(raised)
    new = np.stack([level * np.cos(turned), level * np.sin(turned), np.sin(raised)], axis=1)
    return new, ranges


def exact(log_noise: Array) -> list[View]:
    """Views of two poles that leave nothing open, of LiDARs with this noise."""
    return [exact_view(2, noise) for noise in np.exp(log_noise)]


def log_likelihood(
    state: State, b: Array, beams: Beams, lidar: int, layout: Layout, sigma: Array
) -> Array:
    """Logarithm of the likelihood of one LiDAR's beams, sigma (N,) in depth and 3 mm sideways."""
    beams = beams.wider(float(b[layout.device(lidar)][WIDTH]))
    directions, ranges = corrected(beams.directions, beams.ranges, b, lidar, layout)
    seen = beam_geometry(state, lidar, beams.origin, directions, ranges, beams.pole)
    radius = state.radius
    lateral = np.full_like(sigma, 0.003)
    arc = arc_likelihood(
        seen.depth, seen.lateral_offset, sigma, lateral, radius, beams.half_width, beams.beside
    )
    far = np.zeros(len(beams.passed_pole))
    directions, _ = corrected(beams.passed_directions, far, b, lidar, layout)
    beside = beam_geometry(state, lidar, beams.origin, directions, far, beams.passed_pole)
    free = passed_beam_likelihood(
        beside.lateral_offset, np.full_like(far, 0.003), radius, beams.passed_half_width
    )
    return np.array(arc.log.sum() + free.log.sum())


@pytest.mark.parametrize("surroundings", [False, True])
def test_the_gradient_is_that_of_the_likelihood_of_corrected_beams(surroundings: bool) -> None:
    """Over the pose, every error, and the axes; of each LiDAR and of each pole by itself."""
    if surroundings:
        pair, beams = beams_with_surroundings()
        assert min(len(one.passed_pole) for one in beams) > 10
    else:
        pair = paper(2)
        beams = beams_at(pair)
    state, log_noise = state_near(pair), np.log(np.tile([0.006, 0.003], (2, 1)))
    for lidar in (0, 1):
        for pole in (0, 1):
            one = [only(each, pole) for each in beams]
            found = expand(state, exact(log_noise), one, pair.poles[0].radius)
            layout = found.layout
            axes = POSE + layout.size

            # Within a step, the noise does not follow the angle between beam and pole.
            each = one[lidar]
            sine = beam_geometry(
                state, lidar, each.origin, each.directions, each.ranges, each.pole
            ).sine
            sigma = np.hypot(0.006 * sine, 0.003 * np.sqrt(1 - sine**2))

            def log_at(
                step: Array, axes: int = axes, each: Beams = each, sigma: Array = sigma
            ) -> Array:
                b = step[POSE:axes]
                shared = np.r_[step[:POSE], 0.0, 0.0, b[RADIUS], step[axes:]]
                moved = state.moved(shared)
                return log_likelihood(moved, b, each, lidar, layout, sigma)  # noqa: B023

            slope = numeric_jacobian(log_at, len(found.gradient[lidar]), 1e-7)
            # Each kind of parameter against its own size: they differ by far.
            for part in parts_of(layout, lidar):
                largest = np.abs(slope[part]).max()
                np.testing.assert_allclose(
                    found.gradient[lidar][part], slope[part], atol=3e-3 * largest
                )


def parts_of(layout: Layout, lidar: int) -> list[slice]:
    """Rotation, translation, the errors of one LiDAR, its width, the radius, and the axes."""
    first = layout.device(lidar).start
    errors = [slice(first, first + WIDTH), slice(first + WIDTH, first + WIDTH + 1)]
    errors += [layout.rings(lidar, 0), layout.rings(lidar, 1), slice(RADIUS, RADIUS + 1)]
    moved = [slice(POSE + part.start, POSE + part.stop) for part in errors]
    return [slice(0, 3), slice(3, 6), *moved, slice(POSE + layout.size, None)]


def only(beams: Beams, pole: int) -> Beams:
    """The beams at one pole; the other pole keeps its number and has none."""
    on, beside = beams.pole == pole, beams.passed_pole == pole
    return replace(
        beams,
        directions=beams.directions[on],
        ranges=beams.ranges[on],
        pole=beams.pole[on],
        half_width=beams.half_width[on],
        beside=beams.beside[on],
        passed_directions=beams.passed_directions[beside],
        passed_pole=beams.passed_pole[beside],
        passed_half_width=beams.passed_half_width[beside],
    )


@pytest.fixture(scope="module")
def expansion() -> Expansion:
    pair, beams = beams_with_surroundings()
    views = exact(np.log(np.full((2, 2), 0.008)))
    return expand(state_near(pair), views, beams, pair.poles[0].radius)


def weighed(unknowns: Unknowns) -> Array:
    groups = unknowns.groups()
    return prior_precision(groups, ErrorModel().sigmas(groups))


def test_errors_that_one_lidar_has_are_not_the_others(expansion: Expansion) -> None:
    layout = expansion.layout
    for lidar in (0, 1):
        other = [layout.device(1 - lidar), *(layout.rings(1 - lidar, kind) for kind in range(RING))]
        for part in other:
            moved = slice(POSE + part.start, POSE + part.stop)
            assert np.abs(expansion.information[lidar][moved]).max() == 0.0
            assert np.abs(expansion.gradient[lidar][moved]).max() == 0.0
    # The target's returns know nothing of the pose.
    assert np.abs(expansion.information[0][:POSE]).max() == 0.0


def test_eliminating_the_axes_leaves_pose_and_errors_as_they_are(expansion: Expansion) -> None:
    """The minimum, and its curvature, are those of the whole problem with the axes in it."""
    factor = pole_factor(expansion)
    unknowns, axes = factor.unknowns, POSE + expansion.layout.size
    place = np.r_[unknowns.pose(1), unknowns.of_layout(expansion.layout, (0, 1))]
    precision = weighed(unknowns)
    whole = expansion.information[0] + expansion.information[1]
    gradient = expansion.gradient[0] + expansion.gradient[1]
    index = np.arange(POSE, axes)
    own = precision[place[POSE:] - unknowns.poses]
    whole[index, index] += own
    gradient[index] -= own * expansion.errors
    inverse = np.linalg.inv(whole)
    step = (inverse @ gradient)[:axes] + np.r_[np.zeros(POSE), expansion.errors]
    found = solve_factor(factor, precision)
    scale = np.sqrt(np.diag(inverse)[:axes])
    values = np.r_[found.steps, found.errors][place]
    np.testing.assert_allclose(values / scale, step / scale, atol=1e-6)
    np.testing.assert_allclose(
        found.inverse[np.ix_(place, place)] / np.outer(scale, scale),
        inverse[:axes, :axes] / np.outer(scale, scale),
        atol=1e-6,
    )
    # The target is the frame.
    assert not found.inverse[unknowns.pose(0)].any()


def test_with_more_bands_nothing_changes(expansion: Expansion) -> None:
    factor = pole_factor(expansion)
    wider = factor.with_bands([np.array([-40, -2, 30]), np.array([-3, 50])])
    assert wider.unknowns.kept > factor.unknowns.kept
    alone = solve_factor(factor, weighed(factor.unknowns))
    among = solve_factor(wider, weighed(wider.unknowns))
    place = factor.unknowns.places_in(wider.unknowns)
    errors, poses = place[factor.unknowns.poses :] - wider.unknowns.poses, wider.unknowns.poses
    assert wider.redundancy == factor.redundancy
    np.testing.assert_allclose(among.steps, alone.steps, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(among.errors[errors], alone.errors, rtol=1e-6)
    np.testing.assert_allclose(among.inverse[np.ix_(place, place)], alone.inverse, rtol=1e-6)
    # The bands that the poles have no returns in keep their prior.
    new = np.setdiff1d(np.arange(wider.unknowns.errors), errors)
    assert len(new) > 0
    np.testing.assert_allclose(among.errors[new], 0.0, atol=1e-15)
    np.testing.assert_allclose(
        np.diag(among.inverse)[poses + new], 1 / weighed(wider.unknowns)[new]
    )


def test_about_other_poses_the_answer_is_the_same(expansion: Expansion) -> None:
    """To first order: their steps are counted from there."""
    factor = pole_factor(expansion)
    precision = weighed(factor.unknowns)
    found = solve_factor(factor, precision)
    step = 1e-4 * np.arange(1.0, 7.0)
    other = factor.T.copy()
    other[1] = se3.retract(factor.T[1], step)
    again = solve_factor(factor.about(other), precision)
    pose, pose_again = (
        se3.retract(T[1], each.steps[POSE:]) for T, each in ((factor.T, found), (other, again))
    )
    sigma = np.sqrt(np.diag(found.inverse)[POSE : 2 * POSE])
    assert np.abs(se3.local(pose, pose_again) / sigma).max() < 1e-3
    np.testing.assert_allclose(again.errors, found.errors, rtol=1e-3, atol=1e-9)


def test_the_offsets_and_the_radius_that_a_state_has_count_from_zero() -> None:
    """Errors are told from what was given, wherever the expansion was made."""
    pair = paper(3)
    state = state_near(pair)
    found = expand(state, exact(np.log(np.full((2, 2), 0.006))), beams_at(pair), 0.017)
    np.testing.assert_allclose(found.errors[[TAPE, DEVICE + TAPE]], state.offsets)
    assert found.errors[RADIUS] == pytest.approx(state.radius - 0.017)
    assert np.count_nonzero(found.errors) == 3
    # Errors that are known to be what the state has them move nothing else: Λ here is the whole.
    factor = pole_factor(found)
    unknowns = factor.unknowns
    errors = np.zeros(unknowns.kept)
    errors[unknowns.of_layout(found.layout, (0, 1))] = found.errors
    known = factor.information @ errors
    other = pole_factor(replace(found, errors=np.zeros_like(found.errors)))
    np.testing.assert_allclose(factor.vector - known, other.vector, rtol=1e-6, atol=1e-3)


def test_a_given_covariance_says_nothing_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 6)) * 0.01
    covariance = half @ half.T + 1e-6 * np.eye(6)
    pose = PoseEstimate(se3.random(rng), covariance, 0.0)
    factor = gaussian_factor(pose)
    assert factor.redundancy == MANY
    precision, poses = weighed(factor.unknowns), factor.unknowns.poses
    found = solve_factor(factor, precision)
    np.testing.assert_allclose(found.steps, 0.0)
    np.testing.assert_allclose(found.errors, 0.0)
    np.testing.assert_allclose(found.inverse[POSE:poses, POSE:poses], covariance, rtol=1e-6)
    np.testing.assert_allclose(found.inverse[poses:, :poses], 0.0, atol=1e-15)
    np.testing.assert_allclose(np.diag(found.inverse)[poses:], 1 / precision)


def axes_of(pair: SimulatedPair, beams: tuple[Beams, Beams], start: Array) -> AxesTest:
    """The test of LiDARs that have no systematic errors."""
    known = (NO_ERRORS, NO_ERRORS)
    # Many small matrices: the threads of BLAS would only get in the way.
    with threadpool_limits(1, user_api="blas"):
        return align_beams(*beams, start, radius=pair.poles[0].radius, sizes=known).axes_test


@pytest.mark.slow
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


@pytest.mark.parametrize("seed", SKEW)
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
