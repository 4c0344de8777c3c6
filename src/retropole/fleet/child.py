"""The process that reads and calibrates: it may hang, crash or run out of memory.

``python -m retropole.fleet.child`` takes tasks on its standard input and answers on its standard
output, one after the other; `process` starts it. It ends when its input does.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import IO

import msgspec

from .history.check import check_site
from .work import Hashed, Outcome, Task, answer

LENGTH = struct.Struct("<I")
Message = Hashed | Outcome | None
"""None: started, and ready for a task."""


def done(task: Task, tell: Callable[[Hashed], None] = lambda hashed: None) -> Outcome:
    """Do a task: check a site against its stored result, or calibrate it as `work.answer` does."""
    if task.check is None:
        return answer(task, tell)
    return Outcome(task.site.id, check=check_site(task.site, task.check, tell))


def send(stream: IO[bytes], message: object) -> None:
    """Write a message with its length before it."""
    data = msgspec.msgpack.encode(message)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def receive(stream: IO[bytes]) -> bytes | None:
    """Read a message; None where the other end has gone, in the middle of one as well."""
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
    from ..api import calibration, site  # noqa: F401

    send(answers, None)
    while True:
        task = msgspec.msgpack.decode(tasks.get(), type=Task)
        send(answers, done(task, lambda hashed: send(answers, hashed)))


if __name__ == "__main__":
    main()
