"""What all commands share: help, errors and refusals, and that each is loaded on its own."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.reasons import page, plain, reasons
from retropole.cli import COMMANDS, cli
from retropole.io import write_pcd
from tests.cli.commands import retropole_here
from tests.paths import PACKAGE
from tests.tiers import first_of


@pytest.mark.full
def test_no_intensity_never_gives_a_transform(
    clouds: tuple[PointCloud, PointCloud], tmp_path: Path
) -> None:
    write_pcd(tmp_path / "a.pcd", PointCloud(clouds[0].xyz))
    write_pcd(tmp_path / "b.pcd", clouds[1])
    done = retropole_here("calibrate", "a.pcd", "b.pcd", cwd=tmp_path)
    assert done.returncode == 3
    assert "no_intensity" in done.stderr
    assert retropole_here("detect", "a.pcd", cwd=tmp_path).returncode == 3


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "missing.pcd", "missing.pcd"),
        ("calibrate", "only-one.pcd"),
        ("calibrate", "a.pcd", "b.pcd", "--radius", "-1"),
        ("calibrate", "a.pcd", "b.pcd", "--poles", "0"),
        ("calibrate", "a.pcd", "b.pcd", "--sensor", "nonsense"),
        ("detect", "missing.pcd"),
        ("info", "missing.bag"),
        ("info", "missing.pcd", "--frames", "1:x"),
        ("detect", "missing.pcd", "--frames", "::0"),
        ("nonsense",),
    ],
)
def test_bad_usage_exits_with_2_and_one_reason(words: tuple[str, ...], tmp_path: Path) -> None:
    done = retropole_here(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip()
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == [], "nothing is written"


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e30", "-1", "0"])
@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("calibrate", "a", "b"), "--radius"),
        (("calibrate", "a", "b"), "--prior-sigma-deg"),
        (("calibrate", "a", "b"), "--threshold"),
        (("check", "r", "a", "b"), "--sigma-deg"),
        (("check", "r", "a", "b"), "--tolerance-m"),
        (("detect", "a"), "--threshold"),
        (("evaluate", "a", "b"), "--sigma"),
        (("simulate", "street"), "--radius"),
    ],
)
def test_a_number_beyond_its_bounds_is_bad_usage(
    command: tuple[str, ...], option: str, value: str
) -> None:
    done = retropole_here(*command, option, value)
    assert done.returncode == 2
    assert option in done.stderr


@pytest.mark.parametrize("command", [("calibrate", "a", "b"), ("simulate", "street")])
def test_a_radius_in_millimetres_is_reported(command: tuple[str, ...]) -> None:
    done = retropole_here(*command, "--radius", "20")
    assert done.returncode == 2
    assert "20 m is not the radius of a pole; 20 mm? give 0.02" in done.stderr


def paths(command: click.Command, *names: str) -> Iterator[tuple[str, ...]]:
    """The words of a command and of all that are in it, groups and their commands."""
    yield names
    for name, inner in command.commands.items() if isinstance(command, click.Group) else ():
        yield from paths(inner, *names, name)


PATHS = list(paths(cli))
GROUPS = [(), ("fleet",), ("site",)]


def test_groups_are_those_that_are_tried() -> None:
    assert set(PATHS) >= {*GROUPS, ("site", "check"), ("fleet", "network"), ("simulate", "site")}
    assert len(PATHS) > len(COMMANDS) + 8


@pytest.mark.parametrize("words", PATHS, ids=" ".join)
def test_bare_commands_are_bad_usage(words: tuple[str, ...], tmp_path: Path) -> None:
    done = retropole_here(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "\\n" not in done.stderr
    if words in GROUPS:
        assert done.stderr == retropole_here(*words, "--help").stdout
    else:
        error, what_to_do = done.stderr.splitlines()
        assert error.startswith("retropole: error: ")
        assert f"'{' '.join(['retropole', *words])} --help'" in what_to_do
    assert list(tmp_path.iterdir()) == [], "nothing is written"


@pytest.mark.parametrize("words", PATHS, ids=" ".join)
def test_help_has_worked_examples(words: tuple[str, ...]) -> None:
    done = retropole_here(*words, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done == retropole_here(*words, "-h")
    typed = " ".join(["retropole", *words])
    assert done.stdout.startswith(f"Usage: {typed} ")
    if words:
        assert f"{typed} " in done.stdout.split("Examples:")[1]


def test_every_command_is_a_module_of_its_name() -> None:
    modules = {path.stem for path in (PACKAGE / "cli").glob("*.py")}
    fleet = cli.commands["fleet"]
    assert isinstance(fleet, click.Group)
    inner = {f"fleet_{name}" for name in fleet.commands} & modules
    assert len(inner) == 2
    others = {"__init__", "common", "errors", "live_merge", "options", "out"} | inner
    assert set(COMMANDS) == modules - others == set(cli.commands)
    for name, command in cli.commands.items():
        assert isinstance(command, click.Command)
        assert command.name == name
    assert "nonsense" not in cli.commands
    shown = retropole_here("--help").stdout
    assert all(f"\n  {name} " in shown for name in COMMANDS)


def test_a_command_is_loaded_on_its_own() -> None:
    code = (
        "import sys; from retropole.cli import run; run(['info', '--help']); "
        "print([m for m in sys.modules if m.startswith('retropole.cli.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (
        done.stdout.splitlines()[-1]
        == "['retropole.cli.common', 'retropole.cli.errors', 'retropole.cli.options', "
        "'retropole.cli.info']"
    )


def test_version_is_that_of_the_package() -> None:
    done = retropole_here("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("retropole, version ")


@pytest.mark.full
@pytest.mark.parametrize("command", ["calibrate", "detect"])
def test_a_refusal_says_why_what_to_do_and_where_to_read_on(
    command: str, clouds: tuple[PointCloud, PointCloud], tmp_path: Path
) -> None:
    files = [tmp_path / "a.pcd", tmp_path / "b.pcd"][: 2 if command == "calibrate" else 1]
    for path, cloud in zip(files, clouds, strict=False):
        write_pcd(path, PointCloud(cloud.xyz))
    done = retropole_here(command, *files, "--out", tmp_path / "r", "-q")
    assert done.returncode == 3
    assert done.stdout == ""
    why, *what_to_do, where = done.stderr.splitlines()
    assert why.startswith("retropole: refused (no_intensity): ")
    advice = [plain(action) for action in reasons()["no_intensity"].advice]
    assert what_to_do[0] == f"what to do: {advice[0]}"
    assert [line.strip() for line in what_to_do[1:]] == advice[1:]
    assert where == f"read on: {page('no_intensity')}"


@pytest.mark.parametrize(
    ("typed", "offered"),
    first_of(
        [
            (["check", "--tol"], {"--tolerance-deg", "--tolerance-m"}),
            (["cal"], {"calibrate"}),
            (["export", "r", "--to", "ros"], {"ros1", "ros2"}),
            (["calibrate", "--sensor", "VLP-16", "--sensor", "xt"], {"XT32"}),
            (["calibrate", "--unit", "m", "--unit", ""], {"m", "cm", "mm", "ft", "in"}),
            (["calibrate", "--trust"], {"--trust-poles"}),
            (["calibrate", "--sensor-"], {""}),
        ]
    ),
)
def test_the_shell_completes_commands_options_and_choices(
    typed: list[str], offered: set[str]
) -> None:
    words = ["retropole", *typed]
    asked = {
        "_RETROPOLE_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(typed)),
    }
    done = subprocess.run(
        [sys.executable, "-c", "from retropole.__main__ import main; main()"],
        env=os.environ | asked,
        capture_output=True,
        text=True,
    )
    assert {line.partition(",")[2] for line in done.stdout.splitlines()} == offered
