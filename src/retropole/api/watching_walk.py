"""`watch --carried`: one pole is carried in view of two LiDARs, and the walk is solved as it grows.

Each sweep is searched once, and written as it arrives. Every few seconds the data received are
solved in the background. Once that is good enough, the recording is closed and calibrated with the
poles already found in its sweeps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as with_fields
from threadpoolctl import threadpool_limits

from ..base import se3
from ..base.datatypes import Array, Placement
from ..base.errors import Refusal, quoting
from ..base.files import stream_atomically
from ..base.quantities import error
from ..base.uncertainty import floor, predicted_error
from ..base.uncertainty.purpose import USABLE, displacement_bound
from ..carried.adjustment import Adjusted, in_recordings, steps_in_recordings
from ..carried.guidance import Continuation, next_steps
from ..carried.statement import axes_in_target, state_walk
from ..carried.track import Found, Search
from ..carried.verdict import AT, MAX_ERROR
from ..carried.walk import solve_tracks, taken
from ..export.recording import TOPICS, cloud_stream, records_of_sweep
from ..io import sha256_of
from ..io.fields import NANOSECONDS
from ..io.live import Source
from ..io.recordings import MAX_RECORDING_POINTS, Frame, Recording, joined
from ..io.timed import LOOKED_AT, Timing
from ..planning.live_advice import Advice, Outcome, advice_after, advise, outcome_of, remedy_of
from ..planning.live_poles import Looked, Watched, receive
from ..report.plan import turning
from ..result import RunConfig, result_document
from ..result.watching import ChartNow, Phase, PoleNow, WalkNow, WatchDoc
from ..verdict.fitness import judge
from .calibration import calibrate_with
from .carried import SeenWalk, ahead_of_recorder, median_of
from .inputs import SILENT, Input, input_documents
from .watching import WORKING_OUT, Watch, Wish, in_background

RECORDING = "walk{}.mcap"
"""Name of the recording of a walk, numbered from 1."""

EVERY = 2.0
"""Minimum seconds from one solution to the next; that of a walk of 40 s takes 1 s."""

UNSEEN = 2.0
"""Seconds for which a LiDAR has not seen the pole before it is reported."""

MOST_POINTS = 150
"""Of a path that is shown."""

AGAIN = "Walk again, for longer."

NO_WAY = Advice(
    "walking", "Walk to and fro and across, and lean the pole to all sides.", is_good=True
)


class Walked:
    """The data of one LiDAR of a walk: its sweeps until now with times, searched once each.

    Parameters
    ----------
    lidar
        Who records it.
    radius
        Of the pole, metres.
    """

    def __init__(self, lidar: Watched, radius: float) -> None:
        self._lidar, sensor = lidar, lidar.view.sensor
        self.last: tuple[float, Found] | None = None
        self._first: list[Frame] = []
        self._timing: Timing | None = None
        self._scene: list[Frame] = []
        self._every, self._count = 1, 0
        self.ahead: list[float] = []
        self.search = Search(sensor, threshold=lidar.threshold, radius=radius)

    def timed(self, frame: Frame) -> list[Frame]:
        """Give sweeps with times: none at first, until some show how times are stored.

        Raises
        ------
        Refusal
            ``no_times``.
        """
        if self._timing is not None:
            return [self._timing.timed(frame)]
        self._first.append(frame)
        if len(self._first) < LOOKED_AT:
            return []
        self._timing, first = Timing(self._first, self._lidar.view.name), self._first
        self._first = []
        return [self._timing.timed(each) for each in first]

    def add(self, frame: Frame, now: float) -> None:
        """Search a timed sweep; some, evenly spaced, represent the surroundings."""
        found = self.search.add(frame.cloud)
        if found:
            self.last = now, max(found, key=lambda each: len(each.xyz))
        self.ahead += ahead_of_recorder(frame)
        if self._count % self._every == 0:
            self._scene.append(frame)
        self._count += 1
        if sum(len(each.cloud) for each in self._scene) > MAX_RECORDING_POINTS:
            self._scene, self._every = self._scene[::2], 2 * self._every

    def surroundings(self) -> Input:
        """Join the sweeps that represent the surroundings."""
        lidar = self._lidar
        whole = Recording(Path(lidar.view.name), len(self._scene), lambda numbers: iter(()))
        cloud = joined(whole, self._scene)
        return Input(cloud, cloud, lidar.view.sensor, lidar.threshold)


class Solution(NamedTuple):
    """The walk until now: why it gives no answer, or the answer with the surroundings, and how to
    continue.

    At the range of the need, ``sigma`` is 1 σ and ``bound`` the error bound of all points, with
    95 % probability, metres; infinite without a pose.
    """

    refusal: Refusal | None
    outcome: Outcome | None
    steps: list[Continuation]
    charts: list[ChartNow]
    seconds: float
    sigma: float
    bound: float


def solve(
    seen: SeenWalk, surroundings: Sequence[Input], config: RunConfig, names: tuple[str, str]
) -> Solution:
    """Solve a walk, refine it by the surroundings if it gives an answer, and advise how to
    continue.

    Parameters
    ----------
    seen
        Observations of the pole by both LiDARs.
    surroundings
        Some of their sweeps.
    config, names
        The options of the run; names of target and source in messages.
    """
    sensors = surroundings[0].sensor, surroundings[1].sensor
    at = (config.need or USABLE).at
    try:
        solved = solve_tracks(seen.tracks, sensors, config.radius_m, seen.between)
    except Refusal as none:
        return Solution(none, None, [], _each_alone(seen, names), 0.0, np.inf, np.inf)
    best = min(solved.solutions, key=lambda each: each.cost)
    offset = best.offset + solved.ahead[1]
    target, source = (track.times for track in seen.tracks)
    period = float(np.median(np.diff(target)))
    after = np.clip(np.searchsorted(source - offset, target), 1, len(source) - 1)
    near = np.abs(np.stack([source[after - 1], source[after]]) - offset - target).min(axis=0)
    seconds = period * float(np.count_nonzero(near < period))
    alone = best.covariance[:6, :6] + floor()
    is_placed = predicted_error(alone, (AT,))[0].sigma_m <= MAX_ERROR
    charts = [_both(best, seen, names)] if is_placed else _each_alone(seen, names)
    bound, information = displacement_bound(alone, at), None
    refusal: Refusal | None = None
    outcome: Outcome | None = None
    try:
        found = taken(solved)
        scans = [each.search(config.radius_m, for_poles=False) for each in surroundings]
        stated = state_walk(found, Placement(scans[0], scans[1]), {}, scene=config.refine)
        answer = judge(stated, config.need)
        inputs = input_documents(surroundings)
        document = result_document(answer, inputs=inputs, config=config, seconds={})
        outcome = outcome_of(document, config.need)
        if stated.covariance is not None:
            frames = (track.T_recording_beams for track in seen.tracks)
            J = steps_in_recordings(best, *frames)
            information = J.T @ _more(stated.covariance, found.covariance) @ J
        bound = outcome.bound or bound
    except Refusal as caught:
        refusal = caught
    sigma, steps = next_steps(best, sensors, names[0], at, information)
    return Solution(refusal, outcome, steps, charts, seconds, sigma, bound)


def _more(after: Array, before: Array) -> Array:
    """Additional information of one covariance over another: the difference of their inverses."""
    values, vectors = np.linalg.eigh(np.linalg.inv(after) - np.linalg.inv(before))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _each_alone(seen: SeenWalk, names: tuple[str, str]) -> list[ChartNow]:
    """Draw the view of each LiDAR in a separate frame."""
    charts = []
    for track, name in zip(seen.tracks, names, strict=True):
        up = track.directions.mean(axis=0)
        R = turning(track.T_recording_beams[:3, :3] @ (up * (np.sign(up[2]) or 1.0)))
        points = se3.apply(track.T_recording_beams, track.points) @ R.T
        charts.append(ChartNow(names=[name], lidars=[(0.0, 0.0)], paths=[_path(points)]))
    return charts


def _both(best: Adjusted, seen: SeenWalk, names: tuple[str, str]) -> ChartNow:
    """Draw the view of both in the frame of the target."""
    target, source = (track.T_recording_beams for track in seen.tracks)
    found = in_recordings(best, target, source)
    T = found.T_target_source
    up = axes_in_target(found)[1].mean(axis=0)
    R = turning(up * (np.sign(up[2] + T[:3, 2] @ up) or 1.0))
    paths = [
        _path(se3.apply(to @ track.T_recording_beams, track.points) @ R.T)
        for to, track in zip((np.eye(4), T), seen.tracks, strict=True)
    ]
    x, y, _ = (R @ T[:3, 3]).tolist()
    return ChartNow(names=list(names), lidars=[(0.0, 0.0), (x, y)], paths=paths)


def _path(points: Array) -> list[tuple[float, float]]:
    some = points[:: 1 + len(points) // MOST_POINTS, :2]
    return [(round(x, 2), round(y, 2)) for x, y in some.tolist()]


class WalkWatch(Watch):
    """A watch of two LiDARs in view of which one pole is carried; it is used as `Watch`."""

    def __init__(
        self,
        sources: Sequence[Source],
        wish: Wish,
        out: Path,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(sources, wish, out, clock)
        self._stream = ExitStack()
        self._begin()

    def _begin(self) -> None:
        """Begin a walk."""
        radius = self._wish.config.radius_m
        self._write: Callable[[int, Frame], None] | None = None
        self._path: Path | None = None
        self._walked = [Walked(own, radius) for own in self._lidars]
        self._solving: Future[Solution] | None = None
        self._solution: Solution | None = None
        self._expected = None
        self._solved_at, self._bounds = self._clock(), list[tuple[float, float]]()

    def finish(self) -> list[Path]:
        """Keep the recording of the walk, and close the sources."""
        for lidar in self._lidars:
            lidar.source.close()
        self._keep_walk()
        return self.written

    def _take(self, k: int) -> None:
        """Read the newest sweep of a LiDAR; write and search it once both LiDARs record."""
        lidar = self._lidars[k]
        frame, said, is_other = receive(lidar, self._clock)
        for message in said:
            self._note(f"{self._wish.names[k]}: {message}")
        now = self._clock()
        if is_other:
            self._stop("its sweeps come from another sender")
        if frame is None:
            return
        fault = ""
        is_ready = all(each.frame_id is not None for each in self._lidars)
        if is_ready and self._work is None and not self._is_to_wait(now):
            try:
                for each in self._walked[k].timed(frame):
                    self._record_sweep(k, each)
                    self._walked[k].add(each, now)
            except Refusal as refusal:
                fault = str(refusal)
            except OSError as error:
                why = quoting(f"{error.filename or self._out}: {error.strerror or error}")
                message = (
                    f"{why}. Free disk space: the data of this walk are lost, and it starts again "
                    "afterwards."
                )
                self._stop(message)
                self._no_room = Advice("not_written", message), now + 5.0
        looked = Looked(now, frame.cloud)
        lidar.view = replace(lidar.view, looked=looked, silent="", fault=fault)

    def _record_sweep(self, k: int, frame: Frame) -> None:
        """Write a sweep to the recording, and begin that with the first one."""
        topics = list(TOPICS.values())
        if self._write is None:
            number = 1
            while (path := self._out / RECORDING.format(number)).exists():
                number += 1
            device = self._stream.enter_context(stream_atomically(path))
            names = [own.frame_id or own.view.name for own in self._lidars]
            write = cloud_stream(device, dict(zip(topics, names, strict=True)), {})
            record, counts = self._stream.enter_context(write), [0, 0]

            def put(lidar: int, one: Frame) -> None:
                # For sweeps without a time: the usual rate of LiDARs.
                when = 0.1 * counts[lidar] if one.stamp is None else one.stamp
                counts[lidar] += 1
                record(topics[lidar], round(when * NANOSECONDS), records_of_sweep(one.cloud))

            self._write, self._path, self._no_room = put, path, None
        self._write(k, frame)

    def _keep_walk(self) -> Path | None:
        """Close the recording of the walk, and give its path; None if there is none."""
        path, self._path, self._write = self._path, None, None
        self._stream.close()
        if path is not None:
            self.written.append(path)
            self._recorded += 1
            self._note(f"walk {self._recorded} is kept: {path.name}")
        return path

    def _stop(self, why: str) -> None:
        """Leave out the data of this walk, and begin another."""
        self._note(f"the walk is left out: {why}")
        with suppress(OSError, Dropped), self._stream:
            raise Dropped
        self._begin()

    def _next(self, now: float) -> Advice:
        """Report the next action; solve the walk, and compute the answer once it is sufficient."""
        if self._outcome is not None and self._outcome.is_enough:
            return advice_after(self._outcome, AGAIN)
        if self._is_to_wait(now):
            assert self._no_room is not None
            return self._no_room[0]
        if self._work is not None:
            return WORKING_OUT
        ended = any(each.source.has_ended for each in self._lidars)
        if ended and self._path is None:
            self.is_over = True
            if self._outcome is not None:
                return advice_after(self._outcome, AGAIN)
            return Advice("ended", "The recordings have ended before anything was kept.")
        self._solve(now)
        if ended or (self._expected is not None and self._expected.is_enough):
            return self._answer()
        advice = self._guide(now)
        if advice.code == "clock_jumps":
            self._stop(advice.text)
        return advice

    def _solve(self, now: float) -> None:
        """Process the newest solution, and begin another."""
        if self._solving is not None and self._solving.done():
            self._solution, self._solving = self._solving.result(), None
            found = self._solution
            if np.isfinite(found.bound):
                self._bounds.append((found.seconds, found.bound))
            self._expected = found.outcome
        if self._solving is not None or now - self._solved_at < EVERY:
            return
        try:
            seen = self._seen_walk()
        except Refusal:
            return
        self._solved_at = now
        surroundings = [each.surroundings() for each in self._walked]
        config, names = self._wish.config, self._wish.names

        def work() -> Solution:
            with threadpool_limits(1, user_api="blas"):
                return solve(seen, surroundings, config, names)

        self._solving = in_background(work)

    def _seen_walk(self) -> SeenWalk:
        target, source = self._walked
        tracks = target.search.track(), source.search.track()
        return SeenWalk(tracks, (median_of(target.ahead), median_of(source.ahead)))

    def _answer(self) -> Advice:
        """Close the recording, and calibrate with it and the poles found in its sweeps."""
        try:
            path = self._keep_walk()
        except OSError as error:
            self._stop(f"{error.strerror}")
            return NO_WAY
        assert path is not None
        config, seen = self._of_recordings(), self._seen_walk
        self._used = {path: sha256_of(path)}
        self._work = in_background(lambda: calibrate_with(path, path, config, SILENT, seen))
        return WORKING_OUT

    def _collect(self) -> None:
        """Process the answer if it is ready; if it is not sufficient, another walk begins."""
        was = self._work
        super()._collect()
        if was is not None and self._work is None and not self.is_over:
            self._used = {}
            self._begin()

    def _guide(self, now: float) -> Advice:
        """Report obstacles first, then how to continue."""
        advice = advise([each.view for each in self._lidars], now, needs_poles=False)
        if not advice.is_good:
            return advice
        for own, name in zip(self._walked, self._wish.names, strict=True):
            if own.search.sweeps and (own.last is None or now - own.last[0] > UNSEEN):
                message = f"{name} sees no pole: carry it 3 to 8 m from {name}, in view of both."
                return Advice("unseen", message)
        solution = self._solution
        if solution is None:
            return NO_WAY
        refusal = solution.refusal
        if refusal is not None and refusal.code not in ("too_little_walk", "several_walks_fit"):
            return Advice(refusal.code, f"{refusal}. {remedy_of(refusal.code)}".strip())
        warned = ""
        if solution.outcome is not None:
            after = advice_after(solution.outcome, AGAIN)
            if after.code == "need_too_small":
                return after
            warned = "" if after.code == "need_not_met" else f" {after.text}"
        step, at = solution.steps[0], (self._wish.config.need or USABLE).at
        falls = f"{error(solution.sigma)} now, {error(step.sigma)} after 5 s of this"
        text = f"{step.text} 1 σ at {at:g} m: {falls}.{warned}"
        return Advice(step.code, text, is_good=True)

    def _document_of(self, advice: Advice, now: float) -> WatchDoc:
        said, found = super()._document_of(advice, now), self._solution
        lidars = [
            with_fields(each, poles=[_pole(own.last, now)] if own.last else [])
            for each, own in zip(said.lidars, self._walked, strict=True)
        ]
        if found is None:
            return with_fields(said, lidars=lidars)
        walk = WalkNow(
            seconds=found.seconds,
            charts=found.charts,
            at_m=(self._wish.config.need or USABLE).at,
            bounds=self._bounds,
        )
        return with_fields(said, lidars=lidars, walk=walk)

    def _phase(self) -> Phase:
        phase = super()._phase()
        return "walking" if phase == "placing" and self._path is not None else phase


class Dropped(Exception):
    """A recording is not to be kept."""


def _pole(last: tuple[float, Found], now: float) -> PoleNow:
    """The pole as a LiDAR saw it last."""
    at, found = last
    is_seen = now - at <= UNSEEN
    return PoleNow(
        name="carried",
        distance_m=float(np.linalg.norm(found.point)),
        returns=len(found.xyz),
        rings=len(np.unique(found.rings)) if found.rings[0] >= 0 else None,
        is_still=False,
        is_good=is_seen,
        word="" if is_seen else "lost",
    )
