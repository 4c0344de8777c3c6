"""The same on every file system: what is written is read, listed, matched, copied and removed."""

import os
import subprocess
import sys
import uuid
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFile, MemoryFileSystem

from retropole.base.errors import ReadError, UsageError
from retropole.base.files import RUNNING, leaving
from retropole.fleet import storage
from retropole.fleet.dataset import known_answers, partition_of, read_rows, write_partition
from retropole.fleet.process import done
from retropole.fleet.sites import FleetSite, find_sites
from retropole.fleet.storage import alone_in, below, exists, read_bytes, remove, write_bytes
from retropole.fleet.work import Task, task_of
from tests.fleet.made_up import made_up_row, names_in_first, write_made_up


@pytest.fixture(params=["path", "file", "memory"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Name a folder that is not there yet."""
    places = {
        "path": str(tmp_path / "root"),
        "file": (tmp_path / "root").as_uri(),
        "memory": f"memory://{uuid.uuid4().hex}/root",
    }
    return places[request.param]


def test_what_is_written_is_found(root: str, tmp_path: Path) -> None:
    root = storage.absolute(root)
    place = storage.below(root, "a/b.txt")
    assert not storage.exists(place)
    assert storage.names_in(storage.below(root, "a")) == []
    for data in (b"old", b"new"):
        storage.write_bytes(place, data)
        assert storage.read_bytes(place) == data
    assert storage.names_in(storage.folder_of(place)) == ["b.txt"]
    assert storage.exists(storage.folder_of(place), as_folder=True)
    assert storage.found_below(root) == ["a", "a/b.txt"]
    assert storage.matching(storage.below(root, "*/b.*")) == [place]
    assert storage.fetch(place, tmp_path / "copy").read_bytes() == b"new"
    with pytest.raises(ReadError, match="more than 2 bytes"):
        storage.read_bytes(place, 2)
    storage.remove(place)
    assert not storage.exists(place)
    with pytest.raises(ReadError, match="cannot be read"):
        storage.read_bytes(place)


def test_no_bucket_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def makes(*given: object, **options: object) -> None:
        raise AssertionError(given)

    for name in ("mkdir", "makedirs"):
        monkeypatch.setattr(MemoryFileSystem, name, makes)
    place = f"memory://{uuid.uuid4().hex}/a/b.txt"
    storage.write_bytes(place, b"data")
    assert storage.read_bytes(place) == b"data"


def test_pairs_and_site_files_are_found_in_a_folder(root: str) -> None:
    for name in ("p/target.pcd", "p/source.pcd", "q/r/site.toml"):
        storage.write_bytes(storage.below(storage.absolute(root), name), b"")
    assert [(site.id, site.kind) for site in find_sites([root])] == [("p", "pair"), ("q/r", "site")]


def test_a_dataset_has_the_same_bytes_everywhere(root: str, tmp_path: Path) -> None:
    from retropole.fleet.dataset import ANSWERS

    row = made_up_row("post", np.random.default_rng(0))
    part = partition_of(row.id)
    write_made_up(tmp_path / "here", [row])
    write_partition(storage.absolute(root), part, [row], [])
    there = storage.below(storage.absolute(root), f"{ANSWERS}/{part}")
    assert storage.read_bytes(there) == (tmp_path / "here" / ANSWERS / part).read_bytes()
    assert read_rows(root, part) == {row.id: row}


NOT_FOLLOWED = ("ftp://127.0.0.1/a", "jupyter://a", "dbfs://a", "webhdfs://a:1/b", "foo://a")
CHAINS = ("simplecache::s3://a/b", "zip://a::ftp://b/c", "memory://a::ftp://b/c")


@pytest.mark.parametrize("url", [*NOT_FOLLOWED, *CHAINS])
def test_a_url_is_followed_only_where_its_protocol_is_allowed(url: str, tmp_path: Path) -> None:
    for call in (storage.filesystem, storage.absolute, storage.exists, storage.read_bytes):
        with pytest.raises(UsageError, match="expected a path, or a URL of s3, gs, abfs, memory"):
            call(url)
    path = tmp_path / "list.csv"
    path.write_text(f"id,target,source\na,{url},b.pcd\nb,a.pcd,b.pcd\n")
    first, second = find_sites([str(path)])
    assert "expected a path, or a URL of" in first.fault
    assert not second.fault


def test_another_protocol_is_followed_where_it_is_requested() -> None:
    site = FleetSite(id="a", kind="pair", target="github://a/b", source="github://a/c")
    with storage.also_following(["github"]):
        task = task_of(site, 9.0)
        for call in (storage.filesystem, storage.read_bytes):
            with pytest.raises(UsageError, match=r"github://a.*missing"):
                call("github://a")
        with pytest.raises(UsageError, match="chains"):
            storage.filesystem("github::ftp://a")
    # A worker follows what whoever gives the task does.
    for each, said in ((task, "missing"), (task_of(site, 9.0), "expected a path")):
        row = done(msgspec.msgpack.decode(msgspec.msgpack.encode(each), type=Task)).row
        assert row is not None
        assert said in row.messages[0]


def test_a_local_path_may_look_like_a_chain(tmp_path: Path) -> None:
    place = storage.below(str(tmp_path), "zip::a:b.txt")
    storage.write_bytes(place, b"here")
    assert storage.read_bytes(place) == b"here"
    assert (tmp_path / "zip::a:b.txt").exists()


def test_columns_are_read_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    out = f"memory://{uuid.uuid4().hex}"
    rows = [made_up_row(name, rng) for name in names_in_first(200)]
    long = [msgspec.structs.replace(row, document=rng.bytes(20_000).hex()) for row in rows]
    write_partition(out, "part-00.parquet", long, [])
    taken = 0

    def read(file: MemoryFile, count: int | None = -1) -> bytes:
        nonlocal taken
        data = BytesIO.read(file, count)
        taken += len(data)
        return data

    monkeypatch.setattr(MemoryFile, "read", read, raising=False)
    assert known_answers(out).keys() == {row.id for row in rows}
    assert 0 < taken < 0.1 * sum(len(row.document or "") for row in long)


# --- one run at a time ---


@pytest.fixture
def out() -> str:
    return f"memory://{uuid.uuid4().hex}/fleet"


def test_a_second_run_is_informed_of_the_first_until_that_is_over(out: str) -> None:
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
        monkeypatch.setattr("retropole.fleet.storage.exists", lambda place: False)
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
