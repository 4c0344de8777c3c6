"""Bags of all kinds as files: .bag, .db3, .mcap, and folders of ROS 2 bags (the extra ``ros``)."""

from __future__ import annotations

import bz2
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePath
from typing import Any

from ..base.errors import MissingExtraError, ReadError
from .bag_mcap import open_mcap
from .bag_sqlite import open_sqlite
from .failures import naming, reported
from .recordings import MAX_MESSAGES, Bag, counted_topics
from .unpacking import allowance, unpack_file, unpacked

REPAIR = (
    "; one that was cut short can be repaired by 'rosbag reindex' (.bag), 'ros2 bag reindex' (a "
    "folder) or 'mcap recover' (.mcap)"
)

METADATA = "metadata.yaml"
"""File that makes a folder a ROS 2 bag."""

MAX_METADATA, DEEPEST_METADATA = 2**20, 20
"""Bytes, and levels, of the metadata of a bag; those of 100 topics have 1e5 and 6."""

INDEX_ENTRY = 12
"""Bytes of a message in the index of a ROS 1 bag."""


def is_rosbag2(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag of any format; a failure names the file and what to do.

    Raises
    ------
    MissingExtraError
        Where rosbags or mcap is not installed.
    ReadError
        Where it cannot be read, or takes more memory or time than a file of its size can need.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise ReadError(f"{path}: is empty, expected a bag")
    try:
        import mcap.records  # noqa: F401
        import rosbags.rosbag1  # noqa: F401
    except ImportError:
        raise MissingExtraError("ros", "reading ROS bags") from None
    open_one = _folder if path.is_dir() else OPENERS[path.suffix.lower()]
    with naming(path), reported("bag", REPAIR), open_one(path) as bag:
        yield bag


@contextmanager
def _ros1(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag by rosbags, with bounds on what its chunks and its index may take."""
    import lz4.frame
    from rosbags import rosbag1

    size = path.stat().st_size
    spend = allowance(size)
    indexed = 0
    kinds = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}

    class Reader(rosbag1.Reader):
        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            kind = kinds.get(chunk.decompressor, "")
            return chunk._replace(decompressor=lambda data: unpacked(kind, data, spend))

        def read_index_data(self, pos: int, indexes: Any) -> None:
            nonlocal indexed
            file: Any = self.bio
            start = file.tell()
            super().read_index_data(pos, indexes)
            indexed += file.tell() - start
            if indexed > min(size, MAX_MESSAGES * INDEX_ENTRY):
                raise ReadError(
                    f"its index has more than {indexed // INDEX_ENTRY:,} messages; up to "
                    f"{MAX_MESSAGES:,} are read, and no more than fit into its {size:,} bytes"
                )

    with Reader(path) as reader:

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            wanted = [own for own in reader.connections if (own.topic, own.msgtype) == (name, kind)]
            for _, stamp, data in reader.messages(connections=wanted):
                spend(len(data))
                yield stamp, data, "ros1"

        parts = ((own.topic, own.msgtype, own.msgcount) for own in reader.connections)
        yield Bag(counted_topics(parts), messages)


OPENERS = {".bag": _ros1, ".db3": open_sqlite, ".mcap": open_mcap}

BAGS = tuple(OPENERS)
"""Suffixes of bags."""


@contextmanager
def _folder(path: Path) -> Iterator[Bag]:
    """Open the files of a ROS 2 bag one after the other, as its metadata name them."""
    about = _metadata(path)
    storage = str(about["storage_identifier"])
    suffix = {"mcap": ".mcap", "sqlite3": ".db3"}.get(storage)
    mode = str(about.get("compression_mode") or "none").lower()
    kind = str(about.get("compression_format") or "")
    is_known = mode == "none" or (mode in ("file", "message") and kind == "zstd")
    if suffix is None or not is_known:
        raise ReadError(
            f"its storage is {storage}, its compression {mode} {kind}; "
            "expected mcap or sqlite3, and none or zstd"
        )
    files = [path / PurePath(str(name)).name for name in about["relative_file_paths"]]
    spend = allowance(sum(file.stat().st_size for file in files))
    with ExitStack() as stack:
        if mode == "file":
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            packed, files = files, [folder / f"{k}{suffix}" for k in range(len(files))]
            for file, to in zip(packed, files, strict=True):
                unpack_file(file, to, "zstd", spend)
        bags = []
        for file in files:
            with naming(file.name):
                bags.append(stack.enter_context(OPENERS[suffix](file)))
        packing = "zstd" if mode == "message" else ""

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            for bag, file in zip(bags, files, strict=True):
                with naming(file.name):
                    for stamp, data, encoding in bag.messages(name, kind):
                        yield stamp, unpacked(packing, data, spend), encoding

        topics = [(own.name, own.kind, own.count) for bag in bags for own in bag.topics]
        yield Bag(counted_topics(topics), messages)


def _metadata(path: Path) -> dict[str, Any]:
    """Read what the metadata of a ROS 2 bag say of its files.

    Raises
    ------
    ReadError
        Where they are longer than any, nested without end, or have aliases, which grow.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

    file = path / METADATA
    with file.open("rb") as read:
        text = read.read(MAX_METADATA + 1)
    depth, is_plain = 0, len(text) <= MAX_METADATA
    for event in YAML(typ="safe").parse(text) if is_plain else ():
        depth += isinstance(event, CollectionStartEvent)
        depth -= isinstance(event, CollectionEndEvent)
        is_plain &= depth <= DEEPEST_METADATA and not isinstance(event, AliasEvent)
        if not is_plain:
            break
    if not is_plain:
        raise ReadError(
            f"{METADATA}: more than {MAX_METADATA:,} bytes or {DEEPEST_METADATA} levels, or an "
            "alias, which the metadata of no bag have"
        )
    found: dict[str, Any] = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
    return found
