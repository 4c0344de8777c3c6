"""Small files that would unpack to GiB, or be read for ever."""

import bz2
import sqlite3
import struct
import zipfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import lz4.block
import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder

CLOUDS = "sensor_msgs/msg/PointCloud2"
MAGIC = b"\x89MCAP0\r\n"


def zeros(kind: str, size: int) -> bytes:
    """Compress `size` zeros, a multiple of 4 MiB, without holding them."""
    block = bytes(2**22)
    if kind == "bz2":  # streams may follow each other
        return bz2.compress(block) * (size // len(block))
    if kind == "lz4":  # and so may the blocks of a frame
        begin = lz4.frame.create_compression_context()
        head = lz4.frame.compress_begin(begin, block_size=7, block_linked=False)
        packed = bytes(lz4.block.compress(block, store_size=False))
        blocks = (struct.pack("<I", len(packed)) + packed) * (size // len(block))
        return bytes(head) + blocks + bytes(4)
    packer = zstandard.ZstdCompressor().compressobj(size=size)
    parts = [packer.compress(block) for _ in range(size // len(block))]
    return bytes(b"".join(parts) + packer.flush())


def bag(kind: str, size: int, messages: int = 1) -> bytes:
    """Make a ROS 1 bag with one chunk, to which as many messages of its index refer."""

    def record(data: bytes, **header: bytes) -> bytes:
        fields = [name.encode() + b"=" + value for name, value in header.items()]
        head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    def u4(value: int) -> bytes:
        return struct.pack("<I", value)

    def bag_header(index: int) -> bytes:
        return record(
            bytes(4000),
            op=b"\x03",
            index_pos=struct.pack("<Q", index),
            conn_count=u4(1),
            chunk_count=u4(1),
        )

    start = b"#ROSBAG V2.0\n" + bag_header(0)
    chunk = record(zeros(kind, size), op=b"\x05", compression=kind.encode(), size=u4(size % 2**32))
    index = record(
        (bytes(8) + u4(0)) * messages, op=b"\x04", ver=u4(1), conn=u4(0), count=u4(messages)
    )
    head = [b"type=sensor_msgs/PointCloud2", b"md5sum=0", b"message_definition="]
    body = b"".join(u4(len(field)) + field for field in head)
    connection = record(body, op=b"\x07", conn=u4(0), topic=b"/points")
    info = record(
        u4(0) + u4(messages),
        op=b"\x06",
        ver=u4(1),
        chunk_pos=struct.pack("<Q", len(start)),
        start_time=bytes(8),
        end_time=bytes(8),
        count=u4(1),
    )
    before = len(start) + len(chunk) + len(index)
    return b"#ROSBAG V2.0\n" + bag_header(before) + chunk + index + connection + info


def mcap(kind: str, size: int, chunks: int = 1, *, indexed: bool = True) -> bytes:
    """Make an MCAP with one chunk, to which the index refers as often as asked."""
    built: Any = RecordBuilder()

    def added(*new: Any) -> None:
        for each in new:
            each.write(built)

    schema = records.Schema(id=1, name=CLOUDS, encoding="ros2msg", data=b"")
    channel = records.Channel(
        id=1, topic="/points", message_encoding="cdr", metadata={}, schema_id=1
    )
    built.write(MAGIC)
    added(records.Header(profile="ros2", library=""), schema, channel)
    packed, start = zeros(kind, size), built.count
    times = {"message_start_time": 0, "message_end_time": 1}
    chunk = records.Chunk(
        compression=kind, data=packed, uncompressed_crc=0, uncompressed_size=1000, **times
    )
    added(chunk)
    length = built.count - start
    added(records.DataEnd(data_section_crc=0))
    summary = built.count if indexed else 0
    if indexed:
        added(schema, channel)
        entry = records.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=start,
            compression=kind,
            compressed_size=len(packed),
            message_index_length=0,
            message_index_offsets={},
            uncompressed_size=1000,
            **times,
        )
        added(*[entry] * chunks)
        added(
            records.Statistics(
                attachment_count=0,
                channel_count=1,
                channel_message_counts={1: chunks},
                chunk_count=chunks,
                message_count=chunks,
                metadata_count=0,
                schema_count=1,
                **times,
            )
        )
    added(records.Footer(summary_start=summary, summary_offset_start=0, summary_crc=0))
    built.write(MAGIC)
    return bytes(built.end())


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
    "offered_qos_profiles TEXT)"
)
TOPIC = f"INSERT INTO topics VALUES (1, '/points', '{CLOUDS}', 'cdr', '')"
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
)
SCHEMA = f"CREATE VIEW schema AS {ENDLESS} SELECT 4 schema_version FROM n WHERE i < 0"
DATABASES = {
    "the schema is a view": [TOPICS, TOPIC, MESSAGES, SCHEMA],
    "messages are a view": [
        TOPICS,
        TOPIC,
        f"CREATE VIEW messages AS {ENDLESS} SELECT i id, 1 topic_id, i timestamp, 'x' data FROM n",
    ],
    "topics are a view": [
        MESSAGES,
        f"CREATE VIEW topics AS {ENDLESS} SELECT i id, i name, '{CLOUDS}' type FROM n",
    ],
    "a view that says it is a table": [
        TOPICS,
        TOPIC,
        f"CREATE VIEW messages AS {ENDLESS} SELECT i id, 1 topic_id, i timestamp, 'x' data FROM n",
        "PRAGMA writable_schema=ON",
        "UPDATE sqlite_master SET type = 'table' WHERE name = 'messages'",
    ],
    "computed columns": [
        TOPICS,
        TOPIC,
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB AS (zeroblob(900000000)))",
        "INSERT INTO messages VALUES (1, 1, 1)",
    ],
    "a virtual table": [
        TOPICS,
        TOPIC,
        "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    ],
}


def database(path: Path, statements: list[str]) -> None:
    path.unlink(missing_ok=True)
    with sqlite3.connect(path) as made:
        for statement in statements:
            made.execute(statement)
    made.close()


def endless_tree(path: Path) -> None:
    """Make a table whose pages refer to each other so often that it has 10^25 rows."""
    page, deep, wide = 4096, 10, 500
    database(path, [f"PRAGMA page_size={page}", TOPICS, TOPIC, MESSAGES])
    with sqlite3.connect(path) as made:
        made.execute("INSERT INTO messages VALUES (1, 1, 1, 'x')")
        (root,) = made.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        ).fetchone()
    made.close()
    content = bytearray(path.read_bytes())
    count = len(content) // page
    leaf = bytes(content[(root - 1) * page : root * page])
    pages = [root, *range(count + 1, count + deep)]
    content += bytes(page * deep)
    for own, child in zip(pages, [*pages[1:], count + deep], strict=True):
        cell = struct.pack(">I", child) + b"\x01"
        start = page - len(cell) * wide
        head = struct.pack(">BHHHBI", 5, 0, wide, start, 0, child)
        pointers = b"".join(struct.pack(">H", start + len(cell) * k) for k in range(wide))
        body = head + pointers
        content[(own - 1) * page : own * page] = (
            body + bytes(page - len(body) - len(cell) * wide) + cell * wide
        )
    content[(count + deep - 1) * page :] = leaf
    content[28:32] = struct.pack(">I", len(content) // page)
    path.write_bytes(content)


def ros2_folder(path: Path, about: str, name: str = "a.db3", content: bytes = b"") -> None:
    path.mkdir()
    (path / name).write_bytes(content)
    (path / "metadata.yaml").write_text(about)


def metadata(mode: str, name: str, storage: str = "sqlite3") -> str:
    return (
        "rosbag2_bagfile_information:\n"
        "  version: 9\n"
        f"  storage_identifier: {storage}\n"
        f"  relative_file_paths: [{name}]\n"
        f"  compression_format: zstd\n  compression_mode: {mode}\n"
        "  duration: {nanoseconds: 1}\n  starting_time: {nanoseconds_since_epoch: 0}\n"
        "  message_count: 1\n"
        "  topics_with_message_count:\n"
        "  - message_count: 1\n"
        "    topic_metadata:\n"
        f"      {{name: /points, type: {CLOUDS}, serialization_format: cdr, "
        "offered_qos_profiles: ''}\n"
    )


def npz(path: Path, names: list[str], count: int, dtype: str = "f4") -> None:
    """Make an NPZ of columns of ones, without holding them."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in names:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(
                    file, {"descr": dtype, "fortran_order": False, "shape": (count,)}
                )
                block = np.ones(2**20, dtype).tobytes()
                left = count * np.dtype(dtype).itemsize
                while left > 0:
                    file.write(block[:left])
                    left -= len(block)


def packed_file(folder: Path, size: int) -> Path:
    path = folder / "file"
    ros2_folder(path, metadata("FILE", "a.db3.zstd"), "a.db3.zstd", zeros("zstd", size))
    return path


def packed_message(folder: Path, size: int) -> Path:
    one = folder / "one.db3"
    database(one, [TOPICS, TOPIC, MESSAGES])
    with sqlite3.connect(one) as made:
        made.execute("INSERT INTO messages VALUES (1, 1, 1, ?)", [zeros("zstd", size)])
    made.close()
    ros2_folder(folder / "message", metadata("MESSAGE", "a.db3"), content=one.read_bytes())
    return folder / "message"


def aliases(folder: Path, size: int) -> Path:
    lists = "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 8)}]\n" for a, b in pairwise("abcdefgh"))
    about = "a: &a [x,x,x,x,x,x,x,x]\n" + lists + metadata("NONE", "a.db3")
    ros2_folder(folder / "aliases", about)
    return folder / "aliases"


def nested(folder: Path, size: int) -> Path:
    ros2_folder(folder / "nested", "[" * 200_000)
    return folder / "nested"


def claims(folder: Path, size: int) -> Path:
    with (folder / "claims.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": (2**40, 4)}
        )
    return folder / "claims.npy"


def hole(folder: Path, size: int) -> Path:
    """Make an MCAP with a chunk that is a hole: on disk it has some KB."""
    # Of longer records the library for MCAP says itself that they are too long.
    size = min(size, 2**32 - 1)
    head, end = MAGIC + struct.pack("<BQ", 6, size), mcap("zstd", 2**22, indexed=False)[-37:]
    with (folder / "hole.mcap").open("wb") as file:
        file.write(head)
        file.seek(size, 1)
        file.write(end)
    return folder / "hole.mcap"


def written(name: str, content: Callable[[int], bytes]) -> Callable[[Path, int], Path]:
    def maker(folder: Path, size: int) -> Path:
        (folder / name).write_bytes(content(size))
        return folder / name

    return maker


def in_sqlite(name: str, statements: list[str]) -> Callable[[Path, int], Path]:
    def maker(folder: Path, size: int) -> Path:
        database(folder / f"{name}.db3", statements)
        return folder / f"{name}.db3"

    return maker


def tree(folder: Path, size: int) -> Path:
    endless_tree(folder / "tree.db3")
    return folder / "tree.db3"


def arrays(name: str, names: list[str], part: int, dtype: str) -> Callable[[Path, int], Path]:
    def maker(folder: Path, size: int) -> Path:
        # No bound lies between this and more, and packing takes its time.
        npz(folder / name, names, min(size, 2**30) // part, dtype)
        return folder / name

    return maker


def many_names(size: int) -> bytes:
    """Name as many columns as a header has room for."""
    names = [f"c{k}" for k in range(140_000)]
    return f"{','.join(names)}\n{','.join('1' for _ in names)}\n".encode()


def hexadecimal(size: int) -> bytes:
    """Write numbers that take more room as decimal ones, and a line at the end that is none."""
    return b"x,y,z,code\n" + b"1,2,3,0xffffffffffffffff\n" * (size >> 14) + b"1,2,3,0xg\n"


def unicode_text(size: int) -> bytes:
    """Write characters that are longer in UTF-8 than in UTF-16, and no numbers."""
    return b"\xff\xfe" + "\u4e00".encode("utf-16-le") * (size >> 8)


def widths_and_points(size: int) -> bytes:
    """Promise points without width and height."""
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nHEIGHT 0\nPOINTS 4000000000\n"
    return f"{head}DATA binary\n".encode() + bytes(10_000)


TIMES = [f"{a}{b}" for a in "tT" for b in ("", "ime", "IME", "Ime", "iME", "iMe")]
MAKERS: dict[str, Callable[[Path, int], Path]] = {
    "bz2.bag": written("bz2.bag", lambda size: bag("bz2", size)),
    "lz4.bag": written("lz4.bag", lambda size: bag("lz4", size)),
    "again.bag": written("again.bag", lambda size: bag("bz2", 2**26, 50_000)),
    "zstd.mcap": written("zstd.mcap", lambda size: mcap("zstd", size)),
    "lz4.mcap": written("lz4.mcap", lambda size: mcap("lz4", size)),
    "in turn.mcap": written("in turn.mcap", lambda size: mcap("zstd", size, indexed=False)),
    "again.mcap": written("again.mcap", lambda size: mcap("zstd", 2**26, 1000)),
    **{name: in_sqlite(name, statements) for name, statements in DATABASES.items()},
    "endless tree": tree,
    "packed file": packed_file,
    "packed message": packed_message,
    "aliases": aliases,
    "nested": nested,
    "large.npz": arrays("large.npz", ["x", "y", "z", "intensity"], 16, "<f4"),
    "bytes.npz": arrays("bytes.npz", ["x", "y", "z", "intensity"], 16, "|i1"),
    "many.npz": arrays("many.npz", ["x", "y", "z", *TIMES], 64, "<f4"),
    "claims.npy": claims,
    "many names.csv": written("many names.csv", many_names),
    "hexadecimal.csv": written("hexadecimal.csv", hexadecimal),
    "unicode.txt": written("unicode.txt", unicode_text),
    "counted.pts": written("counted.pts", lambda size: b"999999999999999\n" + b"1 2 3\n" * 9),
    "no width.pcd": written("no width.pcd", widths_and_points),
    "hole.mcap": hole,
}
NAMES = tuple(MAKERS)


def make(folder: Path, size: int) -> Iterator[tuple[str, Path]]:
    """Write every bomb to a folder; those that unpack do so to about `size` bytes."""
    for name, maker in MAKERS.items():
        yield name, maker(folder, size)
