"""Systematic errors: their order, their groups, their sizes, and what they do to a return."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import SENSORS
from retropole.base.systematic import (
    BAND,
    DEVICE,
    ENOUGH,
    LEVER,
    MAX_TANGENT,
    MIN_ZERO,
    RADIUS,
    RANGE_TO_OFFSET,
    RING,
    SHARED_ERRORS,
    SPINNING_BEND,
    STATED_WIDTH,
    Layout,
    Sizes,
    Sway,
    band_of,
    by_error,
    remaining_sway,
    sizes_of,
    spinning,
    stated_sway,
)
from tests.numeric import numeric_jacobian

SMALL = Layout((np.array([-3, 1]), np.array([4])))
OTHER = Layout((np.array([-5, 1, 2]), np.array([3, 6])))


def test_every_error_has_a_place_of_its_own() -> None:
    parts = [OTHER.device(0), OTHER.device(1), slice(RADIUS, RADIUS + 1)]
    parts += [OTHER.rings(lidar, kind) for lidar in (0, 1) for kind in range(RING)]
    places = np.concatenate([np.arange(OTHER.size)[part] for part in parts])
    np.testing.assert_array_equal(np.sort(places), np.arange(OTHER.size))


def test_sizes_follow_the_manufacturer() -> None:
    assert sizes_of(None) == Sizes()
    for sensor in SENSORS.values():
        sizes = sizes_of(sensor)
        assert sizes.width == sensor.errors.get("width", STATED_WIDTH) <= Sizes().width
        assert sizes.zero >= MIN_ZERO
        turns = sensor.pattern == "spinning" and sensor.sees_all_around
        usual = spinning(Sizes()) if turns else Sizes()
        assert sizes.bend == (SPINNING_BEND if turns else Sizes().bend)
        if sensor.range_accuracy is None:
            assert sizes == replace(usual, width=sizes.width)
        else:
            stated = sensor.range_accuracy / RANGE_TO_OFFSET
            assert sizes.zero == pytest.approx(max(stated, MIN_ZERO))
    assert sizes_of(SENSORS["OS1"]).tape > 3 * sizes_of(SENSORS["VLP-16"]).tape


UP = np.array([0.0, 0.0, 1.0])


def test_bands_are_one_degree_of_elevation() -> None:
    elevation = np.radians([-15.0, -0.2, 0.0, 0.99, 1.01, 90.0])
    azimuth = np.linspace(0.0, 6.0, 6)
    assert np.degrees(BAND) == pytest.approx(1.0)
    np.testing.assert_array_equal(
        band_of(ray(azimuth, elevation + 1e-9), UP), [-15, -1, 0, 0, 1, 90]
    )


def ray(azimuth: Array, elevation: Array) -> Array:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)


@pytest.mark.parametrize("tape", [False, True])
def test_derivative_by_the_errors(tape: bool) -> None:
    """The true return is where the formulas at the head of `systematic` put it."""
    rng = np.random.default_rng(0)
    n = 40
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.5, 0.5, n)
    ranges, tangent = rng.uniform(1.0, 60.0, n), rng.uniform(0.0, 2 * MAX_TANGENT, n)

    def true_return(b: Array) -> Array:
        # The width of the beam moves no return.
        zero, scale, slant, encoder_c, encoder_s, wobble_c, wobble_s = b[:7]
        c2, s2, c3, s3, of_all, on_tape, _ = b[7:DEVICE]
        ring_range, ring_elevation, ring_azimuth = b[DEVICE:]
        rho = ranges - zero - scale * ranges - slant * ranges * np.minimum(tangent, MAX_TANGENT)
        rho = rho - (on_tape if tape else 0.0) - ring_range
        turned = azimuth + encoder_c * np.cos(azimuth) + encoder_s * np.sin(azimuth)
        turned = turned + ring_azimuth
        raised = elevation + wobble_c * np.cos(azimuth) + wobble_s * np.sin(azimuth)
        raised += c2 * np.cos(2 * azimuth) + s2 * np.sin(2 * azimuth)
        raised += c3 * np.cos(3 * azimuth) + s3 * np.sin(3 * azimuth)
        raised += of_all
        return np.asarray(rho[:, None] * ray(turned, raised + ring_elevation))

    def along(direction: Array) -> Array:
        return ranges[:, None] * direction

    rays = ray(azimuth, elevation)
    by_azimuth = along(np.stack([-rays[:, 1], rays[:, 0], 0 * azimuth], axis=1))
    by_elevation = along(
        np.stack(
            [
                -np.sin(elevation) * np.cos(azimuth),
                -np.sin(elevation) * np.sin(azimuth),
                np.cos(elevation),
            ],
            axis=1,
        )
    )
    device, ring = by_error(rays, by_azimuth, by_elevation, rays, UP, ranges, tangent, tape)
    found = np.concatenate([device, ring], axis=2)
    np.testing.assert_allclose(found, numeric_jacobian(true_return, DEVICE + RING), atol=1e-5)
    # Of a scalar of each return, such as a residual, the shape has one axis less.
    scalar = by_error(
        rays[:, 0], by_azimuth[:, 0], by_elevation[:, 0], rays, UP, ranges, tangent, tape
    )
    np.testing.assert_allclose(np.concatenate(scalar, axis=1), found[:, 0], atol=1e-12)


def test_no_constant_error_of_the_azimuth() -> None:
    """It would be a rotation of the LiDAR's own frame, which no scan can show."""
    assert SHARED_ERRORS == 2 * DEVICE + 1
    azimuth = np.linspace(-np.pi, np.pi, 361)[:-1]
    rays, one = ray(azimuth, 0 * azimuth), np.ones(360)
    device, ring = by_error(0 * one, one, 0 * one, rays, UP, one, one, tape=True)
    np.testing.assert_allclose(device.mean(axis=0), 0.0, atol=1e-12)
    # Single rings have one; what all have in common is small, and kept.
    np.testing.assert_allclose(ring[:, : RING - 1], 0.0)


def test_what_is_left_averages_over_the_recordings() -> None:
    one = stated_sway(0.001)
    assert remaining_sway([one]) == pytest.approx(np.asarray(one.covariance))
    assert remaining_sway([one, one]) == pytest.approx(np.asarray(one.covariance) / 2)
    # One that stood has nothing left, and half of the say.
    assert remaining_sway([one, None]) == pytest.approx(np.asarray(one.covariance) / 4)
    assert not remaining_sway([None]).any()


def test_a_stated_sway_is_no_less_than_that_of_a_mast_whichever_way_is_up() -> None:
    covariance = np.asarray(stated_sway(0.001).covariance)
    rng = np.random.default_rng(0)
    for scale, block in ((1.0, covariance[:3, :3]), (LEVER, covariance[3:, 3:])):
        for _ in range(5):
            R = se3.random(rng)[:3, :3]
            # About level axes, half of the variance each.
            mast = R @ np.diag([0.5, 0.5, 0.0]) @ R.T * (0.001 * scale) ** 2
            share = np.linalg.eigvals(np.linalg.solve(block, mast)).real
            assert share.max() == pytest.approx(1)


def test_words_say_how_much_longer_to_record() -> None:
    covariance = np.diag([1e-8] * 3 + [1e-6] * 3)
    short = Sway(0.0007, 0.5, 1.0, covariance)
    assert short.periods == pytest.approx(0.5)
    assert short.seconds_more == pytest.approx(ENOUGH / 0.5 - 1.0)
    assert short.text == (
        "± 0.04° at 0.5 Hz, 0.5 periods; its position at rest is known to ± 0.006°: record 3 s more"
    )
    assert "record" not in Sway(0.0007, 0.5, 10.0, covariance).text
    assert "as stated" in stated_sway(0.001).text
