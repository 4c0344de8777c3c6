"""Calibrating in a separate process, which is ended where it takes too long or too much.

It may stall, crash or run out of memory. ``python -m retropole.fleet.process`` takes tasks on its
standard input and answers on its standard output, one after the other; `Reader` starts it. It ends
when its input does.
"""

from __future__ import annotations

import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from typing import IO

import msgspec

from ..base.errors import RetropoleError
from .history.check import check_site
from .storage import also_following
from .work import Hashed, Outcome, Task, answer, unanswered

LENGTH = struct.Struct("<I")
Message = Hashed | Outcome | None
"""None: started, and ready for a task."""


def done(task: Task, report: Callable[[Hashed], None] = lambda hashed: None) -> Outcome:
    """Do a task: check a site against its stored result, or calibrate it as `work.answer` does."""
    with also_following(task.protocols):
        if task.check is None:
            return answer(task, report)
        return Outcome(task.site.id, check=check_site(task.site, task.check, report))


def send(stream: IO[bytes], message: object) -> None:
    """Write a message with its length before it."""
    data = msgspec.msgpack.encode(message)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def receive(stream: IO[bytes]) -> bytes | None:
    """Read a message; None if the other end has gone, in the middle of one as well."""
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (length,) = LENGTH.unpack(head)
    data = stream.read(length)
    return data if len(data) == length else None


def main() -> None:
    """Answer tasks until there are no more."""
    # An interrupt is for whoever started this; it then closes our input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    # What a library prints is no answer.
    os.dup2(2, 1)
    tasks: SimpleQueue[bytes] = SimpleQueue()

    def listen() -> None:
        while (data := receive(sys.stdin.buffer)) is not None:
            tasks.put(data)
        # Nobody waits for an answer any more, however long it still takes.
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    # No site pays for what all of them need.
    from ..api import calibration  # noqa: F401

    send(answers, None)
    while True:
        task = msgspec.msgpack.decode(tasks.get(), type=Task)
        send(answers, done(task, lambda hashed: send(answers, hashed)))


if __name__ == "__main__":
    main()


ATTEMPTS = 3
"""How often a site is tried whose process is ended by the system: a machine that is short of memory
ends any, a file that crashes its reader does so each time."""

STARTING = 300.0
"""Seconds in which the process has started; it takes about one, and on a machine that is overloaded
a hundred times that."""

LOOK = 0.1
"""Seconds between looks at the clock and the memory."""


class Reader:
    """A process that calibrates one site after the other, and is started again where it ended.

    Parameters
    ----------
    memory
        Bytes that it may hold; None for any number.
    folder
        Where its copies of files go; None for the system's.
    """

    def __init__(self, memory: int | None = None, folder: str | None = None) -> None:
        self.memory = memory
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._copies: str | None = None

    def answer(self, task: Task) -> Outcome:
        """Calibrate a site as `work.answer` does, within a time and a memory.

        Raises
        ------
        RetropoleError
            If no such process can be started.
        """
        started, attempts = time.monotonic(), 0
        outcome, why = None, list[tuple[str, str]]()
        while outcome is None and not why and attempts < ATTEMPTS:
            hashed, outcome, why = self._try(task)
            attempts += 1
        if outcome is None:
            killed = "killed", f"its process was ended by the system or crashed, {ATTEMPTS} times"
            code, message = next(iter(why), killed)
            outcome = unanswered(task.site, code, message, hashed, time.monotonic() - started)
        run = outcome.run and msgspec.structs.replace(outcome.run, attempts=attempts)
        return msgspec.structs.replace(outcome, run=run)

    def _try(self, task: Task) -> tuple[Hashed | None, Outcome | None, list[tuple[str, str]]]:
        """Have the process calibrate it: the outcome, or why it was ended, or neither."""
        process = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        hashed = None
        with self._watched(process, task.time_limit) as why, suppress(OSError):
            send(process.stdin, task)
            while (data := receive(process.stdout)) is not None:
                message = msgspec.msgpack.decode(data, type=Message)
                if isinstance(message, Outcome):
                    return hashed, message, []
                hashed = message
        self.close()
        return hashed, None, why

    def _running(self) -> subprocess.Popen[bytes]:
        """Give the process, started where it is not."""
        if self._process is not None and self._process.poll() is None:
            return self._process
        self.close()
        command = [sys.executable, "-m", "retropole.fleet.process"]
        self._copies = tempfile.mkdtemp(prefix="retropole-", dir=self.folder)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **dict.fromkeys(("TMPDIR", "TEMP", "TMP"), self._copies)},
        )
        process = self._process
        assert process.stdout is not None
        with self._watched(process, STARTING):
            ready = receive(process.stdout)
        if ready is None:
            self.close()
            raise RetropoleError(f"{' '.join(command)} does not start")
        return process

    @contextmanager
    def _watched(
        self, process: subprocess.Popen[bytes], limit: float
    ) -> Iterator[list[tuple[str, str]]]:
        """End a process that takes too long or too much; the outcome gives the reason."""
        import psutil

        why: list[tuple[str, str]] = []
        over, deadline = threading.Event(), time.monotonic() + limit

        def watch() -> None:
            with suppress(psutil.NoSuchProcess):
                watched = psutil.Process(process.pid)
                while not over.wait(LOOK):
                    if time.monotonic() > deadline:
                        why.append(("time_limit", f"not done within {limit:g} s"))
                    elif self.memory is not None and watched.memory_info().rss > self.memory:
                        message = f"took more memory than {self.memory / 2**30:.1f} GiB"
                        why.append(("out_of_memory", message))
                    if why:
                        process.kill()
                        return

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield why
        finally:
            over.set()
            thread.join()

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        # Closes its streams and waits; what was not sent can no longer be.
        with suppress(OSError), process:
            pass
        if self._copies is not None:
            shutil.rmtree(self._copies, ignore_errors=True)
