"""The sweeps of a recording with a time for each point, all by one clock."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from ..base.datatypes import Array, PointCloud
from ..base.errors import Refusal
from ..base.sensors import SWEEP_SECONDS
from .recordings import Frame, Recording, is_unix

LOOKED_AT = 20
"""This many frames show the unit of times, and how long a sweep takes."""

RUNS_ON = SWEEP_SECONDS / 4
"""From sweep to sweep times that count from the start of the recording are later by more, s."""

ONE_WAY = 0.8
"""Part of all steps from point to point that must go one way about where a LiDAR spins (chosen: it
is 1 but for jitter, and next to nothing for rosettes and what was sorted)."""

BACK = float(np.radians(2.0))
"""A step this far back is none of almost a whole turn, rad: beams of one column differ by less."""

MORE_THAN_A_TURN = 1.2
"""No sweep has more turns (chosen)."""

NAME = re.compile(r"(?:^|\D)(?:(\d{9,10})(?:\.(\d{1,9})|[_-](\d{9}|\d{6}|\d{3}))|(\d{13,19}))$")
"""How names end that are Unix times: seconds and a fraction, or milli-, micro- or nanoseconds."""

LONGEST = 0.5
"""Times that begin farther from zero, s, are not used from their sweep's stamp: their begin is
taken off, as of those that begin again with each second."""


def timed_frames(recording: Recording, numbers: range) -> Iterator[Frame]:
    """Read frames one by one, each point with its time by the clock of the recording.

    Times that count from the start of each sweep are added to the frame's stamp: that of its
    message, of the recorder, or in its file's name. Points without times have those that their
    azimuths say, where the LiDAR spins and their order is that of the beams.

    Parameters
    ----------
    recording, numbers
        What to read, and which of its frames.

    Raises
    ------
    Refusal
        ``no_times``, with what is missing.
    ReadError
        As ``recording.read``.
    """
    coming = (frame for frame in recording.read(numbers) if len(frame.cloud))
    first = deque(islice(coming, LOOKED_AT))
    timing = Timing(first, str(recording.path))
    # None is kept: they would take a tenth of a gigabyte until the last is read.
    while first:
        yield timing.timed(first.popleft())
    yield from map(timing.timed, coming)


class Timing:
    """How the points of one LiDAR's sweeps get their times, as its first sweeps show it.

    Parameters
    ----------
    first
        Some frames with points, at most `LOOKED_AT`.
    name
        What messages call the recording.
    """

    def __init__(self, first: Sequence[Frame], name: str) -> None:
        self._name, self._runs_on, self._before = name, _runs_on(first), -np.inf
        stamps = [None if self._runs_on else stamp_of(frame) for frame in first]
        self._period = _period(first, stamps)

    def timed(self, frame: Frame) -> Frame:
        """Give the next frame a time for each point, as `timed_frames` says.

        Raises
        ------
        Refusal
            ``no_times``, with what is missing.
        """
        cloud, stamp = frame.cloud, None if self._runs_on else stamp_of(frame)
        if not self._runs_on:
            if stamp is None or stamp <= self._before:
                raise _no_times(cloud, self._name, stamp)
            self._before = stamp
            within = times_by_azimuth(cloud, self._period) if cloud.time is None else cloud.time
            if within is None:
                raise _no_times(cloud, self._name, stamp)
            begin = float(within.min())
            stamp -= begin if abs(begin) > LONGEST else 0.0
            cloud = replace(cloud, time=stamp + within)
        elif cloud.time is None:
            raise _no_times(cloud, self._name, None)
        return replace(frame, cloud=cloud)


def _runs_on(frames: Sequence[Frame]) -> bool:
    """Whether times of points count on from sweep to sweep."""
    starts = [float(f.cloud.time.min()) for f in frames if f.cloud.time is not None]
    return len(starts) == len(frames) and bool(np.all(np.diff(starts) > RUNS_ON))


def stamp_of(frame: Frame) -> float | None:
    """When a frame begins, s: by its message, its recorder or the name of its file, or None."""
    if frame.clock is not None:
        return frame.clock
    return time_in(Path(frame.cloud.source).stem) if frame.stamp is None else frame.stamp


def time_in(name: str) -> float | None:
    """Read the Unix time, s, that the name of a file ends with; None if it does not.

    Parameters
    ----------
    name
        Without its suffix: ``1698765432.123456``, ``lidar_1698765432123456789``.
    """
    found = NAME.search(name)
    if found is None:
        return None
    whole, fraction, padded, ticks = found.groups()
    if ticks is not None:
        return next((s for k in (9, 6, 3) if is_unix(s := int(ticks) / 10**k)), None)
    seconds = float(f"{whole}.{fraction or padded}")
    return seconds if is_unix(seconds) else None


def _period(frames: Sequence[Frame], stamps: Sequence[float | None]) -> float:
    known = [
        (frame.number, stamp)
        for frame, stamp in zip(frames, stamps, strict=True)
        if stamp is not None
    ]
    if len(known) < 2:
        return SWEEP_SECONDS
    number, stamp = np.array(known).T
    return float(np.median(np.diff(stamp) / np.diff(number)))


def times_by_azimuth(cloud: PointCloud, period: float) -> Array | None:
    """Times (N,) of points since the first beam, s, of a LiDAR that turns once in a period, s.

    Points follow each other as they were measured, all together or ring by ring. None if they
    do not turn one way.

    Parameters
    ----------
    cloud
        One sweep, in the LiDAR's frame.
    period
        Of the sweep, s.
    """
    first = np.cross(cloud.axis, np.eye(3)[int(np.argmin(np.abs(cloud.axis)))])
    rays = cloud.xyz - cloud.origin
    azimuth = np.arctan2(rays @ np.cross(cloud.axis, first), rays @ first)
    ring = np.zeros(len(cloud), np.int64) if cloud.ring is None else cloud.ring
    order = np.argsort(ring, kind="stable")
    azimuth, ring = azimuth[order], ring[order]
    is_first = np.r_[True, ring[1:] != ring[:-1]]
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    step = step[~is_first[1:]]
    turned_in_all = float(step.sum())
    if abs(turned_in_all) <= ONE_WAY * np.abs(step).sum():
        return None
    way = np.sign(turned_in_all)
    # Rings begin together, but for those whose first beams hit nothing: before the others none.
    begun = azimuth[is_first]
    middle = np.angle(np.exp(1j * begun).mean())
    off = way * ((begun - middle + np.pi) % (2 * np.pi) - np.pi)
    start = middle + way * float(np.quantile(off, 0.1))
    ahead = np.diff(azimuth, prepend=azimuth[0])
    ahead[is_first] = begun - start
    ahead = (way * ahead + BACK) % (2 * np.pi) - BACK
    turned = np.cumsum(ahead)
    turned -= (turned - ahead)[is_first][np.cumsum(is_first) - 1]
    if turned.max() > MORE_THAN_A_TURN * 2 * np.pi:
        return None
    times = np.empty(len(cloud))
    times[order] = turned / (2 * np.pi) * period
    return times


def _no_times(cloud: PointCloud, name: str, stamp: float | None) -> Refusal:
    if stamp is None:
        what = "its sweeps have no times, neither in the data nor in the names of their files"
        if cloud.time is not None:
            what = f"the times of its points are relative to each sweep, and {what}"
    elif cloud.time is None:
        what = (
            "its points have no times, and are not in the order of rotation, from "
            "which the times could be computed"
        )
    else:
        what = "a sweep has the same time as the previous one, or an earlier one"
    return Refusal(
        "no_times",
        f"{cloud.source or name}: {what}; record with a time for each point",
        {"points": len(cloud)},
    )
