"""Which tests run when, and what the default tier may cost.

Three tiers. *Default*: what `pytest` runs. *Full*: the tests marked `full`, which `.ci/run` runs
after the default ones. *Nightly*: what takes too long for `.ci/run`; runs only where `-m` names it.
`pytest -m ''` runs everything but the nightly tests.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable
from statistics import median
from time import process_time
from typing import Any

import pytest

BUDGET_S = 240.0
"""CPU time that the default tier may take: all processes of pytest, collecting included. On a
machine that computes more slowly than the one it was set on it may take as much longer."""

REFERENCE_S = 0.015
"""What `slowness` measures on that machine while both of its cores run tests, s."""

LISTED = 10
"""Tests that are listed where the budget is exceeded, those that cost most."""


def first_of(cases: Iterable[Any], count: int = 1) -> list[Any]:
    """Let the first of all cases run by default, the others in the full tier.

    For cases that take long, of which one shows most of what all do. A tuple is one case of several
    arguments.
    """
    several = [case if isinstance(case, tuple) else (case,) for case in cases]
    full = [pytest.param(*case, marks=pytest.mark.full) for case in several[count:]]
    return [*(pytest.param(*case) for case in several[:count]), *full]


def cpu_s() -> float:
    """CPU time of this process and of those of its children that have ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def slowness() -> float:
    """By how much this machine computes more slowly than the one `BUDGET_S` was set on, from 1 on.

    The same machine may take twice the CPU time when others share its cores.
    """
    spent = []
    for _ in range(5):
        before, total = process_time(), 0
        for k in range(500_000):
            total += k
        spent.append(process_time() - before)
    return max(1.0, float(median(spent)) / REFERENCE_S)


class Tiers:
    """Leaves nightly tests out, and fails a run of the default tier that costs too much.

    Each worker of pytest-xdist measures its own processes; the run that started it adds them up.
    """

    def __init__(self, config: pytest.Config) -> None:
        self.is_default = config.option.markexpr == "not full and not nightly"
        self.by_test: dict[str, float] = {}
        self.workers_s = 0.0
        self.slower: list[float] = []
        self.spent_s = self.last_s = cpu_s()

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        if "nightly" in config.option.markexpr:
            return
        nightly = [item for item in items if item.get_closest_marker("nightly")]
        if nightly:
            config.hook.pytest_deselected(items=nightly)
            items[:] = [item for item in items if not item.get_closest_marker("nightly")]

    def pytest_collection_finish(self) -> None:
        if self.is_default:
            self.slower.append(slowness())
        self.last_s = cpu_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, Any, Any]:
        """Keep with each phase of a test what it took; fixtures count where they were made."""
        report = yield
        now = cpu_s()
        report.cpu_s, self.last_s = now - self.last_s, now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        before_s = self.by_test.get(report.nodeid, 0.0)
        self.by_test[report.nodeid] = before_s + getattr(report, "cpu_s", 0.0)

    def pytest_testnodedown(self, node: Any) -> None:
        output = getattr(node, "workeroutput", {})
        self.workers_s += output.get("cpu_s", 0.0)
        self.slower += output.get("slower", [])

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.is_default:
            self.slower.append(slowness())
        # Workers that have ended are children of this process: they are counted once.
        used = os.times()
        own_s = used.user + used.system if self.workers_s else cpu_s()
        self.spent_s = own_s + self.workers_s
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["cpu_s"], output["slower"] = self.spent_s, self.slower
        elif self.exceeded:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @property
    def budget_s(self) -> float:
        return BUDGET_S * (float(median(self.slower)) if self.slower else 1.0)

    @property
    def exceeded(self) -> bool:
        return self.is_default and self.spent_s > self.budget_s

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        write = terminalreporter.write_line
        write(f"{self.spent_s:.0f} s of CPU time")
        if self.exceeded:
            write(f"The default tier may take {self.budget_s:.0f} s. The tests that cost most:")
            for name, spent in sorted(self.by_test.items(), key=lambda each: -each[1])[:LISTED]:
                write(f"{spent:7.1f} s  {name}")
