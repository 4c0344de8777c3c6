"""Dask's workers give the bytes that one process gives; what dies is given out again."""

from __future__ import annotations

import os
import socket
import ssl
import stat
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
from distributed import KilledWorker, Security

from retropole.base.errors import RetropoleError, UsageError
from retropole.fleet import engine
from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.engine import connected, mapped, outcomes, run_task
from retropole.fleet.sites import FleetSite, find_sites
from retropole.fleet.work import Task, environment, unanswered
from tests.fleet.fleets import bytes_of, here, shuffled


class _Client:
    """Workers of which every third dies."""

    status = "running"

    def __init__(self) -> None:
        self.given: list[int] = []

    def nthreads(self) -> dict[str, int]:
        return {"a": 1, "b": 1}

    def submit(self, function: Callable[[int], int], one: int, pure: bool) -> _Client:
        self.given.append(one)
        return self

    def result(self) -> int:
        if len(self.given) % 3 == 0:
            raise RuntimeError("the worker died")
        return -1


def test_what_is_mapped_comes_in_order_and_is_done_here_where_a_worker_dies() -> None:
    client = _Client()
    found = list(mapped(client, lambda one: one, range(12)))
    assert client.given == [*range(12)]
    assert all(told in (-1, one) for one, told in enumerate(found))
    assert {*found} > {-1}
    # No more is given out than the workers take.
    client = _Client()
    next(mapped(client, lambda one: one, iter(range(100))))
    assert len(client.given) == 4


@pytest.mark.full
def test_two_workers_give_the_bytes_of_one_process(fleet: Path, tmp_path: Path) -> None:
    sites = find_sites([str(fleet)])
    calibrate_fleet(sites, str(tmp_path / "here"), here)
    with connected(workers=2) as client:
        for _ in range(2):
            summary = calibrate_fleet(
                shuffled(sites, 4), str(tmp_path / "there"), lambda tasks: outcomes(client, tasks)
            )
    assert bytes_of(tmp_path / "there") == bytes_of(tmp_path / "here")
    assert summary.done == 1


def listening() -> set[tuple[str, int]]:
    """Give every address that this process and those it started listen at."""
    here = psutil.Process()
    return {
        (link.laddr.ip, link.laddr.port)
        for process in (here, *here.children(recursive=True))
        for link in process.net_connections()
        if link.status == psutil.CONN_LISTEN
    }


def said_at(address: tuple[str, int], context: ssl.SSLContext | None, words: bytes = b"") -> bytes:
    """Connect, say something, and give what is said there first; nothing of one who hangs up."""
    with (
        suppress(ssl.SSLError, ConnectionError, TimeoutError),
        socket.create_connection(address, 2) as plain,
        context.wrap_socket(plain) if context else plain as talk,
    ):
        talk.sendall(words)
        return talk.recv(100)
    return b""


@pytest.mark.full
def test_nobody_without_the_credential_is_served(tmp_path: Path) -> None:
    other: Any = Security

    def context_of(security: Any) -> ssl.SSLContext:
        context: ssl.SSLContext = security.get_connection_args("client")["ssl_context"]
        return context

    before = listening()
    nobody = ssl._create_unverified_context()
    with connected(workers=2) as client:
        own, another = context_of(client.security), context_of(other.temporary())
        another.verify_mode = ssl.CERT_NONE
        opened = listening() - before
        assert {host for host, _ in opened} == {"127.0.0.1"}
        # The scheduler, and two workers with what restarts each: they greet who has the credential.
        greeting = [each for each in opened if said_at(each, own)]
        assert len(greeting) == 5
        for each in greeting:
            assert [said_at(each, other, b"\0" * 64) for other in (None, nobody, another)] == [
                b""
            ] * 3
        for page in (
            "",
            "status",
            "metrics",
            "health",
            "info/main/workers.html",
            "json/counts.json",
        ):
            asked = f"GET /{page} HTTP/1.0\r\n\r\n".encode()
            for each in opened - {*greeting}:
                assert said_at(each, None, asked).startswith(b"HTTP/1.1 404 ")


@pytest.mark.skipif(os.name == "nt", reason="each user has a folder for temporary files")
@pytest.mark.full
def test_dask_imports_from_no_folder_that_others_write_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    # As another user would have it, before we came.
    (tmp_path / "dask-scratch-space").mkdir()
    (tmp_path / "dask-scratch-space").chmod(0o777)
    before = {*sys.path}
    with connected(workers=1) as client:
        (at_worker,) = client.run(lambda: list(sys.path)).values()
        added = [each for each in {*sys.path, *at_worker} - before if str(tmp_path) in each]
    own = tmp_path / f"retropole-{os.getuid()}"
    assert added
    assert all(own in Path(each).parents for each in added)
    assert stat.S_IMODE(own.stat().st_mode) == 0o700
    own.chmod(0o777)
    with pytest.raises(UsageError, match="other users write to it"), connected(workers=1):
        pass


class Future:
    """What becomes of a task, as Dask tells it."""

    def __init__(self, end: object) -> None:
        self.end = end
        self.status = "finished"
        if isinstance(end, Exception):
            self.status = "error"
        elif isinstance(end, str):
            self.status = end

    def add_done_callback(self, call: Callable[[Future], None]) -> None:
        call(self)

    def result(self, timeout: float) -> object:
        if isinstance(self.end, Exception):
            raise self.end
        return self.end

    def cancel(self) -> None: ...


class Cluster:
    """A cluster of which tasks come back as they are told to, in the end with an outcome."""

    status = "running"

    def __init__(self, ends: dict[str, list[object]]) -> None:
        self.ends = ends
        self.given: Counter[str] = Counter()
        self.most = 0

    def nthreads(self) -> dict[str, int]:
        return {"a": 1, "b": 2}

    def submit(self, call: object, data: bytes, pure: bool) -> Future:
        task = msgspec.msgpack.decode(data, type=Task)
        self.given[task.site.id] += 1
        left = self.ends.get(task.site.id, [])
        done = msgspec.msgpack.encode(unanswered(task.site, "made_up", "done"))
        return Future(left.pop(0) if left else done)


def tasks(names: str) -> Iterator[Task]:
    for name in names:
        site = FleetSite(id=name, kind="pair")
        yield Task(site=site, time_limit=1.0, environment=environment())


def test_what_is_lost_is_given_out_again() -> None:
    worker: Any = "worker"
    died = KilledWorker("task", worker, 4)
    ends: dict[str, list[object]] = {
        "b": ["cancelled", "lost", "cancelled", "lost", "cancelled"],
        "c": [died, "lost", died],
        "d": [died] * 9,
        "e": [OSError("no memory"), RetropoleError("does not start")],
    }
    cluster = Cluster(ends)
    found = {each.id: each.row for each in outcomes(cluster, tasks("abcdefghijklm"))}
    assert {name: row.codes[0] for name, row in found.items() if row is not None} == {
        **dict.fromkeys("abcefghijklm", "made_up"),
        "d": "worker_lost",
    }
    assert [cluster.given[name] for name in "abcde"] == [1, 6, 4, engine.ATTEMPTS, 3]


def test_few_are_given_out_at_a_time() -> None:
    taken = []

    def counted() -> Iterator[Task]:
        for task in tasks("abcdefghijklmnop"):
            taken.append(task)
            yield task

    next(outcomes(Cluster({}), counted()))
    assert len(taken) == engine.PER_THREAD * 3


def test_what_no_worker_can_do_ends_it() -> None:
    with pytest.raises(UsageError, match="No module named 'retropole'"):
        list(
            outcomes(
                Cluster({"a": [ModuleNotFoundError("No module named 'retropole'")]}), tasks("a")
            )
        )
    (task,) = tasks("a")
    other = msgspec.structs.replace(task, environment="retropole 9")
    with pytest.raises(UsageError, match="expected retropole 9: install the same on all"):
        run_task(msgspec.msgpack.encode(other))


def test_a_scheduler_that_stays_away_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "ANSWER_WITHIN", 0.5)
    cluster = Cluster({})
    cluster.status = "connecting"
    with pytest.raises(RetropoleError, match="the same command continues"):
        list(outcomes(cluster, tasks("a")))
    with (
        pytest.raises(UsageError, match="no Dask scheduler answers"),
        connected("tcp://127.0.0.1:9"),
    ):
        pass
