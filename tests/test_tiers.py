"""Which tier runs which test, and that the default one keeps its budget: in suites of three tests.

They have the options of this project, and its hooks.
"""

from __future__ import annotations

import re
import shlex
import tomllib

import pytest

from tests import tiers
from tests.paths import ROOT

pytest_plugins = ["pytester"]

OPTIONS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]

SUITE = """
import pytest

def test_default():
    sum(range(10**6))

@pytest.mark.full
def test_full():
    pass

@pytest.mark.nightly
def test_nightly():
    pass

@pytest.mark.full
@pytest.mark.nightly
def test_both():
    pass
"""


@pytest.fixture
def suite(pytester: pytest.Pytester) -> pytest.Pytester:
    lines = ["[pytest]", f"addopts = {OPTIONS['addopts']} -p no:cacheprovider", "markers ="]
    pytester.makeini("\n".join([*lines, *(f"    {marker}" for marker in OPTIONS["markers"])]))
    pytester.makeconftest(
        "from tests.tiers import Tiers\n"
        "def pytest_configure(config):\n"
        "    config.pluginmanager.register(Tiers(config), 'tiers')\n"
    )
    pytester.makepyfile(SUITE)
    return pytester


DEFAULT, FULL, NIGHTLY = {"test_default"}, {"test_full"}, {"test_nightly", "test_both"}


@pytest.mark.parametrize(
    ("words", "run"),
    [
        ("", DEFAULT),
        ("-m full", FULL),
        ("-m ''", DEFAULT | FULL),
        ("-m nightly", NIGHTLY),
        ("-m 'full or nightly'", FULL | NIGHTLY),
        ("-k full", set()),
    ],
)
def test_a_tier_runs_what_is_its_own(words: str, run: set[str], suite: pytest.Pytester) -> None:
    passed, skipped, failed = suite.inline_run(*shlex.split(words)).listoutcomes()
    assert {report.nodeid.partition("::")[2] for report in passed} == run
    assert (len(passed), skipped, failed) == (len(run), [], [])


def test_the_default_tier_fails_beyond_its_budget_and_lists_what_cost_most(
    suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiers, "BUDGET_S", 0.0)
    done = suite.runpytest_inprocess()
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.assert_outcomes(passed=1, deselected=3)
    done.stdout.fnmatch_lines(
        ["*The default tier may take 0 s*", "*?.? s  *::test_default", "*1 passed*"]
    )
    for words in (["-m", ""], ["-m", "full"], ["-m", "nightly"]):
        assert suite.runpytest_inprocess(*words).ret == 0, "the budget is of the default tier"
    monkeypatch.setattr(tiers, "BUDGET_S", 1e6)
    done = suite.runpytest_inprocess()
    assert done.ret == 0
    done.stdout.no_fnmatch_line("*may take*")


def test_a_slow_machine_may_take_longer(
    suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiers, "BUDGET_S", 1e-6)
    monkeypatch.setattr(tiers, "REFERENCE_S", 1e6)
    assert tiers.slowness() == 1.0, "a fast one no shorter"
    assert suite.runpytest_inprocess().ret == pytest.ExitCode.TESTS_FAILED
    monkeypatch.setattr(tiers, "REFERENCE_S", 1e-12)
    assert suite.runpytest_inprocess().ret == 0


@pytest.mark.full
def test_processes_of_workers_count(
    suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tiers.Tiers] = []

    class Kept(tiers.Tiers):
        def __init__(self, config: pytest.Config) -> None:
            super().__init__(config)
            found.append(self)

    monkeypatch.setattr(tiers, "Tiers", Kept)
    monkeypatch.setattr(tiers, "BUDGET_S", 0.0)
    done = suite.runpytest_inprocess("-n", "2")
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.assert_outcomes(passed=1)
    done.stdout.fnmatch_lines(["*The default tier may take 0 s*", "*?.? s  *::test_default"])
    (own,) = found
    assert own.workers_s > 0.1, "two interpreters have started"
    assert sum(own.by_test.values()) < own.workers_s


def test_the_documents_name_tiers_that_exist() -> None:
    names = {marker.partition(":")[0] for marker in OPTIONS["markers"]}
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    said = re.findall(r"""pytest(?: -[\w ]+)? -m ('[^']*'|"[^"]*"|\w+)""", text)
    assert len(said) > 5
    words = {word for each in said for word in each.strip("'\"").split()}
    assert words - {"or", "and", "not"} == names
