"""`merge --live`: sweeps of LiDARs that record now, in one frame, as they come.

Each LiDAR is read by a separate thread, which keeps its newest sweep alone. A cloud is made of
the newest sweeps once all LiDARs have one, and without those that are late.
"""

from __future__ import annotations

import json
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import TimeoutError, get_context
from multiprocessing.pool import AsyncResult
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from threading import Condition, Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ..base.datatypes import Array
from ..base.errors import Refusal, RetropoleError, UsageError, quoting
from ..base.files import stream_atomically
from ..export.clouds import About, columns_of, comments_of, surfel_columns
from ..export.recording import Track, cloud_publisher, cloud_stream, write_recording
from ..fusion.merging import Points, fused, inside, joined_points, voxels
from ..fusion.surfels import moments_of, surfels_of
from ..io import Frame
from ..io.fields import NANOSECONDS, USUAL, records_of
from ..io.live import Source, open_sources
from ..result.site import LIDARS, SiteDoc, as_site
from .checking import check_recordings, check_site, read_stored
from .merging import placed, warnings_of
from .stored import with_poses

MERGED = "/retropole/points"
"""Topic on which clouds are published."""

LATE = 0.15
"""Longest wait for a sweep, s: one and a half turns at 10 Hz."""

STOPPED = 1.0
"""Seconds without a sweep after which a LiDAR is no longer waited for: ten turns."""

SAME_CLOCK = 1.0
"""The clock of a LiDAR that is nearer to that of this computer is treated as the same, s: a sweep
takes 0.1 s, and its transmission some."""

CLOCK_SWEEPS = 20
"""Sweeps of which the median shows how far the clock of a LiDAR is ahead."""

CHECK_SWEEPS, CHECK_SECONDS, FIRST_CHECK = 3, 60.0, 5.0
"""Sweeps of each LiDAR that are checked against the result, how often, and when first, s."""

LONGEST_CHECK = 300.0
"""A check that takes longer has lost its process, s: with ten LiDARs it takes a tenth of this
time."""


@dataclass(frozen=True, eq=False)
class LiveWish:
    """How clouds of LiDARs that record now are made, and where they go.

    Attributes
    ----------
    topic
        On which they are published by DDS; None publishes nothing.
    out
        MCAP file that they are written to, or None.
    frame
        As `merging.placed` takes it.
    voxel, crop, surfels
        As `merging.merge` takes them.
    clocks
        By the names of LiDARs, how far their clocks are ahead of that of this computer, s.
    every
        How often sweeps are checked against the result, s; None checks nothing.
    domain, interface
        Of ROS 2, as `io.live.dds.DdsSource` takes them.
    """

    topic: str | None = MERGED
    out: Path | None = None
    frame: str = ""
    voxel: float | None = None
    crop: Array | None = None
    surfels: float | None = None
    clocks: Mapping[str, float] = field(default_factory=dict)
    every: float | None = CHECK_SECONDS
    domain: int | None = None
    interface: str | None = None


class LiveLidar(NamedTuple):
    """A LiDAR that records now: name, source, and (4, 4) pose in the frame of all.

    `clock` is how far its clock is ahead of that of this computer, s, where that is known.
    """

    name: str
    source: Source
    T_frame_lidar: Array
    clock: float | None = None


class Checked(NamedTuple):
    """Outcome of a check against the result: which LiDARs moved, and why, in words."""

    moved: tuple[str, ...]
    text: str


@dataclass(frozen=True)
class Pace:
    """How clouds kept up.

    Attributes
    ----------
    seconds
        In which they came.
    ages
        For each cloud, how long ago its oldest sweep was made when the cloud had been given, s.
    sweeps
        Of each LiDAR by its name, how many are in the clouds.
    """

    seconds: float
    ages: tuple[float, ...]
    sweeps: Mapping[str, int]

    @property
    def text(self) -> str:
        """In one line."""
        if not self.ages:
            return f"no cloud in {self.seconds:.0f} s"
        counts = ", ".join(f"{name} {count}" for name, count in self.sweeps.items())
        return (
            f"{len(self.ages) / self.seconds:.1f} clouds a second, oldest sweep "
            f"{median(self.ages):.2f} s ago (at most {max(self.ages):.2f}); sweeps of {counts}"
        )


class _Received(NamedTuple):
    """A sweep, and when it was made and came, by the clock of this computer, s."""

    frame: Frame
    made: float
    came: float


class _Reader(Thread):
    """Reads one LiDAR: its newest sweep, None once it is taken, and the last ones for a check."""

    def __init__(self, lidar: LiveLidar, arrival: Condition) -> None:
        super().__init__(daemon=True)
        self.lidar, self.clock, self.last_came = lidar, lidar.clock, -float("inf")
        self.newest: _Received | None = None
        self.recent: deque[Frame] = deque(maxlen=CHECK_SWEEPS)
        self.is_closed = False
        self._arrival, self._fault = arrival, ""
        self._apart: deque[float] = deque(maxlen=CLOCK_SWEEPS)

    def run(self) -> None:
        while not self.is_closed:
            try:
                frame = self.lidar.source.newest(0.2)
            except RetropoleError as error:
                self._fault = quoting(str(error))
                continue
            if frame is None:
                # A source that has ended gives nothing at once.
                time.sleep(0.01)
                continue
            came = time.time()
            with self._arrival:
                self.newest = _Received(frame, self._made(frame, came), came)
                self.last_came, self._fault = came, ""
                self.recent.append(frame)
                self._arrival.notify()

    def _made(self, frame: Frame, came: float) -> float:
        """Give the time of a sweep by this computer's clock, not by that of the LiDAR."""
        stamp = frame.stamp if frame.clock is None else frame.clock
        if stamp is None:
            return came
        self._apart.append(stamp - came)
        if self.lidar.clock is None:
            offset = median(self._apart)
            self.clock = 0.0 if abs(offset) < SAME_CLOCK else offset
        # None came before it was made.
        return min(stamp - (self.clock or 0.0), came)

    @property
    def does_record(self) -> bool:
        """Whether it records."""
        return time.time() - self.last_came < STOPPED

    @property
    def text(self) -> str:
        """State why nothing arrives, or what is odd about its clock; empty if nothing is."""
        if not self.does_record:
            why = self._fault or self.lidar.source.waits_for
            return f"left out, since no sweep arrives{': ' + why if why else ''}"
        if self.lidar.clock is None and self.clock:
            way = "ahead of" if self.clock > 0 else "behind"
            return (
                f"its clock is {abs(self.clock):.1f} s {way} that of this computer, judged by "
                "the arrival of its sweeps; sweeps are joined without this offset, the times of "
                "points are as sent"
            )
        return ""


class LiveMerge:
    """Clouds of LiDARs that record now: `step` it again and again, then `close` it.

    Parameters
    ----------
    lidars
        Each with a separate source.
    give
        Called with each cloud, and when its newest sweep was made, Unix seconds.
    crop
        (2, 3) corners of a box in the frame of all; what is outside is left out.
    check
        Given some sweeps of each LiDAR that records, says which moved. It is called in a separate
        process, so that no cloud waits for it, and is pickled for that. None checks nothing.
    every
        How often it is called, s.

    Attributes
    ----------
    moved
        LiDARs that are left out since they moved.
    """

    def __init__(
        self,
        lidars: Sequence[LiveLidar],
        give: Callable[[Points, float], None],
        *,
        crop: Array | None = None,
        check: Callable[[Mapping[str, Sequence[Frame]]], Checked] | None = None,
        every: float = CHECK_SECONDS,
    ) -> None:
        self.moved: tuple[str, ...] = ()
        self._give, self._crop, self._check, self._every = give, crop, check, every
        self._arrival = Condition()
        self._readers = [_Reader(lidar, self._arrival) for lidar in lidars]
        # Ctrl-C is of the process that ends in order.
        ignoring = signal.signal, (signal.SIGINT, signal.SIG_IGN)
        self._pool = get_context("spawn").Pool(1, *ignoring) if check else None
        self._work: AsyncResult[Checked] | None = None
        self._start = self._since = time.time()
        self._due = self._start + min(every, FIRST_CHECK)
        self._about: dict[str, str] = {}
        self._messages: list[str] = []
        self._ages: list[float] = []
        self._sweeps = {lidar.name: 0 for lidar in lidars}
        for reader in self._readers:
            reader.start()

    @property
    def has_ended(self) -> bool:
        """Whether nothing will come any more."""
        return all(own.lidar.source.has_ended and own.newest is None for own in self._readers)

    def step(self, wait: float = 0.5) -> bool:
        """Give a cloud if there is one within this many seconds; says whether."""
        until = time.time() + wait
        with self._arrival:
            while not (ready := self._ready()) and (left := until - time.time()) > 0:
                self._arrival.wait(min(left, 0.02))
        self._look_after()
        newest = max((sweep.made for _, sweep in ready), default=0.0)
        # One that had to wait for others is of another turn.
        joined = [(k, sweep) for k, sweep in ready if newest - sweep.made <= LATE]
        if not joined:
            return False
        poses = [own.lidar.T_frame_lidar for own in self._readers]
        points = joined_points([fused(each.frame.cloud, poses[k], k) for k, each in joined])
        if self._crop is not None:
            points = points[inside(points["xyz"], self._crop)]
        self._give(points, newest)
        self._ages.append(time.time() - min(sweep.made for _, sweep in joined))
        for k, _ in joined:
            self._sweeps[self._readers[k].lidar.name] += 1
        return True

    def _ready(self) -> list[tuple[int, _Received]]:
        """Read the sweeps of a cloud, each with the index of its LiDAR; none if it is too early."""
        used = [own for own in self._readers if own.lidar.name not in self.moved]
        waiting = [own.newest for own in used if own.newest is not None]
        is_late = any(own.newest is None and own.does_record for own in used)
        if not waiting or (is_late and time.time() - min(s.came for s in waiting) < LATE):
            return []
        taken = [(k, own.newest) for k, own in enumerate(self._readers)]
        for own in self._readers:
            own.newest = None
        return [(k, s) for k, s in taken if s is not None and self._readers[k] in used]

    def _look_after(self) -> None:
        """Note who stops, who comes again, and who moved."""
        now = time.time()
        for own in self._readers if now - self._start > 2 * STOPPED else ():
            name, text = own.lidar.name, own.text
            # Without the numbers in it, which change all the time.
            about = "".join(c for c in text if not c.isdigit())
            if about != self._about.get(name, ""):
                self._messages.append(f"{name}: {text or 'its sweeps come'}")
                self._about[name] = about
        if self._pool is None or self._check is None:
            return
        if self._work is None:
            recent = {own.lidar.name: list(own.recent) for own in self._readers if own.does_record}
            is_whole = all(len(frames) == CHECK_SWEEPS for frames in recent.values())
            if now >= self._due and len(recent) > 1 and is_whole:
                self._work = self._pool.apply_async(self._check, (recent,))
                self._due = now
        elif self._work.ready() or now - self._due > LONGEST_CHECK:
            try:
                self.moved, text = self._work.get(0.0)
            except (RetropoleError, OSError, TimeoutError) as error:
                text = f"the check failed: {quoting(str(error)) or 'it did not finish'}"
            self._work, self._due = None, now + self._every
            if text != self._about.get("", ""):
                self._messages.append(text)
                self._about[""] = text

    def new_messages(self) -> list[str]:
        """Give the new messages since the last call; each once for as long as it applies."""
        messages, self._messages = self._messages, []
        return messages

    def pace(self) -> Pace:
        """Report the rate of clouds since the last call."""
        now = time.time()
        found = Pace(now - self._since, tuple(self._ages), dict(self._sweeps))
        self._since, self._ages = now, []
        self._sweeps = dict.fromkeys(self._sweeps, 0)
        return found

    def close(self) -> None:
        """Close sources, threads and processes."""
        for own in self._readers:
            own.is_closed = True
        for own in self._readers:
            own.join(1.0)
            own.lidar.source.close()
        if self._pool is not None:
            self._pool.terminate()


@contextmanager
def merging_live(
    result: str | Path, sources: Mapping[str, str], wish: LiveWish = LiveWish()
) -> Iterator[LiveMerge]:
    """Open LiDARs of a result that record now, to merge their sweeps as they come.

    Parameters
    ----------
    result
        ``result.json``, ``site-result.json``, or its folder.
    sources
        By the names of its LiDARs (of a pair ``target`` and ``source``), as `source_of` takes them.
    wish
        How clouds are made, and where they go.

    Yields
    ------
    LiveMerge
        To be stepped; it is closed at the end, and the file is then whole.

    Raises
    ------
    Refusal
        If the result was refused: it has no poses.
    ReadError, UsageError, MissingExtraError, OSError
        Where something cannot be opened, or options do not go together.
    """
    file, document = with_poses(result)
    site = as_site(document)
    names = [lidar.name for lidar in site.lidars]
    for name in {**sources, **wish.clocks}:
        if name not in names:
            raise UsageError(f"no LiDAR is called {name!r}; there are {', '.join(names)}")
    if wish.out is not None and wish.out.suffix.lower() != ".mcap":
        raise UsageError(f"{wish.out}: clouds of live LiDARs are written as .mcap")
    at = placed(document, file, wish.frame)
    if at.finish is not None:
        raise UsageError(
            "map coordinates are too large for the float32 values of a topic: use site"
        )
    poses = dict(zip(names, at.poses, strict=True))
    used = [name for name in names if name in sources]
    origins = np.array([poses[name][:3, 3] for name in used])
    about = About(
        names=used,
        frame=at.name,
        comments=warnings_of(document),
        has_intensity=True,
        has_ring=True,
        has_time=True,
        is_large=False,
        middle=origins.mean(axis=0) if used else np.zeros(3),
        is_unix=False,
    )
    with ExitStack() as stack, threadpool_limits(1, user_api="blas"):
        to: list[Callable[[NDArray[Any], float], None]] = []
        frame = frame_id_of(site, at.name)
        if wish.topic is not None:
            own = cloud_publisher(wish.topic, frame, domain=wish.domain, interface=wish.interface)
            to.append(own)
        if wish.out is not None:
            device = stack.enter_context(stream_atomically(wish.out))
            notes = {f"note {k}": line for k, line in enumerate(comments_of(about))}
            topic = wish.topic or MERGED
            write = stack.enter_context(cloud_stream(device, {topic: frame}, notes))
            to.append(lambda points, when: write(topic, round(when * NANOSECONDS), points))

        def give(points: Points, when: float) -> None:
            if wish.surfels is not None:
                found = surfels_of(moments_of([points], wish.surfels), origins)
                records = records_of(surfel_columns(found))
            else:
                thin = points if wish.voxel is None else voxels([points], wish.voxel)
                records = records_of(columns_of(thin, about))
            for each in to:
                each(records, when)

        texts = [sources[name] for name in used]
        opened = open_sources(
            texts,
            domain=wish.domain,
            interface=wish.interface,
            wanted=[USUAL] * len(texts),
        )
        lidars = [
            LiveLidar(name, source, poses[name], wish.clocks.get(name))
            for name, source in zip(used, opened, strict=True)
        ]
        check = None if wish.every is None or len(used) < 2 else partial(check_live, file)
        made = LiveMerge(lidars, give, crop=wish.crop, check=check, every=wish.every or 0.0)
        stack.callback(made.close)
        yield made


def frame_id_of(site: SiteDoc, frame: str) -> str:
    """Name a frame as ROS does: that of a LiDAR as its recordings name it, if they do."""
    lidar = next((k for k, each in enumerate(site.lidars) if each.name == frame), None)
    own = [each.frame_id for each in site.inputs if each.lidar == lidar and each.frame_id]
    return own[0] if own else re.sub(r"\W", "_", frame)


def check_live(result: Path, frames: Mapping[str, Sequence[Frame]]) -> Checked:
    """Check sweeps of LiDARs against the result that they are merged by.

    Parameters
    ----------
    result
        ``result.json``, ``site-result.json``, or its folder.
    frames
        Of some of its LiDARs, by their names, metres.

    Returns
    -------
    Checked
        Of a pair that moved, that is the source: the frame is the target's. Of a site where nobody
        can show which moved, these are all of the pairs that did.
    """
    file, document = with_poses(result)
    topic, moved = "/points", tuple[str, ...]()
    with TemporaryDirectory() as folder:
        paths = {name: Path(folder) / f"{k}.mcap" for k, name in enumerate(frames)}
        for name, path in paths.items():
            path.write_bytes(write_recording({topic: Track(name, frames[name])}))
        try:
            if not isinstance(document, SiteDoc):
                target, source = (paths[name] for name in LIDARS)
                pair = check_recordings(
                    read_stored(file),
                    target,
                    source,
                    target_topic=topic,
                    source_topic=topic,
                    unit="m",
                )
                moved = (LIDARS[1],) if pair.status == "moved" else ()
                status, reasons = pair.status, pair.reasons
            else:
                sensors = {lidar.name: lidar.sensor for lidar in document.lidars}
                tables = [
                    f"[[lidar]]\nname = {json.dumps(name)}\nsensor = {json.dumps(sensors[name])}\n"
                    f"topic = {json.dumps(topic)}\nrecordings = [{json.dumps(path.name)}]\n"
                    for name, path in paths.items()
                ]
                place = Path(folder) / "site.toml"
                place.write_text(
                    'name = "live"\nplacements = ["1"]\n' + "\n".join(tables), encoding="utf-8"
                )
                site = check_site(file, place)
                pairs = {each[:2] for each in site.pairs if each.answer.status == "moved"}
                moved = site.moved or tuple(name for name in paths if any(name in p for p in pairs))
                status = site.status
                reasons = (*site.reasons, *(r for each in site.pairs for r in each.answer.reasons))
        except Refusal as refusal:
            moved, status, reasons = (), "cannot_tell", (refusal.reason,)
    why = f": {reasons[0].message}" if reasons and status != "same" else ""
    stated = {
        "same": "checked: no LiDAR has moved",
        "moved": f"checked: {', '.join(moved)} moved and is left out{why}",
        "cannot_tell": f"checked: it cannot be determined whether a LiDAR has moved{why}",
    }
    return Checked(moved, stated[status])
