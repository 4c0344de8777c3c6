"""What is asked for of a watch, what comes of each LiDAR, and what is said of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ..base.errors import ReadError, UsageError, quoting
from ..base.sensors import Sensor
from ..io import Frame
from ..io.live import Source
from ..result import RunConfig
from ..result.pole_plan import PolePlanDoc
from ..result.watching import LidarNow, PoleNow
from ..watching.advice import View, word_on
from ..watching.capture import SWEEPS
from ..watching.seeing import follow, look, present
from .checking import CheckResult, Stored

POLL = 0.05
"""A LiDAR is waited for so long where it has nothing new, s."""

WORKING = 0.8
"""While the answer is worked out, sweeps are searched so rarely, s: both share the time."""

RATE_OVER = 3.0
"""Seconds over which sweeps are counted."""

SHORTEST = 0.05
"""They are not counted over less."""


@dataclass(frozen=True)
class Wish:
    """What is asked for of a watch.

    Attributes
    ----------
    config
        As of a calibration: radius, sensors, thresholds, the need.
    names
        What words call target and source.
    sweeps
        Of each LiDAR that are kept of a placement.
    plan
        Where the poles should stand; with its names of the LiDARs as `names`.
    stored
        A result to test the rig against, instead of a calibration.
    """

    config: RunConfig
    names: tuple[str, str] = ("target", "source")
    sweeps: int = SWEEPS
    plan: PolePlanDoc | None = None
    stored: Stored | None = None

    def __post_init__(self) -> None:
        """Check the names.

        Raises
        ------
        UsageError
            Where the plan has no LiDARs of these names.
        """
        planned = None if self.plan is None else {each.name for each in self.plan.lidars}
        if planned is not None and not planned >= set(self.names):
            raise UsageError(
                f"the plan is for {', '.join(sorted(planned))}: name both LiDARs so, not "
                f"{' and '.join(self.names)}"
            )


class Origin(NamedTuple):
    """Where sweeps come from: the name of their frame, and who sends their packets."""

    frame_id: str
    sender: str

    @property
    def words(self) -> str:
        """Both as text."""
        frame = f"frame {self.frame_id!r}" if self.frame_id else ""
        return " ".join(filter(None, (self.sender, frame))) or "a frame without a name"


@dataclass
class Watched:
    """What is known of a LiDAR while it is watched: its sweeps are searched as of this sensor, from
    this intensity up. Once a placement is kept, sweeps of another origin are not of this LiDAR."""

    source: Source
    view: View
    sensor: Sensor | None
    threshold: float | None
    origin: Origin | None = None
    kept: Origin | None = None
    came: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=100))

    @property
    def frame_id(self) -> str | None:
        """Of the newest sweep, empty where it names none; None before the first sweep."""
        return self.origin.frame_id if self.origin else None


class Taken(NamedTuple):
    """What came of a LiDAR: a sweep that was searched, or None; what is to be said of it; whether
    it is of another frame than those before."""

    searched: Frame | None = None
    said: tuple[str, ...] = ()
    is_of_another_frame: bool = False


def take(lidar: Watched, radius: float, clock: Callable[[], float], *, busy: bool) -> Taken:
    """Take the newest sweep of a LiDAR, and search it.

    Parameters
    ----------
    lidar
        Its view is brought up to date.
    radius
        Of the poles, metres.
    clock
        Gives the time, s.
    busy
        Search but rarely.
    """
    view = lidar.view
    try:
        frame = lidar.source.newest(POLL)
    except ReadError as error:
        lidar.view = replace(view, fault=str(error))
        return Taken(said=() if view.fault == str(error) else (str(error),))
    if frame is None:
        lidar.view = replace(view, silent=quoting(lidar.source.waits_for))
        return Taken()
    now = clock()
    said, is_other = list[str](), False
    origin = Origin(frame.frame_id, frame.sender)
    if lidar.origin != origin:
        said += frame.cloud.notes
        is_other = lidar.origin is not None
        if is_other:
            said.append(f"its sweeps come from {origin.words} now")
        lidar.origin = origin
    if lidar.kept not in (None, origin):
        fault = f"its sweeps come from {origin.words}, those that are kept from {lidar.kept.words}"
        lidar.view = replace(view, fault=fault)
        return Taken(None, tuple(said), is_other)
    lidar.came.append((now, frame.number))
    if busy and view.looked is not None and now - view.looked.at < WORKING:
        return Taken(None, tuple(said), is_other)
    if not len(frame.cloud):
        lidar.view = replace(view, fault="its sweep has no returns")
        return Taken(None, tuple(said), is_other)
    looked = look(frame.cloud, now, sensor=lidar.sensor, threshold=lidar.threshold, radius=radius)
    tracks = follow(view.tracks, looked)
    lidar.view = replace(view, tracks=tracks, looked=looked, silent="", fault="")
    return Taken(frame, tuple(said), is_other)


def seen_now(lidar: Watched, now: float) -> LidarNow:
    """Say what a LiDAR sees now."""
    view, looked = lidar.view, lidar.view.looked
    recent = [(at, number) for at, number in lidar.came if now - at <= RATE_OVER]
    rate = 0.0
    if len(recent) > 1:
        rate = (recent[-1][1] - recent[0][1]) / max(recent[-1][0] - recent[0][0], SHORTEST)
    poles = [
        PoleNow(
            name=str(track.number),
            distance_m=track.distance,
            returns=len(track.pole.xyz),
            rings=track.pole.rings if looked and looked.cloud.ring is not None else None,
            is_still=track.is_still(now),
            is_good=not word,
            word=word,
        )
        for track in present(view.tracks, now)
        for word in [word_on(track, now)]
    ]
    return LidarNow(
        name=view.name,
        source=lidar.source.name,
        sweeps_per_s=max(rate, 0.0),
        age_s=None if looked is None else max(now - looked.at, 0.0),
        points=0 if looked is None else len(looked.cloud),
        poles=poles,
        word=view.fault or view.silent,
    )


def checked_words(checked: CheckResult) -> str:
    """Say what a check found."""
    words = {"same": "Same: both LiDARs stand where they stood.", "moved": "Moved: calibrate anew."}
    said = " ".join(reason.message for reason in checked.reasons[:1])
    return words.get(checked.status, f"Cannot tell: {said}")
