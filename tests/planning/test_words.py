from functools import partial

import numpy as np
import pytest

from retropole.base.uncertainty.purpose import Need
from retropole.planning.words import leaning_words, plan_document, pole_words
from retropole.result import encode
from retropole.result.decoding import parsed
from retropole.result.pole_plan import PolePlanDoc
from tests.planning.places import planned, stations

RECORDINGS = [("front.pcd", "0" * 64), ("rear.pcd", "1" * 64)]


def test_a_plan_is_read_back_as_it_was_written() -> None:
    document = plan_document(planned(), RECORDINGS, Need(0.02, 30.0))
    data = encode(document)
    again = partial(parsed, kind=PolePlanDoc, what="plan")(data)
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


def test_places_are_told_from_the_first_lidar() -> None:
    own = stations()
    for foot, words in (
        ((4.0, 0.0), "straight ahead"),
        ((0.0, 4.0), "90° left of ahead"),
        ((0.0, -4.0), "90° right of ahead"),
        ((-4.0, 0.0), "straight behind"),
    ):
        said = pole_words("A", np.r_[foot, 0.0], 0.0, "", own)
        assert words in said
        assert "4.0 m from front" in said
        assert said.endswith("upright")


def test_leans_are_told_as_they_are_seen() -> None:
    foot = np.array([5.0, -3.0, 0.0])
    out = foot / np.linalg.norm(foot)
    for way, words in (
        (out, "away from front"),
        (-out, "towards front"),
        (np.array([-out[1], out[0], 0.0]), "to the left, seen from front"),
    ):
        axis = np.sin(0.3) * way + [0.0, 0.0, np.cos(0.3)]
        lean, towards = leaning_words(foot, axis, stations()[:1])
        assert lean == pytest.approx(0.3)
        assert towards == words
    assert leaning_words(foot, np.array([0.0, 0.0, 1.0]), stations()) == (0.0, "")
