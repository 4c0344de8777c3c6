"""The exhibits of equations 3 and 4, section IV-A and the figure of the beams."""

import numpy as np
import pytest

from studies.paper.beams import DISTANCE, RADIUS, two_matlab
from studies.paper.equations import (
    FRAMES,
    LISTED_ELEVATIONS,
    arc_points,
    arc_walk,
    transforms,
)
from studies.paper.exhibit import Exhibit
from studies.paper.line_bias import PAPER_TABLE_II
from tests.studies.paper.exhibits import number

pytestmark = pytest.mark.full


def columns(exhibit: Exhibit) -> None:
    assert all(len(row) == len(exhibit.header) for row in exhibit.rows)


def test_the_points_of_both_are_listed() -> None:
    exhibit = arc_points()
    columns(exhibit)
    assert len(exhibit.rows) == 5 * len(LISTED_ELEVATIONS)
    for row in exhibit.rows:
        assert number(row[-2]) < 1e-9
        walked, cast = (np.array([float(str(c)) for c in row[k : k + 3]]) for k in (2, 5))
        assert abs(np.linalg.norm(walked - cast) - number(row[-1])) < 3e-6
        if row[0] == 0:
            assert number(row[-1]) < 1e-9
    assert max(number(row[-1]) for row in exhibit.rows) > 0.003


def test_walk_and_casting_differ_only_by_plane_and_cone() -> None:
    exhibit = arc_walk()
    columns(exhibit)
    assert len(exhibit.rows) == 2 * len(PAPER_TABLE_II)
    for *_, walked, cone, own, to_cone, level in exhibit.rows:
        assert number(own) < 1e-9
        assert number(level) < 1e-9
        assert 1e-3 < number(to_cone) < 0.1
        assert number(walked) <= number(cone), "no ring has more points in its plane"


def test_the_transforms_hold_at_their_singular_cases() -> None:
    exhibit = transforms()
    columns(exhibit)
    assert [row[0] for row in exhibit.rows] == list(FRAMES)
    for _, det_a, det_r, upright, onto_x, points, apart in exhibit.rows:
        assert abs(number(det_a) - 1) + abs(number(det_r) - 1) < 1e-12
        assert number(upright) + number(onto_x) < 1e-12
        assert number(points) > 100
        assert number(apart) < 1e-9


def test_every_ring_of_the_figure_meets_the_pole_on_the_side_of_the_lidar() -> None:
    exhibit = two_matlab()
    columns(exhibit)
    end = np.degrees(np.arccos(RADIUS / DISTANCE))
    assert [row[0] for row in exhibit.rows] == list(range(-15, 16, 2))
    for _, points, least, most, low, high in exhibit.rows:
        assert number(points) > 50
        assert -end <= number(least) < -0.8 * end
        assert 0.8 * end < number(most) <= end
        assert 0 < number(low) < number(high)
