"""Each rule of the shape passes a line at its limit, and fails one just beyond it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array, IntArray, PointCloud
from retropole.extraction import acceptance_shape as rules
from retropole.extraction.acceptance_shape import shape_failure
from retropole.extraction.lines import MIN_POLE_POINTS, WIDTH_IN_RMS, Line
from tests.extraction.synthetic import FOOT, UP, code_of, line_with


def cloud_of(line: Line, ring: IntArray | None = None) -> PointCloud:
    """A cloud in which each ring of the LiDAR has the points next to each other on the line."""
    if ring is None:
        ring = np.arange(len(line.along)) * line.rings // max(len(line.along), 1)
    return PointCloud(FOOT + line.along[:, None] * UP, np.full(len(ring), 200.0), ring)


def failed(line: Line) -> tuple[str, str]:
    failure = shape_failure(cloud_of(line), line)
    return ("", "") if failure is None else (failure.code, failure.reason)


THICK_LENGTH = rules.MAX_THICK_LENGTH
SLIM_RATIO = rules.MIN_SLENDERNESS * WIDTH_IN_RMS

LIMITS: dict[str, tuple[Line, Line, str, str]] = {
    "points": (
        line_with(MIN_POLE_POINTS, rings=6),
        line_with(MIN_POLE_POINTS - 1, rings=5),
        "too_few_points",
        "5 points in line",
    ),
    "least length": (
        line_with(length=rules.MIN_LENGTH),
        line_with(length=0.999 * rules.MIN_LENGTH),
        "too_short",
        "0.25 m long",
    ),
    "most length": (
        line_with(96, length=rules.MAX_LENGTH, rings=48),
        line_with(96, length=1.001 * rules.MAX_LENGTH, rings=48),
        "too_long",
        "4.00 m long",
    ),
    "rings": (
        line_with(length=0.25, rings=rules.MIN_POLE_RINGS),
        line_with(length=0.25, rings=rules.MIN_POLE_RINGS - 1),
        "too_few_rows",
        "2 of the rings",
    ),
    # What 0.62 times 6 cm of radius adds is no width; but longer than wide it must be.
    "slenderness of a tube": (
        replace(line_with(length=0.301, rms=0.075), thicker=0.037),
        replace(line_with(length=0.299, rms=0.075), thicker=0.037),
        "too_wide",
        "0.30 m wide",
    ),
    "slenderness": (
        line_with(length=1.001 * SLIM_RATIO * 0.05, rms=0.05),
        line_with(length=0.999 * SLIM_RATIO * 0.05, rms=0.05),
        "too_wide",
        "times longer than wide",
    ),
    "thickness": (
        line_with(length=1.2, rms=rules.MAX_RMS),
        line_with(length=1.2, rms=1.001 * rules.MAX_RMS),
        "too_wide",
        "more than any post",
    ),
    "length of what is thick": (
        line_with(48, length=THICK_LENGTH, rms=1.001 * rules.THICK_RMS, rings=16),
        line_with(48, length=1.001 * THICK_LENGTH, rms=1.001 * rules.THICK_RMS, rings=16),
        "too_wide",
        "more than any post",
    ),
    "thickness of what is long": (
        line_with(48, length=2.0, rms=rules.THICK_RMS, rings=16),
        line_with(48, length=2.0, rms=1.001 * rules.THICK_RMS, rings=16),
        "too_wide",
        "more than any post",
    ),
    "points of what is thick": (
        line_with(rules.FEW_POLE_POINTS, rms=1.001 * rules.MAX_CONFIRMED_RMS, rings=9),
        line_with(rules.FEW_POLE_POINTS - 1, rms=1.001 * rules.MAX_CONFIRMED_RMS, rings=9),
        "too_wide",
        "a post as thick as that needs",
    ),
    "thickness of few points": (
        line_with(rules.FEW_POLE_POINTS - 1, rms=rules.MAX_CONFIRMED_RMS, rings=9),
        line_with(rules.FEW_POLE_POINTS - 1, rms=1.001 * rules.MAX_CONFIRMED_RMS, rings=9),
        "too_wide",
        "a post as thick as that needs",
    ),
}


@pytest.mark.parametrize("name", LIMITS)
def test_limits_of_the_shape(name: str) -> None:
    passing, failing, code, words = LIMITS[name]
    assert failed(passing) == ("", "")
    found, reason = failed(failing)
    assert found == code
    assert words in reason


def test_rules_are_requested_in_order() -> None:
    everything_wrong = line_with(4, length=0.2, rms=0.2, rings=1)
    assert failed(everything_wrong)[0] == "too_few_points"
    assert failed(replace(everything_wrong, index=np.arange(20)))[0] == "too_short"
    assert failed(line_with(20, length=5.0, rms=2.0, rings=2))[0] == "too_long"
    assert failed(line_with(20, length=1.0, rms=2.0, rings=2))[0] == "too_few_rows"


@pytest.mark.parametrize(("factor", "code"), [(0.999, ""), (1.001, "along_a_beam")])
def test_rings_lie_across_a_pole(factor: float, code: str) -> None:
    extent = factor * line_with().tube
    starts = np.array([-0.6, 0.0, 0.6])
    along = np.sort(np.concatenate([starts, starts + extent / 2, starts + extent]))
    line = line_with(9, length=float(np.ptp(along)), rings=3, along=along)
    assert code_of(shape_failure(cloud_of(line, np.repeat(np.arange(3), 3)), line)) == code


def test_a_stray_point_on_one_ring_is_no_sweep() -> None:
    along = np.repeat(np.linspace(-0.6, 0.6, 8), 3)
    along[1] += 2 * line_with().tube
    line = line_with(24, along=along)
    assert shape_failure(cloud_of(line, np.repeat(np.arange(8), 3)), line) is None


def level_line(tilt: float, origin_distance: float) -> tuple[PointCloud, Line]:
    """Points on a level line across the view, whose elevations as seen span ``tilt``."""
    rng = np.random.default_rng(0)
    along = np.sort(rng.uniform(-0.5, 0.5, 24))
    bearing = along / 10.0
    elevation = 0.1 + tilt * np.linspace(-0.5, 0.5, 24)
    rays: Array = np.stack(
        [np.cos(bearing) * np.cos(elevation), np.sin(bearing) * np.cos(elevation),
         np.sin(elevation)], axis=1
    )  # fmt: skip
    cloud = PointCloud(origin_distance * rays, np.full(24, 200.0))
    return cloud, line_with(24, length=1.0, along=along)


@pytest.mark.parametrize(
    ("tilt", "distance", "code"),
    [
        (1.001 * rules.ONE_BEAM_ELEVATION, 10.0, ""),
        (0.999 * rules.ONE_BEAM_ELEVATION, 10.0, "along_a_beam"),
        (0.999 * rules.ONE_BEAM_ELEVATION, 0.99 / rules.ONE_BEAM_ELEVATION, "along_a_beam"),
        (0.999 * rules.ONE_BEAM_ELEVATION, 1.01 / rules.ONE_BEAM_ELEVATION, ""),
    ],
)
def test_one_elevation_is_one_beam_where_a_line_would_show_more(
    tilt: float, distance: float, code: str
) -> None:
    cloud, line = level_line(tilt, distance)
    assert code_of(shape_failure(cloud, line)) == code


@pytest.mark.parametrize("with_rings", [True, False])
def test_a_plain_pole_passes(with_rings: bool) -> None:
    line = line_with()
    cloud = cloud_of(line)
    assert shape_failure(cloud if with_rings else replace(cloud, ring=None), line) is None
