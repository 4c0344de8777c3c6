"""Ray casting against the definitions of the surfaces."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import Cylinder, Rectangle, Surface
from retropole.simulation.raycast import cast
from tests.simulation.surfaces import (
    DIFFUSE,
    KINDS,
    distance_from,
    draw_rays,
    draw_surface,
    transformed,
)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5))
def test_rays_end_on_the_surface_and_nowhere_before(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface = draw_surface(kind, rng)
    rays, origin = draw_rays(rng, 4000, 0.4), rng.uniform(-0.5, 0.5, 3)
    hits = cast(origin, rays, [surface])
    hit = np.isfinite(hits.ranges)
    assert 50 < hit.sum() < 3950
    np.testing.assert_array_equal(hits.surface, np.where(hit, 0, -1))
    points = origin + hits.ranges[hit, None] * rays[hit]
    assert distance_from(surface, points).max() < 1e-9
    # March along the rays: none without a hit comes near, none hits before its range.
    steps = np.linspace(0.05, 12.0, 1500)
    for row in rng.permutation(len(rays))[:60]:
        path = origin + steps[:, None] * rays[row]
        near = distance_from(surface, path)
        before = steps < hits.ranges[row] - 0.02
        if isinstance(surface, Cylinder):
            # Open at its ends: the march sees the far wall through them, the ray caster does not.
            inside = np.linalg.norm(np.cross(path - surface.centre, surface.axis), axis=1)
            before &= inside > surface.radius
        assert near[before].min(initial=1.0) > 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_casting_does_not_depend_on_the_frame(kind: str) -> None:
    rng = np.random.default_rng(7)
    surface, T = draw_surface(kind, rng), se3.random(rng)
    rays = draw_rays(rng, 2000, 0.6)
    here = cast(np.zeros(3), rays, [surface])
    there = cast(T[:3, 3], rays @ T[:3, :3].T, [transformed(surface, T)])
    np.testing.assert_allclose(there.ranges, here.ranges, atol=1e-9)
    np.testing.assert_allclose(there.cosine, here.cosine, atol=1e-9)


def test_the_nearest_surface_wins() -> None:
    walls: list[Surface] = [
        Rectangle(np.array([x, 0.0, 0.0]), np.eye(3)[1], np.eye(3)[2], (9.0, 9.0), DIFFUSE)
        for x in (5.0, 3.0, 4.0)
    ]
    hits = cast(np.zeros(3), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), walls)
    assert hits.surface.tolist() == [1, -1]
    assert hits.ranges.tolist() == [3.0, np.inf]


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_the_surfaces_does_not_matter(kind: str) -> None:
    rng = np.random.default_rng(3)
    surfaces = [draw_surface(kind, rng) for _ in range(4)]
    rays = draw_rays(rng, 1000, 0.4)
    forward = cast(np.zeros(3), rays, surfaces)
    backward = cast(np.zeros(3), rays, surfaces[::-1])
    np.testing.assert_array_equal(forward.ranges, backward.ranges)
    hit = forward.surface >= 0
    np.testing.assert_array_equal(forward.surface[hit], 3 - backward.surface[hit])


@pytest.mark.parametrize("divergence", [0.001, 0.003, 0.01])
def test_a_beam_hits_a_pole_where_its_edge_does(divergence: float) -> None:
    distance, radius = 10.0, 0.02
    pole = Cylinder(np.array([distance, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), radius, 2.0, DIFFUSE)
    azimuth = np.linspace(-0.02, 0.02, 4001)
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    hit = np.isfinite(cast(np.zeros(3), rays, [pole], divergence).ranges)
    assert hit.sum() == (np.abs(azimuth) <= azimuth[hit].max()).sum(), "one interval, centred"
    assert azimuth[hit].max() == pytest.approx(radius / distance + divergence / 2, abs=2e-5)
