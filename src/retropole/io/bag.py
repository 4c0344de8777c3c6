"""What all kinds of bags have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from .recordings import Topic

MAX_MESSAGES = 2**22
"""More are not read: those of 200 topics at 10 Hz for half an hour, and the index of all of them
is to fit into memory."""


@dataclass(frozen=True, eq=False)
class Bag:
    """An open bag.

    Attributes
    ----------
    topics
        By name.
    messages
        From the name and the type of a topic to time (ns), bytes and encoding of its messages. The
        encoding is ``ros1`` or ``cdr``.
    """

    topics: tuple[Topic, ...]
    messages: Callable[[str, str], Iterator[tuple[int, bytes, str]]]


def counted(parts: Iterable[tuple[str, str, int]]) -> tuple[Topic, ...]:
    """Make topics of names, types and numbers of messages; equal ones are added up."""
    counts: dict[tuple[str, str], int] = {}
    for name, kind, count in parts:
        counts[name, kind] = counts.get((name, kind), 0) + count
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))
