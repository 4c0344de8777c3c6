"""Sites on the workers of a Dask cluster: local processes, or any cluster by its address.

A task is the name of files, an answer a row; no cloud passes through the scheduler. Workers may die
and the scheduler may be started again: what was under way is given out once more.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import stat
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from ..base.errors import MissingExtraError, RetropoleError, UsageError, quoting, said
from .process import Reader
from .work import Outcome, Task, environment, unanswered

ANSWER_WITHIN = 60.0
"""Seconds that a cluster may take to have a worker, or a scheduler to be there again."""

LOOK = 0.5
"""Seconds after which futures are looked at, where none has said that it is done."""

GATHER_WITHIN = 10.0
"""Seconds for a row to come from the worker that has it, which may have died since."""

COUNT_AGAIN = 2.0
"""Seconds after which the workers are counted again: the scheduler is queried over the network."""

PER_THREAD = 2
"""Tasks that are given out for each thread of a worker: one under way, and the next."""

KEPT = 2**26
"""Bytes that are free and that a worker keeps, to use them again."""

ATTEMPTS = 3
"""How often a site is given out whose workers die or cannot work; each time, Dask gives up after
several deaths."""

Given = TypeVar("Given")
Found = TypeVar("Found")

_own = threading.local()


def run_task(data: bytes) -> bytes:
    """Calibrate one site on a worker, as bytes in and out: a worker needs no types of ours.

    Raises
    ------
    UsageError
        If the worker has other versions than the client: its numbers would not be the same.
    """
    task = msgspec.msgpack.decode(data, type=Task)
    if environment() != task.environment:
        raise UsageError(
            f"a worker has {environment()}, expected {task.environment}: install the same on all"
        )
    from distributed import get_worker

    worker = get_worker()
    reader: Reader | None = getattr(_own, "reader", None)
    if reader is None:
        limit = worker.memory_manager.memory_limit
        each = None if limit is None else int(limit) // worker.state.nthreads
        reader = _own.reader = Reader(each, worker.local_directory)
    return msgspec.msgpack.encode(reader.answer(task))


@contextmanager
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator[Any]:
    """Connect to a cluster; without an address, start one of processes on this machine.

    Whoever may give tasks to a cluster runs code as its owner. One that is started here answers on
    the loopback alone, by TLS, to who has the credential: made for it, in memory, and gone with it.

    Parameters
    ----------
    scheduler
        Address of a Dask scheduler: ``tls://host:8786``, with the credentials of the
        configuration of Dask, or ``tcp://host:8786``.
    workers
        Number of local processes; None for one per processor.

    Yields
    ------
    distributed.Client

    Raises
    ------
    MissingExtraError
        Where Dask is not installed, or what makes its credentials.
    UsageError
        If there is no scheduler at the address, or no worker; or if other users write to the
        folder of its temporary files.
    """
    try:
        import dask
        import distributed
        from dask.system import CPU_COUNT

        temporary: Any = distributed.Security.temporary
        credentials = None if scheduler else temporary()
    except ImportError:
        raise MissingExtraError("fleet", "a fleet") from None
    # The result of a site is in its row; the log of a worker that died helps nobody.
    config: dict[str, Any] = {
        "logging": {"distributed": "critical", "asyncio": "critical"},
        "distributed.worker.multiprocessing-method": "spawn",
        # A hundred times a second it would note what the worker does: it waits.
        "distributed.worker.profile.enabled": False,
        # Servers of pages and metrics run all the same, and require no credential: no pages.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # With Dask's setting, each large array that is freed is given back, and the pages of the
        # next are cleared: of the replay of a history half as much time again.
        "distributed.nanny.pre-spawn-environ": {
            **dask.config.get("distributed.nanny.pre-spawn-environ"),
            "MALLOC_TRIM_THRESHOLD_": KEPT,
            "MALLOC_MMAP_THRESHOLD_": KEPT // 2,
        },
        "temporary-directory": dask.config.get("temporary-directory", None) or _own_folder(),
    }
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    # Neither is typed.
    local: Any = distributed.LocalCluster
    of: Any = distributed.Client
    with dask.config.set(config):
        if scheduler is None:
            with _leftovers_unsaid():
                with _interrupts_are_ours():
                    started = local(
                        n_workers=CPU_COUNT if workers is None else workers,
                        threads_per_worker=1,
                        processes=True,
                        security=credentials,
                        dashboard_address=None,
                        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                        silence_logs=logging.CRITICAL,
                    )
                with started as cluster, of(cluster, set_as_default=False) as client:
                    yield client
            return
        try:
            client = of(scheduler, timeout=ANSWER_WITHIN, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UsageError(f"{scheduler}: no Dask scheduler answers ({said(error)})") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=ANSWER_WITHIN)
            except TimeoutError:
                raise UsageError(f"{scheduler}: the cluster has no worker") from None
            yield client


def _own_folder() -> str:
    """Name a folder for temporary files that no other user writes to: Dask imports from there.

    Raises
    ------
    UsageError
        If another user has it.
    """
    if not hasattr(os, "getuid"):
        # Where each user has a folder for temporary files.
        return tempfile.gettempdir()
    folder = Path(tempfile.gettempdir(), f"retropole-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o022:
        raise UsageError(f"{folder}: other users write to it; remove it, or set TMPDIR")
    return str(folder)


def mapped(
    client: Any, function: Callable[[Given], Found], given: Iterable[Given]
) -> Iterator[Found]:
    """Apply a function to each of some on the workers, in their order; here where that fails."""
    most = PER_THREAD * _threads(client)
    waiting: deque[tuple[Given, Any]] = deque()

    def first() -> Found:
        one, future = waiting.popleft()
        with suppress(Exception):
            found: Found = future.result()
            return found
        return function(one)

    for one in given:
        waiting.append((one, client.submit(function, one, pure=False)))
        if len(waiting) >= most:
            yield first()
    while waiting:
        yield first()


@contextmanager
def _interrupts_are_ours() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all processes, from those that are started here.

    Threads and processes inherit what is blocked. One that comes meanwhile is handled afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _leftovers_unsaid() -> Iterator[None]:
    """Have the process that cleans up after an interrupt do so in silence."""
    silent = "ignore::UserWarning:multiprocessing.resource_tracker"
    # It is started with the options that this process has.
    sys.warnoptions.append(silent)
    try:
        yield
    finally:
        sys.warnoptions.remove(silent)


def outcomes(client: Any, tasks: Iterator[Task]) -> Iterator[Outcome]:
    """Have the workers of a cluster do tasks, and give the outcome of each as it comes.

    Parameters
    ----------
    client
        As `connected` gives it.
    tasks
        Taken as there is room: few are given out at a time.

    Raises
    ------
    UsageError
        Where workers have other versions, or lack retropole.
    RetropoleError
        If the scheduler is gone for good.
    """
    given: dict[Any, tuple[Task, int]] = {}
    again: list[tuple[Task, int]] = []
    done = threading.Event()
    threads, counted = 0, -math.inf
    try:
        while True:
            if client.status != "running" or time.monotonic() > counted + COUNT_AGAIN:
                threads, counted = _threads(client), time.monotonic()
            room = PER_THREAD * threads - len(given)
            fresh = islice(tasks, max(0, room - len(again)))
            again += [(task, 1) for task in fresh]
            while again:
                future = _given(client, again[-1][0])
                if future is None:
                    break
                given[future] = again.pop()
                future.add_done_callback(lambda future: done.set())
            if not given and not again:
                return
            done.wait(LOOK)
            done.clear()
            for future in [each for each in given if each.status != "pending"]:
                task, attempts = given.pop(future)
                outcome = _outcome(future, task, attempts)
                if outcome is None:
                    # Of a scheduler that was started again, it is no matter of the site.
                    again.append((task, attempts + (future.status == "error")))
                else:
                    yield outcome
    finally:
        for future in given:
            with suppress(Exception):
                future.cancel()


def _threads(client: Any) -> int:
    """Count the threads of all workers, 1 at least; wait for a scheduler that was started again.

    Raises
    ------
    RetropoleError
        If it stays away.
    """
    deadline = time.monotonic() + ANSWER_WITHIN
    while True:
        if client.status == "running":
            try:
                return max(1, int(sum(client.nthreads().values())))
            except (OSError, TypeError, ValueError):
                # The connection broke meanwhile.
                pass
        if client.status == "closed" or time.monotonic() > deadline:
            raise RetropoleError(
                f"the Dask scheduler is gone for {ANSWER_WITHIN:g} s; the partitions that are "
                "written are whole, and the same command continues"
            )
        time.sleep(LOOK)


def _given(client: Any, task: Task) -> Any:
    """Give a task out; None if the connection broke meanwhile."""
    try:
        return client.submit(run_task, msgspec.msgpack.encode(task), pure=False)
    except Exception:
        if client.status == "running":
            raise
        return None


def _outcome(future: Any, task: Task, attempts: int) -> Outcome | None:
    """Process the outcome of a task; None if it is to be repeated."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm.core import CommClosedError

    if future.status in ("cancelled", "lost"):
        return None
    try:
        return msgspec.msgpack.decode(future.result(timeout=GATHER_WITHIN), type=Outcome)
    except (CancelledError, CommClosedError, TimeoutError):
        return None
    except UsageError:
        raise
    except KilledWorker:
        why = "its workers died repeatedly"
    except (RetropoleError, OSError, MemoryError) as error:
        why = f"its workers cannot work: {quoting(said(error))}"
    except Exception as error:
        message = quoting(f"{type(error).__name__}: {said(error)}")
        raise UsageError(f"a worker cannot do the work: {message}") from None
    return unanswered(task.site, "worker_lost", why) if attempts >= ATTEMPTS else None
