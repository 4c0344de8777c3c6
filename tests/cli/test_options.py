"""Numbers that make no sense are bad usage, and what is said names what would."""

from __future__ import annotations

import math
from typing import Any

import click
import pytest

from tests.cli.commands import all_commands, retropole_here

ABSURD = "nan", "inf", "-inf", "1e400", "-1e400", "9" * 20, "-" + "9" * 20, "9" * 5000, "much", ""

NUMBERS = (click.types.IntParamType, click.types.FloatParamType)


def numbers() -> list[tuple[str, click.Option, Any]]:
    """Every number that a command takes: the command, the option and the type."""
    return [
        (name, option, kind)
        for name, command in all_commands()
        for option in command.params
        if isinstance(option, click.Option)
        for kind in (option.type.types if isinstance(option.type, click.Tuple) else [option.type])
        if isinstance(kind, NUMBERS)
    ]


def test_every_number_of_every_command_has_bounds_that_an_error_names() -> None:
    assert len(numbers()) > 60
    for name, option, kind in numbers():
        which = f"{name} {option.opts[0]}"
        low, high = getattr(kind, "min", None), getattr(kind, "max", None)
        assert low is not None, which
        assert high is not None, which
        assert math.isfinite(low), which
        assert math.isfinite(high), which
        convert: Any = kind.convert
        for text in ABSURD:
            with pytest.raises(click.BadParameter) as caught:
                convert(text, option, None)
            assert f"{high:g}" in caught.value.message or str(high) in caught.value.message, which


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("calibrate", "a", "b", "--poles", "9" * 20), "the range 0<=x<=9007199254740992"),
        (("calibrate", "a", "b", "--frames", f"0:{'9' * 20}"), "none beyond 9007199254740992"),
        (("calibrate", "a", "b", "--frames", "9" * 5000), "none beyond 9007199254740992"),
        (("watch", "folder:.", f"velodyne:{'9' * 5000}"), "a number from 1 to 65535"),
        (("watch", "folder:.", f"velodyne:{'9' * 10}"), "expected 1 to 65535"),
        (("watch", "folder:.", "velodyne:1", "--from", "x"), "expected an IP address"),
        (("watch", "folder:.", "folder:..", "--from", "1.2.3.4"), "who sends packets"),
    ],
)
def test_a_number_in_a_word_has_bounds_too(words: tuple[str, ...], said: str) -> None:
    done = retropole_here(*words, "--out", "none")
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_a_domain_of_the_environment_has_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds")
    for given in ("9" * 5000, "233", "-1", "x"):
        monkeypatch.setenv("ROS_DOMAIN_ID", given)
        done = retropole_here("watch", "ros2:/a", "ros2:/b", "--out", "none")
        assert done.returncode == 2
        assert "a whole number from 0 to 232" in done.stderr
