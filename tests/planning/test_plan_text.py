import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.base import se3
from retropole.base.errors import Reason
from retropole.base.uncertainty.purpose import Need
from retropole.planning.comparison import NEAR
from retropole.planning.place import DIRECTIONS, LEANS, LIDAR_CLEARANCE, Station, leaning
from retropole.planning.plan_text import (
    LEAN_STEP_DEG,
    PLACE_STEP_DEG,
    leaning_words,
    plan_document,
    pole_words,
)
from retropole.planning.planner import More
from retropole.result import encode
from retropole.result.decoding import decode_plan
from tests.planning.places import planned, pose, stations

pytestmark = pytest.mark.full

RECORDINGS = [("front.pcd", "0" * 64), ("rear.pcd", "1" * 64)]


def test_a_plan_is_read_back_as_it_was_written() -> None:
    document = plan_document(planned(), RECORDINGS, Need(0.02, 30.0))
    data = encode(document)
    again = decode_plan(data)
    assert encode(again) == data
    assert again.probability is not None
    assert 0.0 <= again.probability <= 1.0
    assert [pole.name for pole in again.placements[0].poles] == ["A", "B"]


def test_lengths_to_measure_fix_the_feet() -> None:
    document = plan_document(planned(), RECORDINGS, None)
    feet = {pole.name: pole.foot_m for pole in document.placements[0].poles}
    below = {f"below {each.name}": each.T_place_lidar[:3, 3] for each in document.lidars}
    for tape in document.placements[0].tape:
        start = (feet | below)[tape.start]
        assert tape.metres == pytest.approx(np.linalg.norm((feet[tape.end] - start)[:2]), abs=0.02)


WAY = re.compile(r"(\d+)° (left|right) of|(on|opposite to) ")
LEAN = re.compile(
    r"(away from|towards) ([ab])(?:, (\d+)° to the (left|right) as seen from there)?$"
)


def at(name: str, x: float, y: float, yaw_deg: float = 0.0) -> Station:
    """A LiDAR in the frame of the place, of which only its pose matters here."""
    return replace(stations()[0], name=name, T=pose(x, y, 1.5, yaw_deg))


def turn_of(words: str) -> float:
    """Read the angle to the left, degrees, at which a foot is said to be."""
    found = WAY.search(words)
    assert found is not None, words
    if found[3]:
        return 0.0 if found[3] == "on" else 180.0
    return float(found[1]) * (1 if found[2] == "left" else -1)


def lean_of(towards: str) -> float:
    """Read the angle to the left of straight away from the LiDAR, degrees, of a lean."""
    aside = re.match(r"to the (left|right) as seen from [ab]$", towards)
    if aside:
        return 90.0 if aside[1] == "left" else -90.0
    found = LEAN.match(towards)
    assert found is not None, towards
    turn = float(found[3] or 0)
    turn = turn if found[1] == "away from" else 180.0 - turn
    return turn if found[4] != "right" else -turn


def apart_deg(a: float, b: float) -> float:
    return abs((a - b + 180.0) % 360.0 - 180.0)


angles = st.floats(-180.0, 180.0)


@given(angles, angles, angles, st.floats(1.0, 15.0), st.floats(0.6, 30.0))
@settings(max_examples=60)
def test_directions_in_words_are_those_of_the_geometry(
    line: float, to: float, way: float, away: float, apart: float
) -> None:
    """Within half of the steps in which they are given, left and right as a person has them."""
    unit = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.radians([line, to, way])]
    own = at("a", 3.0, -2.0), at("b", 3.0 + apart * unit[0][0], -2.0 + apart * unit[0][1], 70.0)
    foot = np.array([3.0, -2.0, 0.0]) + away * unit[1]
    axis = np.sin(0.35) * unit[2] + [0.0, 0.0, np.cos(0.35)]
    lean, towards = leaning_words(foot, axis, own)
    assert lean == pytest.approx(0.35)
    assert apart_deg(lean_of(towards), way - to) <= LEAN_STEP_DEG / 2 + 1e-6
    words = pole_words("A", foot, lean, towards, own)
    assert apart_deg(turn_of(words), to - line) <= PLACE_STEP_DEG / 2 + 1e-6
    assert f"{away:.1f} m from a" in words
    assert words.endswith(f"; lean 20° {towards}")


@pytest.mark.parametrize(
    "own",
    [
        (at("a", 0.0, 0.0), at("b", 4.0, 1.0, 90.0)),
        (at("a", 0.0, 0.0), at("b", 0.0, 0.1)),
        (at("a", 0.0, 0.0), at("b", 8.0, 0.0), at("c", 8.0, 9.0)),
    ],
)
def test_two_choices_never_read_alike(own: tuple[Station, ...]) -> None:
    """Feet that a person can pace apart, or leans that differ, have other words."""
    feet = np.array([(x, y, 0.0) for x in np.arange(-6, 7) for y in np.arange(-6, 7)]) * 1.5
    poles = leaning(feet, LEANS, DIRECTIONS, 2.0, 0.02)
    words = [
        pole_words("", foot, *leaning_words(foot, axis, own), own)
        for foot, axis in zip(poles.foot, poles.axis, strict=True)
        if min(np.linalg.norm(foot[:2] - each.at[:2]) for each in own) > LIDAR_CLEARANCE
    ]
    assert len(set(words)) == len(words)


def test_candidates_never_read_alike() -> None:
    found, own = planned().candidates, stations()
    words = [
        pole_words("", foot, *leaning_words(foot, axis, own), own)
        for foot, axis in zip(found.foot, found.axis, strict=True)
    ]
    for k, j in combinations(range(len(words)), 2):
        near = np.linalg.norm(found.foot[k] - found.foot[j]) < NEAR
        assert words[k] != words[j] or (near and np.allclose(found.axis[k], found.axis[j]))


def test_lidars_above_each_other_have_no_line() -> None:
    own = at("a", 0.0, 0.0, 10.0), at("b", 0.2, 0.1)
    assert "90° left of ahead of a (its x axis)" in pole_words("A", np.array([0, 4, 0]), 0, "", own)
    up = se3.from_rt(se3.rotation_from_rpy(np.radians([0.0, -90.0, 0.0])), own[0].at)
    own = replace(own[0], T=up), own[1]
    assert "on ahead of a (its z axis)" in pole_words("A", np.array([4, 0, 0]), 0, "", own)
    assert leaning_words(np.ones(3), np.array([0.0, 0.0, 1.0]), own) == (0.0, "")


def test_what_one_pole_more_brings_is_reported_once() -> None:
    """Where the verdict is better with it, it is worth it, however small the gain is."""
    found = planned()
    more = More("pole", found.chosen, 0.01, 0.02, 0.01, "ok", True)
    poor = replace(found.rehearsal, status="warn", reasons=(Reason("ambiguous", "…", {}),))
    document = plan_document(replace(found, rehearsal=poor, more=(more,)), RECORDINGS, None)
    about = [each for each in document.words if "more" in each]
    assert document.more[0].is_worth_it
    assert document.more[0].status == "ok"
    (said,) = [each for each in about if each.startswith("One pole more")]
    assert said.endswith("verdict ok: worth it.")
    assert not any("third" in each or "With one" in each for each in document.words)
    # Where it is worse, it is not, however large.
    worse = replace(more, gain=0.5, status="refused", is_better=False)
    document = plan_document(replace(found, rehearsal=poor, more=(worse,)), RECORDINGS, None)
    assert not document.more[0].is_worth_it


def test_a_walk_is_named_last_where_poles_will_do_and_first_where_they_will_not() -> None:
    for need, place in ((None, slice(1, None)), (Need(1e-4, 30.0), slice(0, 1))):
        words = plan_document(planned(), RECORDINGS, need).words
        assert [each for each in words if "--carried" in each] == [
            each for each in words[place] if "--carried" in each
        ]
        assert sum("--carried" in each for each in words) == 1
