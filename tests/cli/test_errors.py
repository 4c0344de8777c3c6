"""What ends a command without an answer is said in one style, and is JSON where that is asked."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, UsageError
from retropole.base.reasons import reasons
from retropole.cli import COMMANDS, run
from retropole.cli.common import in_colour
from retropole.cli.errors import asks_for_json, failure_of
from tests.cli.commands import retropole_here

WITH_JSON = {
    "calibrate": ("nothing.pcd", "nothing.pcd"),
    "check": ("nothing", "nothing.pcd", "nothing.pcd"),
    "detect": ("nothing.pcd",),
    "evaluate": ("nothing.pcd", "nothing.pcd", "--transform", "nothing.json"),
    "info": ("nothing.pcd",),
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def said(stdout: str, code: str, status: str) -> dict[str, object]:
    assert stdout.count("\n") == 1
    document = json.loads(stdout)
    assert document["schema"] == "retropole/error/1"
    assert document["status"] == status
    error = document["error"]
    assert set(error) == {"code", "message", "what_to_do", "read_on"}
    assert error["code"] == code
    assert error["message"]
    assert error["what_to_do"]
    assert isinstance(error, dict)
    return error


@pytest.mark.parametrize("command", WITH_JSON)
def test_with_json_an_error_is_one_object_on_stdout(command: str) -> None:
    done = retropole_here(command, *WITH_JSON[command], "--json")
    assert done.returncode == 2
    # A transform that is not there is the system's own error.
    code = "system" if command in ("check", "evaluate") else "unreadable"
    error = said(done.stdout, code, "error")
    assert str(error["message"]) in done.stderr
    done = retropole_here(command, "--json", "--no-such-option")
    assert done.returncode == 2
    said(done.stdout, "usage", "error")


@pytest.mark.parametrize("command", WITH_JSON)
def test_without_json_stdout_is_empty_and_stderr_says_what_to_do(command: str) -> None:
    done = retropole_here(command, *WITH_JSON[command])
    assert (done.returncode, done.stdout) == (2, "")
    first, second = done.stderr.splitlines()
    assert first.startswith("retropole: error: nothing")
    assert second.startswith("what to do: ")


def test_with_json_a_refusal_is_one_object_on_stdout(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    np.savetxt(tmp_path / "dark.xyz", points)
    done = retropole_here("detect", tmp_path / "dark.xyz", "--json")
    assert done.returncode == 3
    error = said(done.stdout, "no_intensity", "refused")
    assert error["read_on"] == "docs/reasons.md#no_intensity"
    whole = retropole_here("calibrate", "--json", *[tmp_path / "dark.xyz"] * 2, cwd=tmp_path)
    assert whole.returncode == 3
    assert json.loads(whole.stdout)["status"] == "refused"


@pytest.mark.parametrize("command", COMMANDS)
def test_bad_usage_names_the_command_whose_help_to_read(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([command, "--no-such-option"]) == 2
    assert f"what to do: 'retropole {command} --help'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UsageError("no"), "usage"),
        (ReadError("no"), "unreadable"),
        (MissingExtraError("ros", "reading bags"), "missing_extra"),
        (RetropoleError("no"), "usage"),
        (MemoryError("no"), "out_of_memory"),
        (OSError(28, "No space left on device", "r"), "system"),
    ],
)
def test_every_kind_of_error_says_what_to_do(error: Exception, code: str) -> None:
    failure = failure_of(error, "retropole info")
    assert failure.code == code
    assert failure.message
    assert all(failure.what_to_do)
    assert failure.what_to_do


def test_a_refusal_gives_the_advice_of_its_code() -> None:
    failure = failure_of(Refusal("parallel_poles", "they are", {}), "retropole calibrate")
    assert failure.code == "parallel_poles"
    assert len(failure.what_to_do) == len(reasons()["parallel_poles"].advice)


@pytest.mark.parametrize(
    ("words", "asked"),
    [(["info", "a", "--json"], True), (["info", "a"], False), (["info", "--", "--json"], False)],
)
def test_json_is_requested_before_the_arguments_end(words: list[str], asked: bool) -> None:
    assert asks_for_json(words) is asked


@pytest.mark.parametrize(
    ("terminal", "env", "coloured"),
    [
        (True, {}, True),
        (False, {}, False),
        (True, {"NO_COLOR": "1"}, False),
        (True, {"NO_COLOR": ""}, True),
        (True, {"TERM": "dumb"}, False),
    ],
)
def test_the_verdict_is_in_colour_on_a_terminal_that_wants_it(
    terminal: bool, env: dict[str, str], coloured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    words = in_colour("verdict: ok\nthe rest", "ok")
    assert words.endswith("\nthe rest")
    assert ("\x1b[" in words.splitlines()[0]) is coloured
    assert coloured or words == "verdict: ok\nthe rest"


@pytest.mark.parametrize("words", [("simulate",), ("simulate", "site")])
def test_what_is_missing_is_named_with_its_choices_in_one_line(words: tuple[str, ...]) -> None:
    done = retropole_here(*words)
    assert done.returncode == 2
    assert "Missing argument" in done.stderr.splitlines()[0]
    assert "\\" not in done.stderr
