"""An answer about the beam origins, moved back: the same motion of the same points."""

import numpy as np
import pytest

from retropole.alignment.origins import BeamOrigins, beam_origins
from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair
from tests.numeric import numeric_jacobian

pytestmark = pytest.mark.full

ORIGINS = BeamOrigins(np.array([200.0, -30.0, 4.0]), np.array([-70.0, 500.0, 2.0]))


def calibrated(*by: Array) -> Calibration:
    rng = np.random.default_rng(4)
    pair = simulate_pair("corridor", rng, sensor_target="VLP-16", sensor_source="VLP-16")
    shifts = [se3.from_rt(np.eye(3), each) for each in by]
    return calibrate(pair.target.transformed(shifts[0]), pair.source.transformed(shifts[1]))


def test_covariance_and_information_follow_the_pose() -> None:
    """By the derivative of the step in the far frames with respect to that in the near ones."""
    near = calibrated(np.zeros(3), np.zeros(3))
    far = ORIGINS.moved_back(near)
    assert near.T_target_source is not None
    assert near.covariance is not None
    assert far.T_target_source is not None
    assert far.covariance is not None
    T_near, T_far = near.T_target_source, far.T_target_source
    A, B = (se3.from_rt(np.eye(3), each) for each in (ORIGINS.target, ORIGINS.source))
    np.testing.assert_allclose(T_far, A @ T_near @ se3.inverse(B), atol=1e-9)
    J = numeric_jacobian(
        lambda step: se3.local(T_far, A @ se3.retract(T_near, step) @ se3.inverse(B)), 6
    )
    np.testing.assert_allclose(far.covariance, J @ near.covariance @ J.T, rtol=1e-6, atol=1e-12)
    assert far.uncertainty is not None
    np.testing.assert_allclose(far.uncertainty.covariance, far.covariance, rtol=1e-12)
    for one, other in zip(near.hypotheses, far.hypotheses, strict=True):
        T = one.match.T_target_source
        T_moved = other.match.T_target_source

        def moved(step: Array, T: Array = T, T_moved: Array = T_moved) -> Array:
            return se3.local(T_moved, A @ se3.retract(T, step) @ se3.inverse(B))

        J = numeric_jacobian(moved, 6)
        np.testing.assert_allclose(
            J.T @ other.match.information @ J,
            one.match.information,
            rtol=1e-5,
            atol=1e-5 * np.abs(one.match.information).max(),
        )


def test_the_poles_lie_where_the_clouds_have_them() -> None:
    far = calibrated(ORIGINS.target, ORIGINS.source)
    for scan in (far.placements[0].target, far.placements[0].source):
        assert scan.detection is not None
        for pole in scan.poles:
            np.testing.assert_allclose(pole.xyz, scan.cloud.xyz[pole.index], atol=1e-9)
        for each in scan.detection.rejected:
            np.testing.assert_allclose(
                each.centre, scan.cloud.xyz[each.index].mean(axis=0), atol=1e-6
            )
    assert np.linalg.norm(far.placements[0].target.cloud.origin - ORIGINS.target) < 1e-6


def test_an_offset_of_kilometres_changes_nothing_but_the_frame() -> None:
    near = calibrated(np.zeros(3), np.zeros(3))
    by = np.array([6000.0, -3000.0, 50.0])
    far = calibrated(by, by)
    assert (near.status, far.status) == ("ok", "ok")
    assert near.T_target_source is not None
    assert far.T_target_source is not None
    shift = se3.from_rt(np.eye(3), by)
    back = se3.inverse(shift) @ far.T_target_source @ shift
    apart = se3.difference(near.T_target_source, back)
    assert apart.rotation < np.radians(0.02)
    assert apart.translation < 0.002
    sigmas = np.array([[e.sigma_m for e in each.predicted_error] for each in (near, far)])
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.3)


def test_clouds_about_their_beams_stay_as_they_are() -> None:
    near = calibrated(np.zeros(3), np.zeros(3))
    at_home = beam_origins(near.placements)
    assert at_home.moved_back(near) is near
    assert at_home.about(near.placements)[0] is near.placements[0]


def test_a_refused_answer_moves_back_too() -> None:
    rng = np.random.default_rng(4)
    pair = simulate_pair("corridor", rng, sensor_target="VLP-16", sensor_source="VLP-16")
    away = pair.target.transformed(se3.from_rt(np.eye(3), ORIGINS.target))
    refused = calibrate(away, PointCloud(pair.source.xyz))
    assert refused.reasons[0].code == "no_intensity"
    there = refused.placements[0].target
    np.testing.assert_allclose(there.cloud.xyz, away.xyz, atol=1e-9)
    assert there.poles
