"""Recordings played again, as fast as they were recorded or at another rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from threading import Event, Lock
from time import monotonic
from typing import NamedTuple

from ...base.errors import UsageError
from .. import open_recording
from ..bags import opened
from ..fields import NANOSECONDS, USUAL, Wanted
from ..recordings import Frame, Recording
from ..ros import frame_of

QUIET = 2.0
"""Seconds without a sweep after which a source reports what it waits for: at 5 Hz, the slowest that
sensors turn, ten sweeps."""

Entry = tuple[float | None, Callable[[], Frame]]
"""Time of a frame, s, or None if it is not known; function that gives the frame."""


class _Next(NamedTuple):
    """A frame that is still to be given, and when: seconds after the first one."""

    due: float
    read: Callable[[], Frame]


class ReplaySource:
    """A recording that is played from the first request for a sweep on.

    Frames that are overdue are left out; those of bags and folders are not even decoded. A file of
    one sweep is played again and again.

    Parameters
    ----------
    path, topic
        As `open_recording` takes them.
    rate
        How many times as fast as it was recorded.
    wanted
        As `open_recording` takes it.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        As `open_recording`, and where the rate is not a positive number.
    """

    def __init__(
        self, path: Path, topic: str | None = None, rate: float = 1.0, wanted: Wanted = USUAL
    ) -> None:
        if not (math.isfinite(rate) and rate > 0):
            raise UsageError(f"{path}: cannot be played at a rate of {rate:g}, expected above 0")
        self.name = f"replay:{path}"
        self._rate = rate
        self._entries = _entries(open_recording(path, topic=topic, wanted=wanted), wanted)
        self._lock = Lock()
        self._closed = Event()
        self._start: float | None = None
        self._first: float | None = None
        self._count = 0
        self._next: _Next | None = None

    @property
    def has_ended(self) -> bool:
        """Whether the last frame was given."""
        return self._start is not None and self._next is None

    @property
    def waits_for(self) -> str:
        """In words why no frame comes: there is none any more, or none was recorded for a while."""
        following = self._next
        if self._start is None:
            return ""
        if following is None:
            return "the recording was played to its end"
        pause = self._start + following.due - monotonic()
        return f"for {pause:.0f} s nothing was recorded" if pause > QUIET else ""

    def newest(self, wait: float) -> Frame | None:
        """Give the newest frame that is due, as `Source` says."""
        until = monotonic() + wait
        with self._lock:
            if self._start is None:
                self._advance()
                self._start = monotonic()
            while self._next is not None and not self._closed.is_set():
                now = monotonic()
                left = self._start + self._next.due - now
                if left <= 0:
                    return self._newest_due(now - self._start)
                if now >= until:
                    return None
                self._closed.wait(min(left, until - now))
        return None

    def close(self) -> None:
        """Close the recording, as in `Source`."""
        self._closed.set()
        with self._lock:
            self._entries.close()

    def _newest_due(self, played: float) -> Frame:
        """Give the last frame that is due by now, and not by when it was looked for: to pass over
        frames takes time, too, and if it takes more than they last no end would come."""
        while self._next is not None and self._next.due <= played:
            newest = self._next
            self._advance()
        return newest.read()

    def _advance(self) -> None:
        self._next = None
        found = next(self._entries, None)
        if found is None:
            return
        stamp, read = found
        if self._first is None:
            self._first = stamp
        # Where it has no times, 10 Hz: what most sensors do by default.
        recorded = self._count / 10.0 if stamp is None else stamp - (self._first or 0.0)
        self._next = _Next(recorded / self._rate, read)
        self._count += 1


def _entries(recording: Recording, wanted: Wanted) -> Generator[Entry, None, None]:
    """Go through the frames of a recording, each read when it is called for where that can be."""
    if recording.model:
        return _of_packets(recording)
    if recording.topic is not None:
        return _of_bag(recording.path, recording.topic, wanted)
    return _of_files(recording)


def _of_bag(path: Path, topic: str, wanted: Wanted) -> Generator[Entry, None, None]:
    with opened(path) as bag:
        kind = next(own.kind for own in bag.topics if own.name == topic and own.of_clouds)
        for number, (stamp, data, encoding) in enumerate(bag.messages(topic, kind)):
            own = number, stamp, data, encoding, kind, wanted
            yield stamp / NANOSECONDS, partial(frame_of, f"{path}: ", topic, *own)


def _of_files(recording: Recording) -> Generator[Entry, None, None]:
    """A sweep alone comes again and again, so that a watch can be tried with it."""
    if recording.count > 1:
        for number in range(recording.count):
            yield None, partial(_frame, recording, number)
        return
    frame = _frame(recording, 0)
    for number in count():
        yield None, partial(replace, frame, number=number)


def _frame(recording: Recording, number: int) -> Frame:
    return next(recording.read(range(number, number + 1)))


def _of_packets(recording: Recording) -> Generator[Entry, None, None]:
    """Only decoding packets shows when a sweep begins."""
    for frame in recording.read(range(recording.count)):
        yield frame.stamp, partial(replace, frame)
