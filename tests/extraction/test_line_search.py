"""Lines are looked for in what is no surface, and the best of them first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.extraction import acceptance_shape, line_search
from retropole.extraction.poles import confirmed, extract_poles
from retropole.extraction.sensor_pattern import Beams
from tests.extraction.scenes import Y, pole, seen
from tests.extraction.synthetic import line_with, offset, on_pole, scene


def test_poles_beyond_the_most_of_one_group_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, _ = seen([pole((4, 0)), pole((4, 0.5), 0.35 * Y)])
    monkeypatch.setattr(line_search, "MAX_POLES", 1)
    found = extract_poles(cloud)
    (rest,) = found.rejected
    assert len(found.poles) == 1
    assert rest.reason == f"{len(rest.index)} points left after 1 poles, no more are searched for"


@pytest.mark.parametrize("apart", [False, True])
def test_few_points_left_by_several_poles_are_too_few(apart: bool) -> None:
    left = np.zeros(9, dtype=bool)
    left[[0, 1, 2, 5, 6, 7]] = True
    parts = [np.arange(4), np.arange(4, 9)] if apart else [np.arange(9)]
    failure = line_search.why_left(left, parts)
    assert failure.code == "too_few_points"
    assert failure.reason.startswith("no 6 points close together" if apart else "6 points left")


@pytest.mark.parametrize(("width", "is_saturated"), [(0.5, False), (1.5, True)])
def test_bright_surfaces_are_left_out_of_the_search(width: float, is_saturated: bool) -> None:
    across, up = np.meshgrid(np.arange(0, width, 0.04), np.arange(0, 1.5, 0.04))
    plate = offset(0.0, 0.5 + across.ravel(), up.ravel())
    cloud = PointCloud(np.concatenate([on_pole(1.6, 160, 3), plate]))
    parts, failure = line_search.parts_of(cloud, np.arange(len(cloud)))
    searched = np.concatenate(parts)
    assert set(range(480)) <= set(searched), "the pole is searched"
    assert len(searched) < len(cloud)
    assert (failure is not None) is is_saturated


@pytest.mark.parametrize("is_saturated", [True, False])
def test_few_points_are_a_pole_only_off_bright_surfaces(is_saturated: bool) -> None:
    cloud, line = scene(on_pole(rings=acceptance_shape.FEW_POLE_POINTS - 1, each=1))
    index = np.arange(len(cloud))
    free = np.ones(len(cloud), dtype=bool)
    sought = confirmed(0.02, Beams())
    found, _ = line_search.find_lines(cloud, index, index, free, free, sought, is_saturated)
    assert len(found) == (not is_saturated)
    for each in found:
        np.testing.assert_array_equal(np.sort(each.line.index), line.index)


def test_few_or_thick_points_in_a_bright_surface_are_no_pole() -> None:
    many = acceptance_shape.FEW_POLE_POINTS
    assert (
        line_search._failure_in_brightness(line_with(many, rms=acceptance_shape.THICK_RMS)) is None
    )
    for line in (line_with(many - 1), line_with(many, rms=1.01 * acceptance_shape.THICK_RMS)):
        failure = line_search._failure_in_brightness(line)
        assert failure is not None
        assert failure.code == "part_of_a_surface"


def test_limits_of_scatter_are_those_of_near_poles_up_to_8_m() -> None:
    cloud, _ = seen([], "XT32")
    for away in (3.0, 8.0, 12.0, 16.0):
        line = replace(line_with(), point=np.array([away, 0.0, 0.0]))
        limit = line_search._from_afar(cloud, line, 0.002).with_beams(0.03)
        more = 0.002 * np.sqrt(max(away**2 - 64.0, 0.0))
        assert limit == pytest.approx(np.hypot(0.03, more))
    thick = replace(line_with(), thicker=0.62 * 0.035)
    assert thick.with_beams(0.03) == pytest.approx(0.0517)
