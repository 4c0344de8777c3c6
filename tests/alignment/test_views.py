"""What one LiDAR's beams leave open of a pole's axis: a narrow view, a wide one, and its size."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.expansion import (
    View,
    average_passed,
    average_returns,
    exact_view,
    find_view,
)
from retropole.alignment.likelihood import arc_likelihood
from retropole.alignment.observations import Beams
from retropole.alignment.posterior import SHARED, State, own_geometry
from retropole.base.datatypes import Array

RADIUS, NOISE = 0.02, np.array([0.015, 0.003])
STATE = State(
    np.eye(4), np.zeros(2), RADIUS, np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
)


def beams_at_pole(rng: np.random.Generator, rings: int, step: float, width: float) -> Beams:
    """Beams of full angle `width` that meet a pole 6 m away, or pass it; rings are 1.6° apart."""
    on, beside = [], []
    for ring in range(rings):
        elevation = np.radians(1.6) * (ring - (rings - 1) / 2)
        for azimuth in np.arange(-0.03, 0.03, step) + step * rng.uniform():
            flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
            ray = np.r_[flat, np.sin(elevation)]
            m = abs(6.0 * np.sin(azimuth))
            if m < RADIUS + 0.5 * width * 6.0 / np.cos(elevation):
                depth = 6.0 * np.cos(azimuth) - np.sqrt(max(RADIUS**2 - m**2, 0.0))
                on.append(np.r_[ray, depth / np.cos(elevation) + NOISE[0] * rng.normal()])
            elif m < RADIUS + 0.5 * width * 6.0 + 0.02:
                beside.append(ray)
    rows, rays = np.array(on), np.array(beside).reshape(-1, 3)
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
    seen, _ = own_geometry(STATE, 0, beams)
    found = average_returns(seen, beams, RADIUS, exact_view(1, NOISE))
    sigma = np.hypot(NOISE[0] * seen.sine, NOISE[1] * np.sqrt(1 - seen.sine**2))
    lateral = np.full_like(sigma, NOISE[1])
    arc = arc_likelihood(
        seen.depth, seen.lateral_offset, sigma, lateral, RADIUS, beams.half_width, beams.beside
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
        own_geometry(STATE, 0, beams),
        (average_returns, average_passed),
        (slice(0, 2), slice(1, 2)),
        strict=True,
    ):
        J = seen.jacobian[:, rows, -4:]
        count = J.shape[1]
        of_each = average(seen, beams, RADIUS, view).information[:, :count, :count]
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
