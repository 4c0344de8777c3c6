"""Whether a survey tells which of its points is off."""

import numpy as np
import pytest

from benchmarks.site_blunders import told_apart
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import ControlPoint, Sighting, SurveyedPole
from retropole.simulation.sites import Surveyed

pytestmark = pytest.mark.full

CORNERS = np.array([[10.0, 0.0, 1.0], [0.0, 12.0, 1.0], [-9.0, 1.0, 1.0], [1.0, -11.0, 1.0]])
SIGMA, SIGHTED = 0.005, 0.003


def points(at: Array) -> tuple[ControlPoint, ...]:
    seen = tuple(Sighting(lidar, np.zeros(3), SIGHTED) for lidar in range(2))
    return tuple(ControlPoint(f"C{k + 1}", own, SIGMA, seen) for k, own in enumerate(at))


def left_by(at: Array, which: int, other: int, offset: Array) -> float:
    """χ² of the best rigid motion of all points, with any error of one of them."""
    A = np.vstack([np.hstack([np.cross(own, np.eye(3)), np.eye(3)]) for own in at])
    A = np.hstack([A, np.eye(len(A))[:, 3 * other : 3 * other + 3]])
    y = np.zeros(len(A))
    y[3 * which : 3 * which + 3] = offset
    best, *_ = np.linalg.lstsq(A, y, rcond=None)
    return float(np.sum((y - A @ best) ** 2) / (SIGMA**2 + SIGHTED**2 / 2))


@pytest.mark.parametrize("which", range(5))
def test_it_is_what_least_squares_leave_to_the_best_of_the_others(which: int) -> None:
    rng = np.random.default_rng(which)
    at = rng.normal(scale=[10, 10, 2], size=(5, 3))
    offset = rng.normal(scale=0.1, size=3)
    left = min(left_by(at, which, other, offset) for other in range(5) if other != which)
    assert told_apart(((), points(at)), which, offset) == pytest.approx(left, rel=1e-6)


def test_four_points_of_a_plane_do_not_tell_whose_height_is_off() -> None:
    """They check the heights by one number; along the plane each is checked by itself."""
    four: Surveyed = ((), points(CORNERS))
    five: Surveyed = ((), points(np.vstack([CORNERS, [3.0, 4.0, 1.0]])))
    for which in range(4):
        assert told_apart(four, which, np.array([0.0, 0.0, 0.1])) == pytest.approx(0.0, abs=1e-6)
        assert told_apart(four, which, np.array([0.1, 0.0, 0.0])) > 25
        assert told_apart(five, which, np.array([0.0, 0.0, 0.1])) > 5


def test_it_is_the_same_wherever_the_site_lies() -> None:
    rng = np.random.default_rng(3)
    T = se3.from_rt(se3.exp_so3(rng.normal(size=3)), rng.normal(scale=500, size=3))
    offset = np.array([0.05, -0.02, 0.08])

    def survey(move: Array) -> Surveyed:
        ends = np.array([[3.0, 2.0, 0.0], [3.4, 2.1, 2.0]])
        foot, top = se3.apply(move, ends)
        return (SurveyedPole("P", 0, foot, top, SIGMA),), points(se3.apply(move, CORNERS))

    for which in range(2, 6):
        here = told_apart(survey(np.eye(4)), which, offset)
        there = told_apart(survey(T), which, T[:3, :3] @ offset)
        assert there == pytest.approx(here, rel=1e-4)


def test_where_an_end_lies_along_its_pole_nobody_sees() -> None:
    foot, top = np.array([3.0, 2.0, 0.0]), np.array([3.0, 2.0, 2.0])
    survey: Surveyed = (SurveyedPole("P", 0, foot, top, SIGMA),), points(CORNERS)
    for which in (0, 1):
        assert told_apart(survey, which, np.array([0.0, 0.0, 0.1])) == pytest.approx(0.0, abs=1e-6)
        assert told_apart(survey, which, np.array([0.1, 0.0, 0.0])) > 5
