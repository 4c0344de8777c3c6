"""Equations 3 and 4: the walk along the arc against the exact ray casting."""

import numpy as np
import pytest

from retropole.base import se3
from studies.paper.arc_walk import (
    arc_point,
    cast_cone,
    cast_plane,
    middle_beam,
    next_angle,
    rays_of,
    walk_arc,
)
from studies.paper.line_bias import PAPER_ORIENTATIONS

pytestmark = pytest.mark.full

STEP = np.radians(0.2)


def some_rotation(rng: np.random.Generator) -> se3.Array:
    """Turn a LiDAR by up to 40° about any axis: its beams still reach the pole."""
    axis = rng.normal(size=3)
    return se3.exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0, np.radians(40)))


def test_the_walk_is_the_casting_where_plane_and_cone_coincide() -> None:
    rng = np.random.default_rng(0)
    rotations = [np.eye(3), *(some_rotation(rng) for _ in range(20))]
    for rotation in rotations:
        distance, radius = rng.uniform(2, 10), rng.uniform(0.02, 0.3)
        middle = middle_beam(rotation, 0.0)
        assert middle is not None
        walked = walk_arc(distance, radius, middle, STEP)
        cone = cast_cone(distance, radius, rotation, 0.0, STEP)
        assert len(walked) == len(cone)
        assert np.abs(walked - cone).max() < 1e-9


@pytest.mark.parametrize("orientation", list(PAPER_ORIENTATIONS))
def test_the_walk_is_the_casting_of_its_own_plane(orientation: str) -> None:
    quaternion = PAPER_ORIENTATIONS[orientation]
    rotation = se3.from_quaternion_xyzw(quaternion, np.zeros(3))[:3, :3]
    for elevation in np.radians([-15.0, -3.0, 0.0, 7.0, 15.0]):
        middle = middle_beam(rotation, elevation)
        assert middle is not None
        walked = walk_arc(6.0, 0.2, middle, STEP)
        cast = cast_plane(6.0, 0.2, middle, STEP)
        assert len(walked) == len(cast)
        assert np.abs(walked - cast).max() < 1e-9


def test_neighbours_are_one_step_apart_over_the_whole_arc() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        distance, radius = rng.uniform(1, 10), rng.uniform(0.05, 0.5)
        middle = middle_beam(some_rotation(rng), rng.uniform(-0.25, 0.25))
        if middle is None:
            continue
        walked = walk_arc(distance, radius, middle, STEP)
        assert np.hypot(walked[:, 0], walked[:, 1]) == pytest.approx(radius, abs=1e-12)
        beams = walked - [distance, 0.0, 0.0]
        across = np.linalg.norm(np.cross(beams[:-1], beams[1:]), axis=1)
        angle = np.arctan2(across, np.sum(beams[:-1] * beams[1:], axis=1))
        assert angle == pytest.approx(STEP, abs=1e-12)
        theta = np.arctan2(walked[:, 1], walked[:, 0])
        assert np.all(np.diff(theta) > 0)
        end = np.arccos(radius / distance)
        assert np.all(np.abs(theta) <= end)
        # Not a step is left at either end.
        normal = np.cross(middle.ray, middle.sideways)
        for side, last in ((-1.0, beams[0]), (1.0, beams[-1])):
            edge = arc_point(np.array([side * end]), distance, radius, normal)[0]
            edge = edge - [distance, 0.0, 0.0]
            left = np.arctan2(np.linalg.norm(np.cross(last, edge)), last @ edge)
            assert left < STEP


def test_off_the_middle_the_plane_is_not_the_cone() -> None:
    elevation = np.radians(15.0)
    middle = middle_beam(np.eye(3), elevation)
    assert middle is not None
    walked = walk_arc(10.0, 0.1, middle, STEP)
    cone = cast_cone(10.0, 0.1, np.eye(3), elevation, STEP)
    apart = np.linalg.norm(walked - cone, axis=1)
    assert apart[2] < 1e-9, "they share the beam at θ = 0"
    assert 0.003 < apart.max() < 0.004
    # A step of azimuth is cos 15° of an angle in the plane.
    assert abs(walked[3, 1] / cone[3, 1]) == pytest.approx(1 / np.cos(elevation), rel=1e-3)


def test_the_middle_beam_belongs_to_its_ring_and_meets_the_axis() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        rotation, elevation = some_rotation(rng), rng.uniform(-0.26, 0.26)
        middle = middle_beam(rotation, elevation)
        assert middle is not None
        assert abs(middle.ray[1]) < 1e-12
        assert middle.ray[0] < 0
        assert np.arcsin((rotation.T @ middle.ray)[2]) == pytest.approx(elevation)
        ahead = rays_of(rotation, elevation, np.array([middle.azimuth + 1e-6]))[0]
        turned = (ahead - middle.ray) / (1e-6 * np.cos(elevation))
        assert turned == pytest.approx(middle.sideways, abs=1e-5)


def test_a_ring_that_does_not_reach_the_pole_has_no_points() -> None:
    # The ring turns in the plane x = 0.
    across = se3.exp_so3(np.array([0.0, 0.5 * np.pi, 0.0]))
    assert middle_beam(across, 0.2) is None
    assert cast_cone(5.0, 0.1, across, 0.2, STEP).shape == (0, 3)


def test_the_walk_refuses_an_upright_plane_and_ends_at_the_edge() -> None:
    upright = se3.exp_so3(np.array([0.5 * np.pi, 0.0, 0.0]))
    middle = middle_beam(upright, 0.0)
    assert middle is not None
    with pytest.raises(ValueError, match="upright"):
        walk_arc(5.0, 0.1, middle, STEP)
    level = np.array([0.0, 0.0, 1.0])
    end = np.arccos(0.1 / 5.0)
    assert next_angle(end - 1e-6, 1.0, 5.0, 0.1, level, STEP) is None
