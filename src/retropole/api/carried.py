"""Two recordings of a walk with one pole: read sweep by sweep, and calibrated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from msgspec import structs
from threadpoolctl import threadpool_limits

from ..base.datatypes import Placement, PointCloud
from ..base.errors import Refusal, UsageError
from ..base.quantities import step_of
from ..base.timing import timed
from ..carried.statement import state_walk
from ..carried.track import Track, find_track
from ..carried.walk import calibrate_tracks
from ..io.fields import in_metres
from ..io.recordings import Frame, chosen_frames, is_unix
from ..io.timed import timed_frames
from ..result import ResultDoc, RunConfig, result_document
from ..verdict.fitness import judge
from ..verdict.statement import state_refusal
from .inputs import (
    CloudSource,
    Input,
    InputPair,
    Listener,
    input_documents,
    read_placements,
    refuse_repeated,
    warn_repeated,
)


class SeenWalk(NamedTuple):
    """What two LiDARs saw of the pole.

    ``ahead`` is by how much each one's clock is ahead of the recorder's, s; None is not known.
    """

    tracks: tuple[Track, Track]
    ahead: tuple[float | None, float | None]

    @property
    def between(self) -> float | None:
        """By how much the source's clock is ahead of the target's, as the recorders say, s."""
        target, source = self.ahead
        return None if target is None or source is None else source - target


def calibrate_walk(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener,
    walk: Callable[[], SeenWalk] | None = None,
) -> tuple[ResultDoc, tuple[Placement, ...]]:
    """Find pose and clock offset of two LiDARs before which one pole is carried.

    Parameters
    ----------
    target, source
        Recordings of several sweeps: paths, or clouds with ``frame`` and ``time``.
    config, listener
        As of `calibration.calibrate_with`.
    walk
        Gives what is known of the pole in these recordings; None searches them.

    Returns
    -------
    ResultDoc, tuple of Placement
        The document, and what both LiDARs recorded, without what moved.

    Raises
    ------
    UsageError
        If there is more than one placement, or a cloud is one sweep.
    ReadError, MissingExtraError
        As `inputs.read_input`.
    """
    seconds: dict[str, float] = {}
    step = partial(timed, seconds, listener.progress)
    with step("read"):
        pairs = read_placements(target, source, config, listener)
        documents = input_documents(pairs[0])
    if len(pairs) > 1:
        raise UsageError("a walk is one recording of each LiDAR: give one target and one source")
    (pair,), radius = pairs, config.radius_m
    with threadpool_limits(1, user_api="blas"):
        with step("extract"):
            scans = [given.search(radius, for_poles=False) for given in pair]
            placement = Placement(scans[0], scans[1])
        try:
            twice = refuse_repeated(pair, documents, partial(warn_repeated, pair))
            if twice is not None:
                raise twice
            with step("extract"):
                seen = _search(pair, radius, listener) if walk is None else walk()
            documents = [
                structs.replace(each, threshold=track.threshold)
                for each, track in zip(documents, seen.tracks, strict=True)
            ]
            with step("adjust"):
                sensors = pair.target.sensor, pair.source.sensor
                found = calibrate_tracks(seen.tracks, sensors, radius, seen.between)
            with step("refine"):
                stated = state_walk(found, placement, seconds, scene=config.refine)
            calibration = judge(stated, config.need)
        except Refusal as refusal:
            calibration = state_refusal(refusal, (placement,), (), seconds)
    document = result_document(calibration, inputs=documents, config=config, seconds=seconds)
    return document, calibration.placements


def _search(pair: InputPair, radius: float, listener: Listener) -> SeenWalk:
    (target, first), (source, second) = (_track(each, radius, listener) for each in pair)
    return SeenWalk((target, source), (first, second))


def _track(given: Input, radius: float, listener: Listener) -> tuple[Track, float | None]:
    """Find the carried pole, and by how much the LiDAR's clock is ahead of the recorder's, s."""
    ahead: list[float] = []
    sweeps = _sweeps_of(given, listener, ahead)
    track = find_track(sweeps, given.sensor, threshold=given.threshold, radius=radius)
    return track, median_of(ahead)


def ahead_of_recorder(frame: Frame) -> list[float]:
    """By how much the clock of a timed sweep is ahead of its recorder's, s; empty if not known."""
    assert frame.cloud.time is not None
    if frame.stamp is None or not is_unix(frame.stamp):
        return []
    return [float(frame.cloud.time.min()) - frame.stamp]


def median_of(ahead: Sequence[float]) -> float | None:
    """Take the median over all sweeps; None of none."""
    return float(np.median(ahead)) if ahead else None


def _sweeps_of(given: Input, listener: Listener, ahead: list[float]) -> Iterator[PointCloud]:
    """Give sweep by sweep, and note by how much each one's clock is ahead of the recorder's."""
    if given.read is None:
        if given.cloud.frame is None:
            raise UsageError("a walk has many sweeps: give a recording, or a cloud with its frames")
        for k in np.unique(given.cloud.frame):
            yield given.cloud.select(given.cloud.frame == k)
        return
    recording = given.read.recording
    numbers = chosen_frames(recording, given.how.frames or slice(None))
    name = f"search {recording.path.name}: sweep"
    for k, frame in enumerate(timed_frames(recording, numbers), 1):
        listener.progress(step_of(name, k, len(numbers)))
        ahead += ahead_of_recorder(frame)
        yield in_metres(frame.cloud, given.how.unit)
