"""Help that fits on a screen, all of it by --help-all, and the groups of commands."""

import re

import click
import pytest

from retropole.cli import COMMANDS, GROUPS
from retropole.cli.options import Brief, Option, more_option
from tests.cli.commands import all_commands, retropole_here

MOST_OPTIONS, MOST_LINES = 12, 45

COMMAND_LINES = dict(all_commands())


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def listed(shown: str) -> list[str]:
    """The options that a help lists, by their long names."""
    lines = shown.split("\nOptions:\n")[1].split("\n\n")[0]
    return re.findall(r"^  (?:-\w, )?(--[\w-]+)", lines, flags=re.M)


@pytest.mark.parametrize("name", COMMAND_LINES)
def test_help_shows_few_options_and_help_all_all(name: str) -> None:
    command = COMMAND_LINES[name]
    options = [each for each in command.params if isinstance(each, click.Option)]
    names = {each.opts[-1] for each in options if not each.hidden} | {"--help", "--help-all"}
    brief = retropole_here(*name.split(), "--help").stdout
    whole = retropole_here(*name.split(), "--help-all")
    assert (whole.returncode, whole.stderr) == (0, "")
    assert set(listed(whole.stdout)) == names
    few = set(listed(brief)) - {"--help"}
    assert few <= names
    assert len(few) <= MOST_OPTIONS
    more = len(names) - len(few) - len({"--help", "--help-all"})
    assert brief.endswith(f"\n--help-all: {more} more\n") == (more > 0)
    assert "more\n" not in whole.stdout[-10:]


def test_help_of_calibrate_fits_on_a_screen() -> None:
    lines = retropole_here("calibrate", "--help").stdout.splitlines()
    assert len(lines) <= MOST_LINES
    assert max(map(len, lines)) <= 80


def test_what_follows_a_form_feed_is_of_the_whole_help(capsys: pytest.CaptureFixture[str]) -> None:
    @click.command(cls=Brief)
    @click.option("--often", cls=Option, help="Of use.")
    @more_option("--seldom", help="Of less use.")
    def do(**options: str) -> None:
        """Do it.

        Now.
        \f
        Or later.
        """

    do.main(["--help"], standalone_mode=False)
    brief = capsys.readouterr().out
    do.main(["--help-all"], standalone_mode=False)
    whole = capsys.readouterr().out
    for said, of_both in (("Now.", True), ("later", False), ("--often", True), ("seldom", False)):
        assert said in whole
        assert (said in brief) == of_both
    assert brief.splitlines()[-1] == "--help-all: 1 more"


def test_commands_are_under_headings() -> None:
    shown = retropole_here("--help").stdout
    for title, names in GROUPS.items():
        under = shown.split(f"\n{title}:\n")[1].split("\n\n")[0].splitlines()
        assert [line.split()[0] for line in under] == list(names)
    assert sorted(COMMANDS) == list(COMMANDS)
    assert len(set(COMMANDS)) == len(COMMANDS)
    examples = shown.split("Examples:\n")[1].split("\n\n")[0].splitlines()
    assert len(examples) == 3
