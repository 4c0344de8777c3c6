"""Packets in bags: the messages in which drivers publish what LiDARs send (the extra ``ros``).

They have been arranged in several ways under one name; the first that fits the bytes is taken.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.resources import files
from typing import Any

from ...base.errors import ReadError
from .capture import Datagram

LAYOUTS: dict[str, list[dict[str, str]]] = tomllib.loads(
    files("retropole.io.packets").joinpath("drivers.toml").read_text(encoding="utf-8")
)
"""By type of message, how it is arranged."""


def datagrams(messages: Iterator[tuple[int, bytes, str]], kind: str) -> Iterator[Datagram]:
    """Extract the packets from messages of a driver, in their order.

    Parameters
    ----------
    messages
        Time (ns), bytes and encoding, as `Bag` gives them.
    kind
        Their type, one of `LAYOUTS`.

    Raises
    ------
    ReadError
        If a message is of no layout that its type has had.
    """
    known = None
    for stamp, data, encoding in messages:
        known, message = _decoded(kind, data, encoding, known)
        for packet in getattr(message, "packets", [message]):
            payload = packet.data.tobytes()
            came = getattr(packet, "stamp", None)
            time = came.sec + came.nanosec / 1e9 if came is not None and came.sec else stamp / 1e9
            yield Datagram(payload[: getattr(packet, "size", len(payload))], "", time)


def _decoded(kind: str, data: bytes, encoding: str, known: int | None) -> tuple[int, Any]:
    """Decode a message, and say in which layout it is."""
    for k in range(len(LAYOUTS[kind])) if known is None else [known]:
        try:
            return k, _decoder(kind, k, encoding)(data)
        except Exception:
            # rosbags lets pass whatever is raised when bytes do not fit.
            continue
    raise ReadError(f"a message of {len(data):,} bytes is not a known {kind}")


@cache
def _decoder(kind: str, layout: int, encoding: str) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1 = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    package = kind.partition("/")[0]
    own = LAYOUTS[kind][layout]
    types = get_types_from_msg(own["frame"], kind)
    if "packet" in own:
        name = own["frame"].rpartition("\n")[2].partition("[")[0]
        types |= get_types_from_msg(own["packet"], f"{package}/msg/{name}")
    store.register(types)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return partial(decode, typename=kind)
