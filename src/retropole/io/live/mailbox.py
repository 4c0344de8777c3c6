"""The newest of what comes from a thread: what nobody took before the next came is left out."""

from __future__ import annotations

from threading import Condition
from typing import Generic, TypeVar

T = TypeVar("T")

QUIET = 2.0
"""Seconds without a sweep after which a source says what it waits for: at 5 Hz, the slowest that
sensors turn, ten sweeps."""


class Mailbox(Generic[T]):
    """Hands the newest item from the thread that puts it to the one that takes it."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._held: tuple[int, T] | None = None
        self._count = 0
        self._is_closed = False

    def put(self, item: T) -> None:
        """Put an item in the place of the one before."""
        with self._changed:
            self._held = self._count, item
            self._count += 1
            self._changed.notify_all()

    def take(self, wait: float) -> tuple[int, T] | None:
        """Take the newest item and its number, counted from 0; None where none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._held is not None or self._is_closed, wait)
            held, self._held = self._held, None
            return held

    def close(self) -> None:
        """Wake whoever waits, and forget what is held."""
        with self._changed:
            self._held, self._is_closed = None, True
            self._changed.notify_all()
