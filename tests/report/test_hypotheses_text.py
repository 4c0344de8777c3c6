"""The hypotheses that stand: in words that are true, with the options that decide and no others."""

import re

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.datatypes import Match
from retropole.base.errors import Refusal
from retropole.hypotheses.prior import agreeing_with_prior, pose_prior
from retropole.report.hypotheses import (
    axis_words,
    deciding,
    describe_undecided,
    hypotheses,
    relative_words,
    undecided,
)
from retropole.result import ResultDoc
from tests.report.made_up import made_up

Z = np.array([0.0, 0.0, 1.0])


def with_turns(*turns: tuple[float, float, float], vertical: bool = True) -> ResultDoc:
    """A refused run whose hypotheses are turned by these, degrees about fixed axes; all stand."""
    result, _ = made_up("refused")
    listed = [
        replace(
            result.hypotheses[0],
            T_target_source=se3.from_rt(
                se3.rotation_from_rpy(np.radians(turn)), np.array([3.0 * k, 0, 0])
            ),
            chosen=False,
            stands=True,
        )
        for k, turn in enumerate(turns)
    ]
    return replace(result, hypotheses=listed, vertical=list(Z) if vertical else None)


@pytest.mark.parametrize(("axis", "vertical", "words"), [
    ([0.1, 0, -1], Z, "the vertical"),
    ([0, 0.3, 1], Z, "an axis 17° off the vertical"),
    ([1, 1, 0.1], Z, "a horizontal axis"),
    ([0.1, 0, -1], [1.0, 0, 0], "a horizontal axis"),
    ([0.1, 0, -1], None, "the target's z axis"),
    ([0, -0.6, -0.8], None, "the axis (0.00, 0.60, 0.80) of the target's frame"),
])  # fmt: skip
def test_an_axis_is_vertical_only_where_it_is(
    axis: list[float], vertical: list[float] | None, words: str
) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    assert axis_words(unit, None if vertical is None else np.array(vertical)) == words


def test_the_turn_is_that_of_the_source_against_the_first() -> None:
    result = with_turns((5, 0, 20), (5, 0, 200))
    words = relative_words(result, result.hypotheses[1])
    assert words == "source turned by 180° about the vertical and moved by 3.0 m"


@pytest.mark.parametrize(("turns", "up", "rpy"), [
    (((0, 0, 0), (0, 0, 180)), None, True),
    (((0, 0, 0), (180, 0, 0)), "a", True),
    (((175, 5, 0), (3, 5, 180)), "b", True),
    (((0, 0, 0), (0, 0, 180), (180, 0, 0)), None, True),
    (((0, 0, 0), (0, 0, 50)), None, False),
    (((178, 0, 0), (178, 0, 90)), None, True),
])  # fmt: skip
def test_options_are_named_where_they_decide(
    turns: tuple[tuple[float, float, float], ...], up: str | None, rpy: bool
) -> None:
    result = with_turns(*turns)
    named = undecided(result)
    said = " ".join(deciding(result, named))
    found = re.search(r"`--up`.*?leaves (\w)\b", said)
    assert (found[1] if found else None) == up
    assert ("--prior-rpy-deg" in said) == rpy
    # It says what the prior then does.
    poses = [np.array(each.T_target_source) for _, each in named]
    matches = [Match(((0, 0),), T, 0.01, True, True, np.eye(6)) for T in poses]
    try:
        left = agreeing_with_prior(matches, pose_prior(True, None, 10.0))
    except Refusal:
        left = []
    assert (len(left) == 1) == (up is not None)
    if rpy:
        near = np.array(turns[0]) + np.array([0, 0, 25.0])
        (kept,) = agreeing_with_prior(matches, pose_prior(False, near.tolist(), 10.0))
        assert kept is matches[0]


def test_what_was_given_already_is_not_named() -> None:
    result = with_turns((0, 0, 0), (180, 0, 0))
    config = replace(result.config, up=True, hypothesis="a")
    said = list(deciding(result, undecided(result)))
    assert len(said) == 3
    (instead,) = deciding(replace(result, config=config), undecided(result))
    assert "instead of `--up`" in instead


def test_nothing_is_listed_where_it_is_decided() -> None:
    result = with_turns((0, 0, 0), (0, 0, 180))
    assert len(undecided(result)) == 2
    assert describe_undecided(replace(result, reasons=[])) == []
    alone = [result.hypotheses[0], replace(result.hypotheses[1], stands=False)]
    assert describe_undecided(replace(result, hypotheses=alone)) == []


def test_terminal_and_page_say_the_same() -> None:
    result = with_turns((0, 0, 0), (0, 0, 180))
    lines = describe_undecided(result)
    assert max(map(len, lines)) <= 80
    page = hypotheses(result)
    for words in ("180.0", "source turned by 180° about the vertical", "--hypothesis a | b"):
        assert words in "\n".join(lines)
        assert words in page
