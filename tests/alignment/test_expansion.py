"""What a LiDAR's returns say to second order: its derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.expansion import exact_view, expand_lidar
from retropole.alignment.likelihood import arc_likelihood, passed_beam_likelihood
from retropole.alignment.observations import Beams
from retropole.alignment.posterior import State, beam_geometry
from retropole.alignment.unknowns import POSE
from retropole.base.datatypes import Array
from retropole.base.systematic import (
    RADIUS,
    RING,
    WIDTH,
    Layout,
    band_of,
)
from tests.alignment.beams import beams_at, beams_with_surroundings, paper, state_near
from tests.numeric import numeric_jacobian
from tests.tiers import first_of


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
            _, gradient, _ = expand_lidar(state, lidar, one[lidar], view, layout)
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
