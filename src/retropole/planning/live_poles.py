"""Sweeps as they arrive: the poles in each, their identity and motion, and the sweeps that are
kept while all are at rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Detection, PointCloud, Pole
from ..base.errors import ReadError, Refusal, quoting
from ..base.quantities import counted
from ..base.se3 import lengths
from ..base.sensors import Sensor
from ..extraction.acceptance_shape import MIN_POLE_RINGS
from ..extraction.candidates import with_candidates, with_dimmer_candidates
from ..extraction.poles import extract_poles
from ..hypotheses.correspondence import line_pair, widest_angle
from ..io import Frame
from ..io.live import Source
from ..result.watching import LidarNow, PoleNow
from ..verdict import FEW_POINTS

AT_EDGE = 0.5
"""Distance from the end of the field of view, metres, within which a pole would leave it when
leaning by 15°."""

STILL = 1.0
"""A pole that did not move for this long is stationary, s."""

MOVED, MOVED_FAR = 0.06, 0.004
"""A pole moved if the middle or an end of its returns is this far from its previous line, metres,
plus this much per metre of range: lines of one sweep scatter by half of that on simulated poles
(benchmarks/watch.py, seeds to 99)."""

SAME = 0.5
"""A line no farther than this from the previous position of a pole is the same pole, metres:
somebody carries it."""

LATELY, REMEMBERED = 1.0, 30.0
"""A pole is present if it was seen within the first time, and missing for the second time after,
s: one at the limit of detection is not found in every sweep."""

LATELY_CAME = 3.0
"""The rates at which sweeps arrive and are searched are averaged over this many seconds."""

SAME_ANGLE, SAME_GAP, PARALLEL = float(np.radians(6.0)), 0.2, float(np.radians(3.0))
"""Two LiDARs see the same two poles if the angles between them, rad, and the distances, metres,
differ by less; nearer to parallel than the last, rad, the distance is that of parallel lines."""

SWEEPS = 15
"""Number of sweeps of each LiDAR that are kept for a placement."""

LEAST_SECONDS = 3.0
"""Shortest duration of a placement, s: at a higher rate more sweeps are kept, so that a sway is
seen."""

MOST_SWEEPS = 150
"""More are not kept, 15 s at 10 Hz: 1.5 GB of two LiDARs with 100,000 points."""

NEW_PLACEMENT = 0.3
"""A pole this far from where it was, metres, or one more, is another placement."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A pole followed from sweep to sweep.

    Attributes
    ----------
    number
        From 1, by the order of appearance; kept while it is remembered.
    pole
        As last seen.
    rest
        As seen when it came to rest.
    since, seen
        When it came to rest, and when it was last seen, s.
    has_moved
        Whether it was seen to move before it came to rest.
    """

    number: int
    pole: Pole
    rest: Pole
    since: float
    seen: float
    has_moved: bool = False

    def is_still(self, now: float) -> bool:
        """Whether it has not moved for `STILL`."""
        return self.seen - self.since >= STILL and now - self.seen <= LATELY

    @property
    def distance(self) -> float:
        """Of the pole from the LiDAR, metres; beams start near the origin."""
        return float(np.linalg.norm(self.pole.point))


@dataclass(frozen=True, eq=False)
class Looked:
    """A sweep that was searched for poles.

    Attributes
    ----------
    at
        When it came, s.
    cloud
        The sweep.
    poles
        That it shows.
    refusal
        Why it could not be searched.
    doubtful, why, dim
        If fewer than two poles are found: lines that may be poles, in words why each is doubtful,
        and lines whose tape is too dim for the threshold.
    threshold
        Intensity from which a return was treated as tape; NaN if it was not searched.
    """

    at: float
    cloud: PointCloud
    poles: tuple[Pole, ...] = ()
    refusal: Refusal | None = None
    doubtful: tuple[Pole, ...] = ()
    why: tuple[str, ...] = ()
    dim: tuple[Pole, ...] = ()
    threshold: float = float("nan")


def look(
    cloud: PointCloud,
    at: float,
    *,
    sensor: Sensor | None,
    threshold: float | None,
    radius: float,
) -> Looked:
    """Search one sweep for poles, and if too few are found for candidates."""
    try:
        found = extract_poles(cloud, sensor=sensor, threshold=threshold, radius=radius)
        if len(found.poles) > 1:
            return Looked(at, cloud, found.poles, threshold=found.threshold)
        doubtful = with_candidates(cloud, found, radius, sensor)
        dim = with_dimmer_candidates(cloud, doubtful, radius, sensor)
    except Refusal as refusal:
        return Looked(at, cloud, refusal=refusal)
    new = _other_candidates(doubtful.candidates, found)
    return Looked(
        at,
        cloud,
        found.poles,
        doubtful=new,
        why=tuple(_why(each, doubtful) for each in new),
        dim=tuple(p for p in _other_candidates(dim.candidates, found) if not _is_any(p, new)),
        threshold=found.threshold,
    )


def _why(pole: Pole, found: Detection) -> str:
    """Why a candidate is not a pole: the reason given for the cluster with most of its returns."""
    shared = [(np.isin(each.index, pole.index).sum(), each.reason) for each in found.rejected]
    return max(shared, default=(0, ""))[1]


def _other_candidates(candidates: Sequence[Pole], found: Detection) -> tuple[Pole, ...]:
    """Those that are none of the poles."""
    return tuple(each for each in candidates if not _is_any(each, found.poles))


def _is_any(pole: Pole, others: Sequence[Pole]) -> bool:
    return any(away_from(pole, other) < SAME for other in others)


def away_from(pole: Pole, other: Pole) -> float:
    """Largest distance of the middle and the ends of a pole's returns from the line of another."""
    along = pole.direction * pole.length / 2
    points = np.stack([pole.point, pole.point - along, pole.point + along]) - other.point
    across = points - np.outer(points @ other.direction, other.direction)
    return float(lengths(across).max())


def follow(tracks: Sequence[Tracked], looked: Looked) -> tuple[Tracked, ...]:
    """Track the known poles into a sweep; new ones get the lowest free number."""
    left = list(tracks)
    followed = list[Tracked]()
    fresh = list[Pole]()
    for pole in looked.poles:
        near = [(float(np.linalg.norm(pole.point - t.pole.point)), t) for t in left]
        gap, known = min(near, key=lambda each: each[0], default=(np.inf, None))
        # Of a tall pole other parts may be seen in the next sweep.
        if known is None or gap > SAME + pole.length / 2:
            fresh.append(pole)
            continue
        left.remove(known)
        limit = MOVED + MOVED_FAR * known.distance
        if away_from(pole, known.rest) > limit:
            followed.append(Tracked(known.number, pole, pole, looked.at, looked.at, has_moved=True))
        else:
            followed.append(replace(known, pole=pole, seen=looked.at))
    followed += [each for each in left if looked.at - each.seen <= REMEMBERED]
    received = {each.number for each in followed}
    for pole in fresh:
        number = next(n for n in range(1, len(received) + 2) if n not in received)
        received.add(number)
        followed.append(Tracked(number, pole, pole, looked.at, looked.at))
    return tuple(sorted(followed, key=lambda each: each.number))


def present(tracks: Sequence[Tracked], now: float) -> tuple[Tracked, ...]:
    """Those that were seen recently."""
    return tuple(each for each in tracks if now - each.seen <= LATELY)


def hidden_by(cloud: PointCloud, pole: Pole) -> float | None:
    """Distance of the object that hides a pole, metres; None if it is not hidden.

    0 if it is too near to be measured.
    """
    seen = cloud.xyz - cloud.origin
    ranges = lengths(seen)
    to = pole.xyz - cloud.origin
    away = float(np.median(lengths(to)))
    middle = to.mean(axis=0) / np.linalg.norm(to.mean(axis=0))
    half = np.arctan2(pole.length / 2, away)
    level = np.cross(middle, pole.direction)
    sine = float(np.linalg.norm(level))
    if sine < 1e-3:
        return None
    # The pole is a strip: along it as far as its returns, across it as far as an object may hide
    # it. That is 0.4 m nearer, three returns at least.
    beams = seen / ranges[:, None]
    across = np.abs(beams @ (level / sine))
    ahead = beams @ middle
    beside = np.radians(1.5)
    strip = (across < np.sin(beside)) & (ahead > np.cos(half + beside))
    before = strip & (ranges < away - 0.4)
    if np.count_nonzero(before) < 3:
        # With this few returns at any distance, an object is nearer than the LiDAR can measure.
        return 0.0 if np.count_nonzero(strip) < 0.1 * len(pole.xyz) else None
    return float(np.median(ranges[before]))


def is_same_pair(one: tuple[Pole, Pole], other: tuple[Pole, Pole]) -> bool:
    """Whether two LiDARs may see the same two poles: lines at the same angle and distance."""
    (angle, gap), (other_angle, other_gap) = _relation(*one), _relation(*other)
    return abs(angle - other_angle) < SAME_ANGLE and abs(gap - other_gap) < SAME_GAP


def _relation(a: Pole, b: Pole) -> tuple[float, float]:
    """Angle between two lines, rad, and their least distance, metres."""
    angle = widest_angle([a.direction, b.direction])
    if np.sin(angle) < PARALLEL:
        return angle, float(np.linalg.norm(np.cross(b.point - a.point, a.direction)))
    pair = line_pair(a.point, a.direction, b.point, b.direction)
    return pair.angle, pair.distance


def angle_between(poles: Sequence[Pole]) -> float | None:
    """Largest angle between any two poles, rad; None of fewer than two."""
    return widest_angle([each.direction for each in poles]) if len(poles) > 1 else None


@dataclass(frozen=True, eq=False)
class View:
    """A LiDAR and its current view.

    Attributes
    ----------
    name
        Its name in messages.
    tracks
        The poles that it saw recently.
    looked
        Its newest sweep that was searched; None before the first.
    silent
        Why nothing arrives; empty while sweeps arrive.
    fault
        The fault of the data; empty if there is none.
    sensor
        Its model; None if it is not known.
    """

    name: str
    tracks: tuple[Tracked, ...] = ()
    looked: Looked | None = None
    silent: str = ""
    fault: str = ""
    sensor: Sensor | None = None

    def is_at_edge(self, pole: Pole) -> bool:
        """Whether a pole is half a metre or less inside the end of the field of view."""
        if self.sensor is None:
            return False
        margin = np.arctan2(AT_EDGE, float(np.hypot(*pole.point[:2])))
        inside = self.sensor.has_in_view(pole.point[None])
        return bool(inside[0] and not self.sensor.has_in_view(pole.point[None], margin)[0])


def fault_of(track: Tracked, now: float) -> str:
    """The fault of a pole, in two or three words; empty if there is none."""
    if now - track.seen > LATELY:
        return "lost"
    if not track.is_still(now):
        return "moving" if track.has_moved else "new"
    if len(track.pole.xyz) < FEW_POINTS:
        return "few returns"
    return "few rings" if track.pole.rings <= MIN_POLE_RINGS else ""


class Origin(NamedTuple):
    """Origin of sweeps: the name of their frame, and the sender of their packets."""

    frame_id: str
    sender: str

    @property
    def text(self) -> str:
        """Both as text."""
        frame = f"frame {self.frame_id!r}" if self.frame_id else ""
        return " ".join(filter(None, (self.sender, frame))) or "a frame without a name"


@dataclass
class Watched:
    """State of a LiDAR while it is watched: its sweeps are searched from this intensity up.

    Once a placement is kept, sweeps of another origin are not of this LiDAR. Of one that does not
    repeat its pattern the `recent` sweeps are searched together.
    """

    source: Source
    view: View
    threshold: float | None
    origin: Origin | None = None
    kept: Origin | None = None
    came: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=100))
    recent: deque[PointCloud] = field(default_factory=deque)

    def accumulated(self, cloud: PointCloud) -> PointCloud:
        """Give a sweep merged with as many previous ones as are needed to show a pole well."""
        sweeps = 1 if self.view.sensor is None else self.view.sensor.sweeps
        if sweeps == 1 or cloud.intensity is None:
            return cloud
        self.recent.append(cloud)
        while len(self.recent) > sweeps:
            self.recent.popleft()
        own = [each for each in self.recent if each.intensity is not None]
        intensity = np.concatenate([each.intensity for each in own if each.intensity is not None])
        xyz = np.concatenate([each.xyz for each in own])
        return replace(cloud, xyz=xyz, intensity=intensity, ring=None, time=None, frame=None)

    @property
    def frame_id(self) -> str | None:
        """Of the newest sweep, empty if it names none; None before the first sweep."""
        return self.origin.frame_id if self.origin else None


class Received(NamedTuple):
    """Data from a LiDAR: a usable sweep, or None; what to report about it; whether its
    frame differs from the previous ones."""

    frame: Frame | None = None
    messages: tuple[str, ...] = ()
    is_of_another_frame: bool = False


def take(lidar: Watched, radius: float, clock: Callable[[], float], *, busy: bool) -> Received:
    """Read the newest sweep of a LiDAR, and search it for stationary poles.

    Parameters
    ----------
    lidar
        Its view is brought up to date.
    radius
        Of the poles, metres.
    clock
        Gives the time, s.
    busy
        Search rarely.
    """
    received, now, view = receive(lidar, clock), clock(), lidar.view
    if received.frame is None:
        return received
    # While the answer is computed, both share the time.
    if busy and view.looked is not None and now - view.looked.at < 0.8:
        return received._replace(frame=None)
    cloud = lidar.accumulated(received.frame.cloud)
    looked = look(cloud, now, sensor=view.sensor, threshold=lidar.threshold, radius=radius)
    tracks = follow(view.tracks, looked)
    lidar.view = replace(view, tracks=tracks, looked=looked, silent="", fault="")
    return received


def receive(lidar: Watched, clock: Callable[[], float]) -> Received:
    """Read the newest sweep of a LiDAR, with returns and from the same origin as before."""
    view = lidar.view
    try:
        frame = lidar.source.newest(0.05)
    except ReadError as error:
        lidar.view = replace(view, fault=str(error))
        return Received(messages=() if view.fault == str(error) else (str(error),))
    if frame is None:
        lidar.view = replace(view, silent=quoting(lidar.source.waits_for))
        return Received()
    now = clock()
    messages, is_other = list[str](), False
    origin = Origin(frame.frame_id, frame.sender)
    if lidar.origin != origin:
        messages += frame.cloud.notes
        is_other = lidar.origin is not None
        if is_other:
            messages.append(f"its sweeps now come from {origin.text}")
        lidar.origin = origin
    if lidar.kept not in (None, origin):
        fault = f"its sweeps come from {origin.text}, the stored ones from {lidar.kept.text}"
        lidar.view = replace(view, fault=fault)
        return Received(None, tuple(messages), is_other)
    lidar.came.append((now, frame.number))
    if not len(frame.cloud):
        lidar.view = replace(view, fault="its sweep has no returns")
        return Received(None, tuple(messages), is_other)
    return Received(frame, tuple(messages), is_other)


def seen_now(lidar: Watched, now: float) -> LidarNow:
    """Describe the current view of a LiDAR."""
    view, looked = lidar.view, lidar.view.looked
    came = list(lidar.came)
    recent = [(at, number) for at, number in came if now - at <= LATELY_CAME]
    if len(recent) < 3 and not view.silent:
        # To search both may take longer.
        recent = came[-3:]
    rate, skipped = 0.0, ""
    if len(recent) > 1:
        (first, number), (last, newest) = recent[0], recent[-1]
        rate = (newest - number) / max(last - first, 0.05)
        if last - first >= LATELY_CAME / 3:
            skipped = _skipped(view.name, newest - number, len(recent) - 1, last - first)
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
        for word in [fault_of(track, now)]
    ]
    return LidarNow(
        name=view.name,
        source=lidar.source.name,
        sweeps_per_s=max(rate, 0.0),
        age_s=None if looked is None else max(now - looked.at, 0.0),
        points=0 if looked is None else len(looked.cloud),
        poles=poles,
        word=view.fault or view.silent,
        skipped=skipped,
    )


def _skipped(name: str, came: int, taken: int, seconds: float) -> str:
    """Report how many of the sweeps that arrived were not used; nothing if all were."""
    if taken >= came:
        return ""
    return (
        f"skipped {came - taken} of {counted(came, 'sweep')} of {name}: this computer decodes and "
        f"searches {taken / seconds:.2g} a second"
    )


@dataclass(frozen=True, eq=False)
class Capture:
    """The data kept for one placement.

    Attributes
    ----------
    frames
        Of each LiDAR.
    start
        When it began, s.
    seconds
        Its required duration.
    poles
        That each LiDAR saw at its start.
    """

    frames: tuple[tuple[Frame, ...], ...]
    start: float
    poles: tuple[tuple[Tracked, ...], ...]
    seconds: float = LEAST_SECONDS

    @property
    def count(self) -> int:
        """Number of sweeps kept for the LiDAR that has the fewest."""
        return min(len(own) for own in self.frames)

    def with_frame(self, lidar: int, frame: Frame) -> Capture:
        """Keep one more sweep; none beyond `MOST_SWEEPS`."""
        own = self.frames[lidar]
        if len(own) >= MOST_SWEEPS:
            return self
        frames = (*self.frames[:lidar], (*own, frame), *self.frames[lidar + 1 :])
        return replace(self, frames=frames)

    def is_full(self, wanted: int, now: float) -> bool:
        """Whether there are enough sweeps, over enough time."""
        enough = self.count >= wanted and now - self.start >= self.seconds
        return enough or self.count >= MOST_SWEEPS


def begun(tracks: Sequence[Sequence[Tracked]], now: float) -> Capture:
    """Begin to keep sweeps of this placement."""
    return Capture(tuple(() for _ in tracks), now, tuple(present(own, now) for own in tracks))


def is_new_placement(capture: Capture, tracks: Sequence[Sequence[Tracked]], now: float) -> bool:
    """Whether the poles have moved since a placement was kept."""
    for was, own in zip(capture.poles, tracks, strict=True):
        for each in present(own, now):
            gaps = [max(away_from(each.pole, old.pole), _along(each, old)) for old in was]
            if min(gaps, default=np.inf) > NEW_PLACEMENT:
                return True
    return False


def _along(new: Tracked, old: Tracked) -> float:
    """Distance of the middle beyond the previous returns, metres."""
    gap = abs(float((new.pole.point - old.pole.point) @ old.pole.direction))
    return max(gap - old.pole.length / 2, 0.0)
