"""A band on a body is no confirmed pole; a pole beside a person, a wall or a post is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Detection
from retropole.extraction import surroundings
from retropole.extraction.poles import extract_poles
from retropole.simulation import Box, Cylinder, Rectangle, Surface
from tests.extraction.scenes import PAINT, TAPE, Y, Z, pole, seen

GROUND_HEIGHT = -1.2
BAND = Cylinder(np.array([4.0, 0.0, -0.1]), Z, 0.02, 0.8, TAPE)


def person(
    behind: float, height: float = 1.75, aside: float = 0.0, above_ground: float = 0.0
) -> Box:
    """A body whose front is so far behind the band, metres."""
    half = np.array([0.12, 0.22, (height - above_ground) / 2])
    at = np.array([4.0 + behind + half[0], aside, GROUND_HEIGHT + above_ground + half[2]])
    return Box(at, np.eye(3), half, PAINT)


def found(things: list[Surface], sensor: str = "XT32") -> Detection:
    return extract_poles(seen(things, sensor)[0])


def is_worn(detection: Detection) -> bool:
    """Whether the one line there is is a band; else it is a confirmed pole."""
    assert len(detection.poles) + len(detection.candidates) == 1
    codes = {cluster.code for cluster in detection.rejected}
    assert (len(detection.candidates) == 1) == ("on_a_body" in codes)
    return "on_a_body" in codes


@pytest.mark.parametrize("sensor", ["XT32", "HDL-32E"])
@pytest.mark.parametrize("behind", [0.2, 0.35, 0.5])
def test_a_band_that_a_person_holds_is_doubtful(sensor: str, behind: float) -> None:
    assert is_worn(found([BAND, person(behind)], sensor))


def test_a_band_alone_is_sure() -> None:
    assert not is_worn(found([BAND]))


@pytest.mark.parametrize("aside", [-0.45, 0.45])
def test_a_pole_with_a_person_beside_it_is_sure(aside: float) -> None:
    assert not is_worn(found([pole((4, 0)), person(-0.1, aside=aside)]))


def test_a_body_must_go_on_beyond_both_ends() -> None:
    top = BAND.centre[2] + BAND.length / 2 - GROUND_HEIGHT
    assert not is_worn(found([BAND, person(0.3, height=top)]))
    assert not is_worn(found([BAND, person(0.3, above_ground=top - BAND.length)]))


def test_a_body_farther_off_says_nothing() -> None:
    assert not is_worn(found([BAND, person(surroundings.BODY_REACH + 0.1)]))


def test_what_has_no_air_about_it_is_no_body() -> None:
    wall = Rectangle(np.array([4.35, 0, 0.3]), Y, Z, (3.0, 1.5), PAINT)
    assert not is_worn(found([BAND, wall]))


def test_a_rigid_motion_changes_nothing() -> None:
    cloud, _ = seen([BAND, person(0.3)])
    T = se3.from_rt(se3.exp_so3(np.array([0.4, -1.1, 2.0])), np.array([3.0, -2.0, 1.0]))
    assert is_worn(extract_poles(cloud.transformed(T)))
    shuffled = np.random.default_rng(0).permutation(len(cloud))
    assert is_worn(extract_poles(replace(cloud, ring=None).select(shuffled)))
