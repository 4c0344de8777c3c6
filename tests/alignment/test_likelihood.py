"""Beams at cylinders: closed forms against brute force, derivatives against finite differences."""

import numpy as np
import pytest

from retropole.alignment.likelihood import (
    ArcLikelihood,
    arc_likelihood,
    closest_approach,
    passed_beam_likelihood,
)
from retropole.base.datatypes import Array

RADIUS, SIGMA_DEPTH, SIGMA_MISS = 0.02, 0.006, 0.003


def unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def some_beams(rng: np.random.Generator, count: int = 40) -> tuple[Array, Array, Array, Array]:
    directions = unit(np.array([1.0, 0, 0]) + 0.2 * rng.normal(size=(count, 3)))
    point, axis = np.array([4.0, 0.3, 0.2]), unit(rng.normal(size=3) + np.array([0, 0, 2.0]))
    return rng.normal(size=3), directions, point, axis


def test_the_closest_approach_is_the_closest() -> None:
    rng = np.random.default_rng(0)
    origin, directions, point, axis = some_beams(rng)
    by = closest_approach(origin, directions, point, axis)
    for k in range(len(directions)):
        steps = by.ranges[k] + np.linspace(-0.5, 0.5, 1001)
        at = origin + steps[:, None] * directions[k] - point
        gaps = np.linalg.norm(at - (at @ axis)[:, None] * axis, axis=1)
        assert np.argmin(gaps) == 500
        assert gaps.min() == pytest.approx(abs(by.lateral_offset[k]), abs=1e-9)
        assert by.sine[k] == pytest.approx(np.linalg.norm(np.cross(directions[k], axis)))


def test_derivatives_of_the_closest_approach() -> None:
    rng = np.random.default_rng(1)
    origin, directions, point, axis = some_beams(rng)
    by, h = closest_approach(origin, directions, point, axis), 1e-6
    for k in range(6):
        step = np.zeros(6)
        step[k] = h
        plus = closest_approach(origin, directions, point + step[:3], axis + step[3:])
        minus = closest_approach(origin, directions, point - step[:3], axis - step[3:])
        for name in ("ranges", "lateral_offset", "sine"):
            if name == "sine" and k >= 3:
                continue  # free directions change it by cos, which callers project away
            derivative = (getattr(plus, name) - getattr(minus, name)) / (2 * h)
            if k < 3:
                given = getattr(by, f"{name}_by_axis")[:, k]
                np.testing.assert_allclose(
                    given, derivative, atol=2e-5 * (1 + np.abs(derivative).max())
                )


def test_derivatives_of_the_closest_approach_by_the_direction_across_it() -> None:
    rng = np.random.default_rng(2)
    origin, directions, point, axis = some_beams(rng)
    by, h = closest_approach(origin, directions, point, axis), 1e-6
    for tangent in np.linalg.svd(axis[None])[2][1:]:
        plus = closest_approach(origin, directions, point, unit(axis + h * tangent))
        minus = closest_approach(origin, directions, point, unit(axis - h * tangent))
        for name in ("ranges", "lateral_offset", "sine"):
            derivative = (getattr(plus, name) - getattr(minus, name)) / (2 * h)
            given = getattr(by, f"{name}_by_axis")[:, 3:] @ tangent
            np.testing.assert_allclose(
                given, derivative, atol=2e-5 * (1 + np.abs(derivative).max())
            )


def returns(rng: np.random.Generator, width: float, count: int = 200) -> Array:
    """Depth, miss and radius (N, 3) of noisy returns."""
    x = rng.uniform(-RADIUS - width, RADIUS + width, count)
    depth = np.sqrt(np.maximum(RADIUS**2 - x**2, 0)) + SIGMA_DEPTH * rng.normal(size=count)
    return np.stack([depth, x + SIGMA_MISS * rng.normal(size=count), np.full(count, RADIUS)], 1)


@pytest.mark.parametrize("passed_share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("width", [0.0, 0.008])
def test_arc_derivatives(width: float, passed_share: float) -> None:
    values = returns(np.random.default_rng(3), width)

    def at(v: Array) -> ArcLikelihood:
        ones = np.ones(len(v))
        return arc_likelihood(
            v[:, 0],
            v[:, 1],
            SIGMA_DEPTH * ones,
            SIGMA_MISS * ones,
            float(v[0, 2]),
            width,
            passed_share,
        )

    # The integral is cut where it does not count, except for returns far off the pole.
    values = values[at(values).inlier > 0.9999]

    here, h = at(values), 1e-6
    for k in range(3):
        step = np.zeros(3)
        step[k] = h
        plus, minus = at(values + step), at(values - step)
        derivative = (plus.log - minus.log) / (2 * h)
        derivative_of_score = -(plus.score - minus.score) / (2 * h)
        given, curvature = here.score[:, k], here.information[:, k]
        # Where the cut comes to the end of the arc a step goes over a slight kink.
        assert np.quantile(np.abs(given - derivative), 0.98) < 1e-3 * np.abs(derivative).max()
        assert (
            np.quantile(np.abs(curvature - derivative_of_score), 0.98)
            < 1e-3 * np.abs(derivative_of_score).max()
        )


@pytest.mark.parametrize("width", [0.0, 0.008])
def test_arc_density_adds_up_to_its_share(width: float) -> None:
    depth, miss = np.meshgrid(np.linspace(-0.05, 0.07, 241), np.linspace(-0.06, 0.06, 241))
    ones = np.ones(depth.size)
    arc = arc_likelihood(
        depth.ravel(), miss.ravel(), SIGMA_DEPTH * ones, SIGMA_MISS * ones, RADIUS, width
    )
    pole = np.exp(arc.log) * arc.inlier
    assert pole.sum() * (0.12 / 240) ** 2 == pytest.approx(0.98, abs=0.01)


def test_without_noise_sideways_it_is_the_range_that_counts() -> None:
    miss, ones = np.array([0.0, 0.008, -0.012]), np.ones(3)
    shift = np.array([0.004, -0.003, 0.002])
    facing = np.sqrt(RADIUS**2 - miss**2)
    logs = [
        arc_likelihood(facing + s, miss, SIGMA_DEPTH * ones, 1e-4 * ones, RADIUS).log
        for s in (0.0, shift)
    ]
    expected = -0.5 * (shift / SIGMA_DEPTH) ** 2
    np.testing.assert_allclose(logs[1] - logs[0], expected, atol=0.02)


def test_pass_derivatives_and_limits() -> None:
    rng = np.random.default_rng(4)
    miss, sigma, h = rng.uniform(-0.06, 0.06, 100), np.full(100, SIGMA_MISS), 1e-6
    here = passed_beam_likelihood(miss, sigma, RADIUS, 0.004)
    for k, (dm, dr) in enumerate(((h, 0.0), (0.0, h))):
        plus = passed_beam_likelihood(miss + dm, sigma, RADIUS + dr, 0.004)
        minus = passed_beam_likelihood(miss - dm, sigma, RADIUS - dr, 0.004)
        np.testing.assert_allclose(here.score[:, k], (plus.log - minus.log) / (2 * h), atol=1e-3)
        derivative_of_score = -(plus.score - minus.score) / (2 * h)
        np.testing.assert_allclose(here.information[:, k], derivative_of_score, atol=1.0)
    far, on = passed_beam_likelihood(np.array([0.06, 0.0]), sigma[:2], RADIUS).log
    assert far == pytest.approx(0.0, abs=1e-6)
    assert on == pytest.approx(np.log(0.05), abs=1e-3)


def bias_of_radius(noise: float, passed_share: float, *, passed: bool) -> float:
    """Step to the radius that beams 0.02 mm apart have, with that noise sideways; metres."""
    rng, width = np.random.default_rng(5), 0.008
    x = np.arange(-0.06, 0.06, 2e-5)
    m = x + noise * rng.normal(size=len(x))
    on, ones = np.abs(x) < RADIUS + width, np.ones(len(x))
    depth = np.sqrt(np.maximum(RADIUS**2 - x**2, 0)) + SIGMA_DEPTH * rng.normal(size=len(x))
    arc = arc_likelihood(
        depth[on], m[on], SIGMA_DEPTH * ones[on], SIGMA_MISS * ones[on], RADIUS, width, passed_share
    )
    free = passed_beam_likelihood(m[~on], SIGMA_MISS * ones[~on], RADIUS, width)
    score = arc.score[:, 2].sum() + passed * free.score[:, 1].sum()
    information = arc.information[:, 2, 2].sum() + passed * free.information[:, 1, 1].sum()
    return float(score / information)


@pytest.mark.parametrize("noise", [0.0, SIGMA_MISS])
def test_returns_and_beams_next_to_them_have_the_radius_right_together(noise: float) -> None:
    """To 0.3 mm, also where there is less noise than is assumed."""
    assert abs(bias_of_radius(noise, 1.0, passed=True)) < 3e-4
    # Shared out over the pole as if nothing were known beside it, it would be too slim; and too
    # thick if the beams beside it had no say.
    assert bias_of_radius(noise, 0.0, passed=True) < -4e-4
    assert bias_of_radius(noise, 1.0, passed=False) > 4e-4


def test_returns_alone_have_the_radius_right() -> None:
    assert abs(bias_of_radius(SIGMA_MISS, 0.0, passed=False)) < 3e-4
