"""Refusals of a LiDAR in a map are in words of a map."""

from typing import get_args

import pytest

from retropole.base.errors import Refusal
from retropole.base.reasons import Code
from retropole.verdict.map import DIFFERS, of_map


@pytest.mark.parametrize("code", sorted(DIFFERS))
def test_what_contradicts_is_said_with_its_numbers(code: str) -> None:
    assert code in get_args(Code)
    found = of_map(Refusal(code, "m", {"agreeing": 412, "contradicting": 96}))  # type: ignore[arg-type]
    assert found.code == "map_differs"
    assert "412 agree" in found.message
    assert "96" in found.message
    assert found.values == {"agreeing": 412, "contradicting": 96}


def test_an_open_direction_is_said_with_its_size() -> None:
    values = {"rotation_sigma_rad": 3e-4, "translation_sigma_m": 0.2}
    found = of_map(Refusal("degenerate_poles", "m", values))
    assert found.code == "map_leaves_open"
    assert "0.02° and 0.20 m" in found.message


def test_all_others_stay_and_nothing_speaks_of_setting_up_poles_where_it_is_ambiguous() -> None:
    other = Refusal("moving_lidar", "the source LiDAR turned by 2.0°")
    assert of_map(other) is other
    found = of_map(Refusal("ambiguous", "the scene does not tell 3 hypotheses apart: add a pole"))
    assert "add a pole" not in found.message
    assert "--prior-xyz" in found.message


def test_a_pose_that_fits_elsewhere_nearly_as_well_is_ambiguous_and_the_map_right() -> None:
    values = {"agreeing": 900, "contradicting": 3, "missing": 0, "lead": 1.1}
    found = of_map(Refusal("too_few_poles", "m", {**values, "probability_wrong": 0.09}))
    assert found.code == "ambiguous"
    assert "1.1 σ" in found.message
    assert "9 %" in found.message
    values["contradicting"] = 300
    assert of_map(Refusal("too_few_poles", "m", {**values, "probability_wrong": 0.5})).code == (
        "map_differs"
    )
