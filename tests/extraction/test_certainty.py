"""A line is a confirmed pole within each limit of certainty, and a candidate just beyond it."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.extraction.certainty import doubt_of
from retropole.extraction.lines import fit_line
from retropole.extraction.poles import extract_poles
from retropole.simulation import Box
from tests.extraction.scenes import PAINT, Y, pole, seen, without_rings
from tests.extraction.synthetic import FOOT, UP, code_of, on_pole, scene, upright_places


@pytest.mark.parametrize(("radius", "given", "is_sure"), [
    (0.02, 0.02, True), (0.06, 0.02, False), (0.06, 0.06, True), (0.05, 0.05, True),
])  # fmt: skip
def test_a_pole_is_sure_where_it_is_as_thick_as_was_stated(
    radius: float, given: float, is_sure: bool
) -> None:
    cloud, _ = seen([pole((4, 0), length=1.4, radius=radius)], "OS1")
    found = extract_poles(cloud, radius=given)
    assert (len(found.poles), len(found.candidates)) == ((1, 0) if is_sure else (0, 1))
    if not is_sure:
        (rejected,) = found.rejected
        assert rejected.code == "too_wide"
        assert "20 mm radius" in rejected.reason
        np.testing.assert_array_equal(rejected.index, found.candidates[0].index)


def test_what_widens_a_few_pieces_does_not_make_a_pole_thick() -> None:
    cloud, line = scene(on_pole(1.6, 32, 4, width=0.04))
    wide = scene(on_pole(1.6, 32, 4, width=0.14))
    assert doubt_of(cloud, line, 0.02, True) is None
    assert code_of(doubt_of(*wide, 0.02, True)) == "too_wide"
    xyz = cloud.xyz.copy()
    xyz[:24, 1] += 0.09 * np.tile([1, -1], 12)
    held = PointCloud(xyz, cloud.intensity)
    line = fit_line(held, np.arange(len(xyz)), FOOT, UP, 0.02)
    assert doubt_of(held, line, 0.02, True) is None


def broken(lower: int, missing: int, upper: int, step: float, with_rings: bool) -> str:
    """What is said of a pole on some rings, then on none of some rings, then on some again."""
    ring = np.r_[np.arange(lower), lower + missing + np.arange(upper)]
    pole_points = np.repeat(upright_places(step * (ring - ring.mean())), 2, axis=0)
    cloud, line = scene(pole_points, rings=np.repeat(ring, 2))
    assert len(line.index) == len(pole_points)
    return code_of(doubt_of(cloud if with_rings else without_rings(cloud), line, 0.02, True))


@pytest.mark.parametrize("with_rings", [True, False])
@pytest.mark.parametrize(("lower", "missing", "upper", "code"), [
    (3, 0, 3, ""), (3, 2, 3, ""), (3, 6, 3, "interrupted"),
    (8, 12, 2, ""), (8, 12, 8, ""), (8, 17, 8, "interrupted"),
])  # fmt: skip
def test_a_gap_of_half_the_length_makes_two_things(
    lower: int, missing: int, upper: int, code: str, with_rings: bool
) -> None:
    expected = "interrupted" if (lower, missing, upper) == (8, 12, 2) else code
    assert broken(lower, missing, upper, 0.04, with_rings) == expected


@pytest.mark.parametrize("with_rings", [True, False])
@pytest.mark.parametrize("rings", [3, 4, 5])
@pytest.mark.parametrize("lost", [0, 1])
def test_a_far_pole_on_few_rings_is_sure(rings: int, lost: int, with_rings: bool) -> None:
    """Rings 2° apart are 0.28 m apart at 8 m; one of them may give no return."""
    assert broken(2, lost, rings - 2, 0.28, with_rings) == ""


@pytest.mark.parametrize("sensor", ["XT32", "OS1"])
def test_a_pole_hidden_for_less_than_half_is_sure(sensor: str) -> None:
    for half_height, is_sure in ((0.25, True), (0.46, False)):
        bar = Box(np.array([3.5, 0, 0]), np.eye(3), np.array([0.02, 1.0, half_height]), PAINT)
        found = extract_poles(seen([pole((4, 0)), bar], sensor)[0])
        assert (len(found.poles), len(found.candidates)) == ((1, 0) if is_sure else (0, 1))
        assert is_sure or found.rejected[0].code == "interrupted"


@pytest.mark.parametrize(("angle", "code"), [(16.0, ""), (14.0, "end_on"), (-14.0, "end_on")])
def test_a_line_seen_end_on_is_no_sure_pole(angle: float, code: str) -> None:
    away = np.radians(angle)
    direction = np.array([np.cos(away), 0.0, np.sin(away)])
    places = FOOT + np.linspace(-0.6, 0.6, 13)[:, None] * direction
    cloud = PointCloud(np.repeat(places, 2, axis=0), np.full(26, 200.0))
    line = fit_line(cloud, np.arange(26), FOOT, direction, 0.02)
    assert code_of(doubt_of(cloud, line, 0.02, True)) == code
    assert doubt_of(cloud, line, 0.02, False) is None, "the origin is not known"


def test_a_constant_ring_gives_the_poles_of_none() -> None:
    from dataclasses import replace

    cloud, _ = seen([pole((4, 0.7)), pole((6, -1), 0.5 * Y)], "VLP-16")
    none, constant = (
        extract_poles(replace(cloud, ring=ring))
        for ring in (None, np.full(len(cloud), 3, dtype=np.int64))
    )
    assert len(none.poles) == len(constant.poles) == 2
    for one, other in zip(none.poles, constant.poles, strict=True):
        np.testing.assert_array_equal(one.index, other.index)
        assert one.rings == other.rings
