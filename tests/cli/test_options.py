"""Numbers that make no sense are bad usage, and what is said names what would."""

from __future__ import annotations

import math
from typing import Any

import click
import pytest

from retropole.cli.options import READING, SENSORS, TOPICS, run_options
from retropole.result import RunConfig
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
        (("watch", "folder:.", "folder:..", "--from", "1.2.3.4"), "the sender of packets"),
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


def config_of(*words: str) -> RunConfig:
    """Take options as commands of two LiDARs do."""

    given: list[RunConfig] = []

    @click.command()
    @run_options(*SENSORS, *TOPICS, *READING)
    def do(**options: Any) -> int:
        given.append(RunConfig(**options))
        return 0

    do.main(list(words), standalone_mode=False)
    return given[0]


@pytest.mark.parametrize(
    ("words", "older", "fields"),
    [
        ("", "", {}),
        (
            "--sensor XT32",
            "--sensor-target XT32 --sensor-source XT32",
            {"sensor_target": "XT32", "sensor_source": "XT32"},
        ),
        ("--sensor XT32 --sensor auto", "--sensor-target XT32", {"sensor_target": "XT32"}),
        ("--sensor auto --sensor XT32", "--sensor-source XT32", {"sensor_source": "XT32"}),
        (
            "--threshold 9 --threshold 120.5",
            "--threshold-target 9 --threshold-source 120.5",
            {"threshold_target": 9, "threshold_source": 120.5},
        ),
        ("--threshold auto --threshold 9", "--threshold-source 9", {"threshold_source": 9}),
        (
            "--topic /a,b --topic /c",
            "--target-topic /a,b --source-topic /c",
            {"target_topic": "/a,b", "source_topic": "/c"},
        ),
        ("--topic auto --topic /c", "--source-topic /c", {"source_topic": "/c"}),
        # Of these one value is of the target, and the source's is the target's or none.
        ("--unit mm", "--unit mm", {"unit": "mm"}),
        ("--unit mm --unit m", "--unit mm --unit-source m", {"unit": "mm", "unit_source": "m"}),
        ("--unit mm --unit auto", "--unit mm --unit-source m", {"unit": "mm", "unit_source": "m"}),
        ("--unit m --unit mm", "--unit-source mm", {"unit_source": "mm"}),
        ("--intensity echo", "--intensity echo", {"intensity": "echo"}),
        (
            "--intensity echo --intensity auto",
            "--intensity echo --intensity-source=",
            {"intensity": "echo", "intensity_source": ""},
        ),
        ("--intensity auto --intensity i", "--intensity-source i", {"intensity_source": "i"}),
        ("--angles a.csv", "--angles a.csv", {"angles": "a.csv"}),
        (
            "--angles a.csv --angles b.csv",
            "--angles a.csv --angles-source b.csv",
            {"angles": "a.csv", "angles_source": "b.csv"},
        ),
    ],
)
def test_an_option_of_both_is_given_once_or_twice_or_as_before(
    words: str, older: str, fields: dict[str, Any]
) -> None:
    assert config_of(*words.split()) == RunConfig(**fields)
    assert config_of(*older.split()) == RunConfig(**fields)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--sensor", "a", "--sensor", "b", "--sensor", "c"), "one value for both LiDARs"),
        (("--sensor", "a", "--sensor-target", "b"), "--sensor can be given twice"),
        (("--unit", "m", "--unit", "mm", "--unit-source", "ft"), "--unit can be given twice"),
        (("--threshold", "1,5"), "'1,5' is no number"),
        (("--unit", "m,mm"), "'m,mm'"),
    ],
)
def test_what_an_option_of_both_cannot_be_is_reported(words: tuple[str, ...], said: str) -> None:
    done = retropole_here("calibrate", "a", "b", *words, "--out", "none")
    assert done.returncode == 2
    assert said in done.stderr
