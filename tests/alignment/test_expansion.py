"""What a LiDAR's returns say to second order: its derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.expansion import (
    View,
    average_lidar,
    average_passed,
    average_returns,
    exact_view,
    expand_lidar,
    find_view,
)
from retropole.alignment.likelihood import arc_likelihood, passed_beam_likelihood
from retropole.alignment.observations import Beams
from retropole.alignment.posterior import SHARED, State, beam_geometry, lidar_geometry
from retropole.alignment.unknowns import POSE
from retropole.base.datatypes import Array
from retropole.base.systematic import RADIUS, RING, WIDTH, Layout, band_of
from tests.alignment.beams import beams_at, beams_with_surroundings, paper, state_near
from tests.numeric import numeric_jacobian
from tests.tiers import first_of


def bent(azimuth: Array, b: Array) -> Array:
    """How far scan lines are bent up, of periods 180° and 120° and as a whole."""
    c2, s2, c3, s3, of_all = b
    return np.asarray(
        of_all
        + c2 * np.cos(2 * azimuth)
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
        seen.depth,
        seen.lateral_offset,
        sigma,
        lateral,
        radius,
        beams.half_width,
        beams.passed_share,
    )
    far = np.zeros(len(beams.passed_pole))
    directions, _ = corrected(beams.passed_directions, far, b, lidar, layout)
    passed_share = beam_geometry(state, lidar, beams.origin, directions, far, beams.passed_pole)
    free = passed_beam_likelihood(
        passed_share.lateral_offset, np.full_like(far, 0.003), radius, beams.passed_half_width
    )
    return np.array(arc.log.sum() + free.log.sum())


@pytest.mark.parametrize("surroundings", first_of([False, True]))
@pytest.mark.full
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
            bands = [np.unique(band_of(each.directions, each.axis)) for each in one]
            layout = Layout((bands[0], bands[1]))
            view = exact_view(2, np.exp(log_noise[lidar]))
            averages = average_lidar(state, lidar, one[lidar], view)
            _, gradient, _ = expand_lidar(state, lidar, one[lidar], averages, layout)
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

            slope = numeric_jacobian(log_at, len(gradient), 1e-7)
            # Each kind of parameter against its own size: they differ by far.
            for part in parts_of(layout, lidar):
                largest = np.abs(slope[part]).max()
                np.testing.assert_allclose(gradient[part], slope[part], atol=3e-3 * largest)


def parts_of(layout: Layout, lidar: int) -> list[slice]:
    """Rotation, translation, the errors of one LiDAR, its width, the radius, and the axes."""
    first = layout.device(lidar).start
    errors = [slice(first, first + WIDTH), slice(first + WIDTH, first + WIDTH + 1)]
    errors += [layout.rings(lidar, 0), layout.rings(lidar, 1), slice(RADIUS, RADIUS + 1)]
    moved = [slice(POSE + part.start, POSE + part.stop) for part in errors]
    return [slice(0, 3), slice(3, 6), *moved, slice(POSE + layout.size, None)]


def only(beams: Beams, pole: int) -> Beams:
    """The beams at one pole; the other pole keeps its number and has none."""
    on, passed_share = beams.pole == pole, beams.passed_pole == pole
    return replace(
        beams,
        directions=beams.directions[on],
        ranges=beams.ranges[on],
        pole=beams.pole[on],
        half_width=beams.half_width[on],
        passed_share=beams.passed_share[on],
        passed_directions=beams.passed_directions[passed_share],
        passed_pole=beams.passed_pole[passed_share],
        passed_half_width=beams.passed_half_width[passed_share],
    )


THICK, NOISE = 0.02, np.array([0.015, 0.003])
STATE = State(
    np.eye(4), np.zeros(2), THICK, np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
)


def beams_at_pole(rng: np.random.Generator, rings: int, step: float, width: float) -> Beams:
    """Beams of full angle `width` that meet a pole 6 m away, or pass it; rings are 1.6° apart."""
    on, passed_share = [], []
    for ring in range(rings):
        elevation = np.radians(1.6) * (ring - (rings - 1) / 2)
        for azimuth in np.arange(-0.03, 0.03, step) + step * rng.uniform():
            flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
            ray = np.r_[flat, np.sin(elevation)]
            m = abs(6.0 * np.sin(azimuth))
            if m < THICK + 0.5 * width * 6.0 / np.cos(elevation):
                depth = 6.0 * np.cos(azimuth) - np.sqrt(max(THICK**2 - m**2, 0.0))
                on.append(np.r_[ray, depth / np.cos(elevation) + NOISE[0] * rng.normal()])
            elif m < THICK + 0.5 * width * 6.0 + 0.02:
                passed_share.append(ray)
    rows, rays = np.array(on), np.array(passed_share).reshape(-1, 3)
    return Beams(
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        rows[:, :3],
        rows[:, 3],
        np.zeros(len(rows), dtype=np.int64),
        0.5 * width * rows[:, 3],
        np.ones(len(rows)),
        rays,
        np.zeros(len(rays), dtype=np.int64),
        np.full(len(rays), 0.5 * width * 6.0),
    )


def test_an_exact_view_is_the_likelihood_at_the_state() -> None:
    beams = beams_at_pole(np.random.default_rng(0), 8, 0.01, 0.008)
    seen, _ = lidar_geometry(STATE, 0, beams)
    found = average_returns(seen, beams, THICK, exact_view(1, NOISE))
    sigma = np.hypot(NOISE[0] * seen.sine, NOISE[1] * np.sqrt(1 - seen.sine**2))
    lateral = np.full_like(sigma, NOISE[1])
    arc = arc_likelihood(
        seen.depth, seen.lateral_offset, sigma, lateral, THICK, beams.half_width, beams.passed_share
    )
    for one, other in (
        (found.score, arc.score),
        (found.information, arc.information),
        (found.inlier, arc.inlier),
        (found.noise, arc.noise),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def own_information(beams: Beams, view: View) -> Array:
    """Information (4, 4) of the axis that averages over a view have."""
    total = np.zeros((4, 4))
    for seen, average, rows in zip(
        lidar_geometry(STATE, 0, beams),
        (average_returns, average_passed),
        (slice(0, 2), slice(1, 2)),
        strict=True,
    ):
        J = seen.jacobian[:, rows, -4:]
        count = J.shape[1]
        of_each = average(seen, beams, THICK, view).information[:, :count, :count]
        total += np.einsum("nci,nce,nej->ij", J, of_each, J)
    return total


def test_a_view_is_its_own_average() -> None:
    for seed in range(5):
        beams = beams_at_pole(np.random.default_rng(seed), 12, 0.008, 0.008)
        view = find_view(STATE, 0, beams, NOISE)
        product = view.covariance[0] @ own_information(beams, view)
        np.testing.assert_allclose(np.trace(product) / 4, 1.0, atol=0.1)


def test_many_returns_leave_a_parabola() -> None:
    """Where little is left open, averaging changes nothing."""
    beams = beams_at_pole(np.random.default_rng(1), 20, 0.0003, 0.003)
    assert len(beams.pole) > 500
    view = find_view(STATE, 0, beams, NOISE)
    at_one_place = replace(view, covariance=0.0 * view.covariance)
    a, b = (own_information(beams, each) for each in (view, at_one_place))
    np.testing.assert_allclose(np.diag(a), np.diag(b), rtol=0.1)
    assert np.sqrt(np.diag(view.covariance[0])).max() < 0.005


@pytest.mark.full
def test_what_few_returns_of_wide_beams_leave_open_is_neither_too_little_nor_too_much() -> None:
    """χ² of the true axis, 4 degrees of freedom, over pencils of beams of 8 mrad 10 mrad apart."""
    squares = []
    for seed in range(50):
        beams = beams_at_pole(np.random.default_rng(seed), 9, 0.01, 0.008)
        state, way = STATE, np.zeros(4)
        # A view goes no further than two of its own σ from where it starts.
        for _ in range(3):
            view = find_view(state, 0, beams, NOISE)
            way = way + view.shift[0]
            state = STATE.moved(np.r_[np.zeros(SHARED), way])
        squares.append(float(way @ np.linalg.solve(view.covariance[0], way)))
    assert 2.6 < np.mean(squares) < 5.6
    assert np.mean(np.array(squares) < 9.488) > 0.86
