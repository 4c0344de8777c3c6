"""A process that hangs, dies or takes too much costs one row."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from retropole.fleet.process import ATTEMPTS, Reader
from retropole.fleet.sites import FleetSite, find_sites
from retropole.fleet.work import Outcome, Task, answer, environment

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def reader() -> Iterator[Reader]:
    reader = Reader()
    yield reader
    reader.close()


@pytest.fixture
def site(fleet: Path) -> FleetSite:
    return next(each for each in find_sites([str(fleet)]) if each.id == "small/1")


def task_of(site: FleetSite, limit: float = 60.0) -> Task:
    return Task(site=site, time_limit=limit, environment=environment())


def process_of(reader: Reader) -> int:
    assert reader._process is not None
    return reader._process.pid


def code_of(outcome: Outcome) -> str:
    assert outcome.row is not None
    assert outcome.row.status == "error"
    return outcome.row.codes[0]


def test_it_answers_as_this_process_does(reader: Reader, site: FleetSite) -> None:
    assert reader.answer(task_of(site)).row == answer(task_of(site)).row
    first = process_of(reader)
    reader.answer(task_of(site))
    assert process_of(reader) == first


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="the system has no SIGSTOP")
def test_what_hangs_is_ended(reader: Reader, site: FleetSite) -> None:
    reader.answer(task_of(site))
    os.kill(process_of(reader), signal.SIGSTOP)
    outcome = reader.answer(task_of(site, limit=0.3))
    assert code_of(outcome) == "time_limit"
    assert outcome.row is not None
    assert outcome.row.messages == ["not done within 0.3 s"]
    assert reader.answer(task_of(site)).row == answer(task_of(site)).row


def test_what_dies_is_tried_again_but_not_for_ever(
    reader: Reader, site: FleetSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = reader._running
    started = []

    def dying() -> object:
        process = running()
        started.append(process.pid)
        process.kill()
        process.wait()
        return process

    monkeypatch.setattr(reader, "_running", dying)
    outcome = reader.answer(task_of(site))
    assert code_of(outcome) == "killed"
    assert outcome.run is not None
    assert len(started) == outcome.run.attempts == ATTEMPTS
    monkeypatch.undo()
    assert reader.answer(task_of(site)).row == answer(task_of(site)).row


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="the system has no SIGSTOP")
def test_what_takes_too_much_is_ended(site: FleetSite) -> None:
    reader = Reader()
    try:
        reader.answer(task_of(site))
        # It stands still, so that it is looked at before it is done.
        reader.memory = 2**20
        os.kill(process_of(reader), signal.SIGSTOP)
        assert code_of(reader.answer(task_of(site))) == "out_of_memory"
    finally:
        reader.close()


def test_it_ends_with_whoever_started_it(reader: Reader, site: FleetSite) -> None:
    reader.answer(task_of(site))
    process = reader._process
    assert process is not None
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(timeout=60) == 0
