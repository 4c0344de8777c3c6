"""Folders and bags that grow give the newest that is whole, whenever they are looked at."""

import os
import sqlite3
import struct
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from threading import Timer

import numpy as np
import pytest

pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from retropole.base.errors import MissingExtraError, ReadError, UsageError
from retropole.io import Frame
from retropole.io.live import Source, files
from retropole.io.live.files import BagSource, FolderSource
from retropole.io.ros import frame_of
from tests.bags import CLOUDS, START, STEP, message, points_of
from tests.io.clouds import assert_same, random_cloud
from tests.io.files import required

STORE = get_typestore(Stores.LATEST)
LONG = 10.0
"""Seconds that are more than enough."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look more often, and give up sooner."""
    monkeypatch.setattr(files, "POLL", 0.01)
    monkeypatch.setattr(files, "UNCHANGED_FOR", 0.05)
    monkeypatch.setattr(files, "GIVE_UP", 0.4)


def save(path: Path, seed: int) -> None:
    np.save(path, random_cloud(seed).xyz)


def assert_cloud(frame: Frame | None, seed: int) -> None:
    np.testing.assert_array_equal(required(frame).cloud.xyz, random_cloud(seed).xyz)


def nothing(source: Source) -> bool:
    """Whether nothing comes for as long as a file takes to settle."""
    return source.newest(0.15) is None


def test_a_folder_gives_the_newest_file_and_then_those_that_come(tmp_path: Path) -> None:
    for k in (2, 9, 10):
        save(tmp_path / f"sweep{k}.npy", k)
        os.utime(tmp_path / f"sweep{k}.npy", ns=(START, START))
    with closing(FolderSource(tmp_path)) as source:
        first = required(source.newest(LONG))
        assert_cloud(first, 10)
        assert (first.number, first.stamp) == (2, None)
        assert first.cloud.source == str(tmp_path / "sweep10.npy")
        assert source.waits_for == ""
        assert nothing(source)
        for k in (11, 12, 13):
            save(tmp_path / f"sweep{k}.npy", k)
            os.utime(tmp_path / f"sweep{k}.npy", ns=(START, START + k))
        time.sleep(0.1)
        frames = [frame for _ in range(4) if (frame := source.newest(0.05))]
        assert_cloud(frames[-1], 13)
        assert frames[-1].number == 5
        # The same file, written again.
        save(tmp_path / "sweep11.npy", 99)
        again = required(source.newest(LONG))
        assert_cloud(again, 99)
        assert again.number == 6
        assert nothing(source)


def test_times_of_points_are_those_of_the_sweep(tmp_path: Path) -> None:
    with closing(FolderSource(tmp_path)) as source:
        (tmp_path / "a.csv").write_text("x,y,z,time\n1,2,3,1700000000.25\n2,3,4,1700000000.5\n")
        assert required(source.newest(LONG)).stamp == 1_700_000_000.25


def test_a_folder_without_files_reports_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ReadError, match="there is no such folder"):
        FolderSource(tmp_path / "none")
    with closing(FolderSource(tmp_path)) as source:
        for name in ("notes.md", ".a.npy", "b.npy.part"):
            save(tmp_path / "made.npy", 1)
            (tmp_path / "made.npy").rename(tmp_path / name)
        (tmp_path / "folder.npy").mkdir()
        assert nothing(source)
        assert source.waits_for.startswith(f"{tmp_path}: has no point clouds yet, expected files")
        (tmp_path / "b.npy.part").rename(tmp_path / "b.npy")
        assert_cloud(source.newest(LONG), 1)
        monkeypatch.setattr(files, "QUIET", 0.0)
        assert nothing(source)
        assert source.waits_for == f"{tmp_path}: no new file appears"


@pytest.mark.parametrize("kind", ["npy", "csv"])
def test_a_half_written_file_waits_until_it_is_whole(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{kind}"
    save(tmp_path / "other.npy", 5)
    if kind == "npy":
        save(path, 1)
    else:
        np.savetxt(path, random_cloud(1).xyz, "%.17g", delimiter=",", header="x,y,z", comments="")
    content = path.read_bytes()
    path.unlink()
    with closing(FolderSource(tmp_path)) as source:
        # The older file, which is whole, does not wait for it.
        assert_cloud(source.newest(LONG), 5)
        # On a busy computer, this test may stand still for a while between two parts.
        monkeypatch.setattr(files, "UNCHANGED_FOR", 0.5)
        monkeypatch.setattr(files, "GIVE_UP", 1.0)
        with path.open("wb") as file:
            for part in np.array_split(np.frombuffer(content, "u1"), 30):
                file.write(part.tobytes())
                file.flush()
                assert source.newest(0.002) is None
        assert_cloud(source.newest(LONG), 1)


def test_a_file_that_stays_damaged_is_named_once(tmp_path: Path) -> None:
    save(tmp_path / "a.npy", 1)
    content = (tmp_path / "a.npy").read_bytes()
    os.utime(tmp_path / "a.npy", ns=(START, START))
    (tmp_path / "b.npy").write_bytes(content[:-9])
    with closing(FolderSource(tmp_path)) as source:
        assert_cloud(source.newest(LONG), 1)
        with pytest.raises(ReadError, match=r"b\.npy"):
            source.newest(LONG)
        assert nothing(source)
        # Where somebody writes it to its end after all, it is read.
        (tmp_path / "b.npy").write_bytes(content)
        frame = required(source.newest(LONG))
        assert_cloud(frame, 1)
        assert frame.number == 2


def test_a_file_that_vanishes_is_no_error(tmp_path: Path) -> None:
    with closing(FolderSource(tmp_path)) as source:
        (tmp_path / "a.npy").write_bytes(b"none")
        assert nothing(source)
        (tmp_path / "a.npy").unlink()
        assert source.newest(0.6) is None


def test_closing_ends_a_wait(tmp_path: Path) -> None:
    source: Source = FolderSource(tmp_path)
    assert (source.name, source.has_ended) == (f"folder:{tmp_path}", False)
    start = time.monotonic()
    timer = Timer(0.05, source.close)
    timer.start()
    assert source.newest(60) is None
    assert time.monotonic() - start < 30
    timer.join()
    source.close()


def encoded(seed: int) -> bytes:
    made = message(points_of(random_cloud(seed)), STORE)
    return bytes(STORE.serialize_cdr(made, CLOUDS))


def mcap_of(
    seeds: range, *, names: tuple[str, ...] = ("/points",), chunked: bool, packed: bool = False
) -> tuple[bytes, list[int]]:
    """Give an MCAP file with clouds of each topic in turn, and where they end at the latest."""
    out, ends = BytesIO(), list[int]()
    compression = CompressionType.ZSTD if packed else CompressionType.NONE
    writer = Writer(out, chunk_size=3000, compression=compression, use_chunking=chunked)
    writer.start("ros2")
    schema = writer.register_schema(CLOUDS, "ros2msg", b"")
    text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
    said = writer.register_channel("/said", "cdr", text)
    channels = [writer.register_channel(name, "cdr", schema) for name in names]
    for k, seed in enumerate(seeds):
        stamp = START + k * STEP
        writer.add_message(said, stamp, b"\0\1\0\0", stamp)
        for channel in channels:
            writer.add_message(channel, stamp, encoded(seed), stamp)
        ends.append(out.tell())
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue(), ends


@pytest.mark.parametrize(("chunked", "packed"), [(False, False), (True, False), (True, True)])
def test_an_mcap_is_read_on_wherever_it_ends(tmp_path: Path, chunked: bool, packed: bool) -> None:
    content, ends = mcap_of(range(12), chunked=chunked, packed=packed)
    path = tmp_path / "run.mcap"
    path.touch()
    rng = np.random.default_rng(3)
    cuts = np.unique(np.append(rng.integers(0, len(content), 60), [1, 7, 9, len(content)]))
    numbers = list[int]()
    with closing(BagSource(path)) as source:
        start = 0
        for cut in cuts.tolist():
            with path.open("ab") as file:
                file.write(content[start:cut])
            start = cut
            assert not source.has_ended
            frame = source.newest(0)
            if frame is not None:
                assert_same(frame.cloud, random_cloud(frame.number))
                assert frame.stamp == pytest.approx((START + frame.number * STEP) / 1e9)
                assert frame.frame_id == "lidar"
                assert frame.cloud.source == f"{path}: message {frame.number} of /points"
                numbers.append(frame.number)
            whole = sum(end <= cut for end in ends)
            if not chunked:
                assert (numbers[-1] if numbers else -1) == whole - 1
        assert numbers == sorted(set(numbers))
        assert numbers[-1] == 11
        assert source.has_ended
        assert source.newest(0) is None


def test_of_a_long_mcap_the_newest_message_alone_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, ends = mcap_of(range(30), chunked=True)
    path = tmp_path / "run.mcap"
    path.write_bytes(content[: ends[-1]])
    decoded = list[int]()

    def counting(source: str, topic: str, number: int, *rest: object) -> Frame:
        decoded.append(number)
        return frame_of(source, topic, number, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(files, "frame_of", counting)
    monkeypatch.setattr(files, "READ_ON", 0.0)
    with closing(BagSource(path)) as source:
        assert source.newest(0) is None
        assert source.waits_for == f"{path}: older data are still being read"
        frame = required(source.newest(LONG))
        assert decoded == [frame.number]
        assert frame.number >= 27


def test_topics_of_a_bag_are_chosen(tmp_path: Path) -> None:
    content, _ = mcap_of(range(3), names=("/front", "/rear"), chunked=False)
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with closing(BagSource(path)) as source:
        for _ in range(2):
            with pytest.raises(ReadError, match=r"run\.mcap: has 2 topics .*: /front, /rear"):
                source.newest(0)
    with closing(BagSource(path, "/rear")) as source:
        assert required(source.newest(0)).number == 2
    with closing(BagSource(path, "/said")) as source, pytest.raises(ReadError, match="/said is of"):
        source.newest(0)
    with closing(BagSource(path, "/absent")) as source:
        assert source.newest(0) is None
        have = f"/front ({CLOUDS}), /rear ({CLOUDS}), /said (std_msgs/msg/String)"
        assert source.waits_for == f"{path}: has no topic /absent yet; its topics are: {have}"
    path.write_bytes(b"\x89MCAP0\r\n")
    with closing(BagSource(path)) as source:
        assert source.newest(0) is None
        assert source.waits_for == f"{path}: has no topic of {CLOUDS} yet; its topics are: none"


def test_an_mcap_that_is_damaged_says_where_and_goes_on(tmp_path: Path) -> None:
    content, ends = mcap_of(range(3), chunked=True, packed=True)
    path = tmp_path / "run.mcap"
    path.write_bytes(b"no bag")
    with closing(BagSource(path)) as source, pytest.raises(ReadError, match="expected an MCAP"):
        source.newest(0)
    where = content.index(b"\x28\xb5\x2f\xfd")
    damaged = content[: where + 6] + bytes(8) + content[where + 14 :]
    path.write_bytes(damaged)
    with closing(BagSource(path)) as source:
        with pytest.raises(ReadError, match=r"run\.mcap: is not a readable bag"):
            source.newest(0)
        for _ in range(3):
            try:
                frame = source.newest(0)
            except ReadError:
                continue
            if frame is not None:
                assert_same(frame.cloud, random_cloud(2))
    path.write_bytes(content[: ends[0]] + bytes(100))
    with closing(BagSource(path)) as source, pytest.raises(ReadError, match="damaged at byte"):
        source.newest(0)


def test_a_bag_that_begins_anew_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap_of(range(9), chunked=False)[0])
    with closing(BagSource(path)) as source:
        assert required(source.newest(0)).number == 8
        path.write_bytes(mcap_of(range(20, 22), chunked=False)[0])
        frame = required(source.newest(0))
        assert_same(frame.cloud, random_cloud(21))
        assert frame.number == 10


Write = Callable[[int, str], None]


@pytest.fixture(params=["WAL", "DELETE"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Path, Write]]:
    """A bag in SQLite that stays open, and what adds a cloud to it."""
    path = tmp_path / "run_0.db3"
    with closing(sqlite3.connect(path)) as own:
        own.execute(f"PRAGMA journal_mode={request.param}")
        own.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        own.execute(
            "CREATE TABLE messages"
            "(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        topics = {"/points": CLOUDS, "/said": "std_msgs/msg/String"}
        own.executemany("INSERT INTO topics(name, type) VALUES(?, ?)", topics.items())
        own.commit()

        def write(seed: int, topic: str = "/points") -> None:
            number = list(topics).index(topic) + 1
            row = (number, START + seed * STEP, encoded(seed))
            own.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
            own.commit()

        yield path, write


def test_a_database_is_read_on(database: tuple[Path, Write]) -> None:
    path, write = database
    with closing(BagSource(path)) as source:
        assert source.newest(0) is None
        assert source.waits_for == f"{path}: nothing is recorded on /points"
        number = -1
        for seeds in ([0], [1, 2, 3], [4], list(range(5, 15))):
            for seed in seeds:
                write(seed, "/points")
                write(seed, "/said")
            frame = required(source.newest(0))
            number += len(seeds)
            assert frame.number == number
            assert_same(frame.cloud, random_cloud(seeds[-1]))
            assert frame.stamp == pytest.approx((START + seeds[-1] * STEP) / 1e9)
            assert source.newest(0) is None
            assert source.waits_for == ""
        assert not source.has_ended


def test_a_database_that_was_closed_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    with closing(sqlite3.connect(path, isolation_level=None)) as own:
        own.execute("PRAGMA journal_mode=WAL")
        own.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        own.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        own.execute("INSERT INTO topics VALUES(1, '/points', ?)", [CLOUDS])
        own.execute("INSERT INTO messages VALUES(1, 1, ?, ?)", [START, encoded(1)])
    with closing(BagSource(path)) as source:
        assert_cloud(source.newest(0), 1)
    assert list(tmp_path.iterdir()) == [path]


def test_a_database_that_is_locked_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    with closing(sqlite3.connect(path, isolation_level=None)) as own:
        own.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        own.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        own.execute("INSERT INTO topics VALUES(1, '/points', ?)", [CLOUDS])
        own.execute("INSERT INTO messages VALUES(1, 1, ?, ?)", [START, encoded(1)])
        own.execute("BEGIN EXCLUSIVE")
        with closing(BagSource(path)) as source:
            assert source.newest(0) is None
            own.execute("COMMIT")
            assert_cloud(source.newest(LONG), 1)
            own.execute("INSERT INTO messages VALUES(2, 1, ?, ?)", [START, 10**12])
            with pytest.raises(ReadError, match="message 2 is no time and bytes"):
                source.newest(0)


def test_the_folder_of_a_bag_is_followed_to_its_next_file(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with closing(BagSource(folder)) as source:
        assert source.newest(0) is None
        assert source.waits_for == f"{folder}: has no file .mcap or .db3 yet"
        content, _ = mcap_of(range(8), chunked=False)
        for k in (8, 9):
            (folder / f"run_{k}.mcap").write_bytes(content)
        assert required(source.newest(0)).number == 7
        assert not source.has_ended
        later, ends = mcap_of(range(30, 34), chunked=False)
        (folder / "run_10.mcap").write_bytes(later[: ends[1]])
        frame = required(source.newest(0))
        assert_same(frame.cloud, random_cloud(31))
        assert frame.number == 9
        (folder / "metadata.yaml").write_text("")
        (folder / "run_10.mcap").write_bytes(later)
        assert required(source.newest(0)).number == 11


@pytest.mark.parametrize("kind", [3, 4, 5, 6])
def test_a_record_that_no_recorder_writes_is_not_read(tmp_path: Path, kind: int) -> None:
    """Of 2 GiB, in a file that has some bytes and a hole."""
    path = tmp_path / "run.mcap"
    for size, hole in ((2**31, 2**31), (2**31, 0), (2**63, 0)):
        with path.open("wb") as file:
            file.write(files.MCAP_START + struct.pack("<BQ", kind, size))
            file.truncate(file.tell() + hole)
        tracemalloc.start()
        with closing(BagSource(path)) as source, pytest.raises(ReadError, match=f"{size:,} bytes"):
            source.newest(0)
        assert tracemalloc.get_traced_memory()[1] < 2**24
        tracemalloc.stop()


def test_what_a_record_says_of_its_parts_leads_not_beyond_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        # A schema of 100 bytes whose name has 1 GiB.
        record = struct.pack("<BQHI", 3, 100, 1, 2**30)
        file.write(files.MCAP_START + record)
        file.truncate(file.tell() + 2**30)
    tracemalloc.start()
    with closing(BagSource(path)) as source, pytest.raises(ReadError):
        source.newest(0)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


@pytest.mark.skipif(os.name != "posix", reason="pipes and devices of POSIX")
@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
@pytest.mark.parametrize("kind", ["a named pipe", "a device", "a folder"])
def test_what_is_no_file_is_reported_and_not_opened(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"run_0{suffix}"
    make = {
        "a named pipe": os.mkfifo,
        "a device": lambda path: os.symlink("/dev/zero", path),
        "a folder": os.mkdir,
    }
    make[kind](path)
    said = f"run_0{suffix}: is {kind}, expected a file"
    with closing(BagSource(tmp_path)) as source, pytest.raises(ReadError, match=said):
        source.newest(0)
    if kind != "a folder":
        with pytest.raises(ReadError, match=said):
            BagSource(path)


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
def test_a_pipe_in_a_folder_is_left_out_with_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "a.npy")
    (tmp_path / "b.npy").symlink_to("nowhere")
    with closing(FolderSource(tmp_path)) as source:
        save(tmp_path / "c.npy", 1)
        assert_cloud(source.newest(LONG), 1)
        monkeypatch.setattr(files, "QUIET", 0.0)
        assert nothing(source)
        assert source.waits_for.endswith(
            "no new file appears; 2 names left out, such as a.npy, not a file"
        )


def test_what_cannot_be_read_while_it_is_written(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="there is no such file or folder"):
        BagSource(tmp_path / "none.mcap")
    (tmp_path / "run.bag").touch()
    with pytest.raises(UsageError, match=r"run\.bag: .* written, only \.mcap and \.db3 can"):
        BagSource(tmp_path / "run.bag")


def test_missing_extras_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run.mcap").touch()
    monkeypatch.setitem(sys.modules, "mcap.records", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[ros\]"):
        BagSource(tmp_path / "run.mcap")
