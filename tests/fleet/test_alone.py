"""One run at a time at a URL, as far as the store can: the second is told, and writes nothing."""

import os
import subprocess
import sys
import uuid
from typing import Any

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from retropole.base.files import RUNNING, leaving
from retropole.fleet import storage
from retropole.fleet.alone import alone_in
from retropole.fleet.storage import below, exists, read_bytes, remove, write_bytes


@pytest.fixture
def out() -> str:
    return f"memory://{uuid.uuid4().hex}/fleet"


def test_a_second_run_is_told_of_the_first_until_that_is_over(out: str) -> None:
    for _ in range(2):
        with alone_in(out):
            note = read_bytes(below(out, RUNNING))
            with (
                pytest.raises(BlockingIOError, match=rf"another run .* \(process {os.getpid()} on"),
                alone_in(out),
            ):
                raise AssertionError
            assert read_bytes(below(out, RUNNING)) == note
        assert storage.names_in(out) == []
    assert not leaving


def test_an_error_of_a_run_ends_it(out: str) -> None:
    with pytest.raises(KeyError), alone_in(out):
        raise KeyError
    assert not exists(below(out, RUNNING))


def test_what_a_run_left_that_was_killed_says_what_to_do(out: str) -> None:
    write_bytes(below(out, RUNNING), b"process 7 on elsewhere, since 2026-11-25 09:29 UTC\nabc\n")
    said = r"\(process 7 on elsewhere, since .* UTC\); nothing was written; .*, remove \.running "
    with pytest.raises(BlockingIOError, match=said) as caught, alone_in(out):
        raise AssertionError
    assert caught.value.filename == out
    remove(below(out, RUNNING))
    with alone_in(out):
        pass


def test_a_lock_that_was_given_to_another_is_left_to_it(out: str) -> None:
    with alone_in(out):
        write_bytes(below(out, RUNNING), b"another")
    assert read_bytes(below(out, RUNNING)) == b"another"


def test_of_two_that_saw_no_lock_one_has_it(out: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with alone_in(out):
        monkeypatch.setattr("retropole.fleet.alone.exists", lambda place: False)
        with pytest.raises(BlockingIOError, match="another run"), alone_in(out):
            raise AssertionError
        monkeypatch.undo()
        assert exists(below(out, RUNNING))


def test_a_store_without_exclusive_creation_keeps_the_later_run_away(
    out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = MemoryFileSystem.pipe_file

    def anyhow(system: Any, path: str, value: bytes, mode: str = "overwrite") -> None:
        write(system, path, value)

    monkeypatch.setattr(MemoryFileSystem, "pipe_file", anyhow)
    with alone_in(out), pytest.raises(BlockingIOError, match="another run"), alone_in(out):
        raise AssertionError


def test_a_system_that_has_folders_has_one_made(out: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def makes(system: Any, path: str, exist_ok: bool) -> None:
        made.append((path, exist_ok))

    monkeypatch.setattr(MemoryFileSystem, "makedirs", makes)
    monkeypatch.setattr(storage, "PROTOCOLS", ())
    with storage.also_following(["memory"]), alone_in(out):
        assert made == [(out.removeprefix("memory:/"), True)]


def test_a_signal_that_ends_the_process_ends_the_lock() -> None:
    script = """
import sys
from retropole.__main__ import _end
from retropole.base.files import leaving
leaving += [lambda: print("left", flush=True), lambda: 1 / 0]
_end(15, None)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (143, "left\n")
    assert done.stderr == "retropole: terminated\n"
