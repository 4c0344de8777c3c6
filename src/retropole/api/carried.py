"""Two recordings of a walk with one pole: read sweep by sweep, and calibrated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from ..base.datatypes import Placement, PointCloud
from ..base.errors import Refusal, UsageError
from ..base.quantities import step_of
from ..base.timing import timed
from ..carried.statement import state_walk
from ..carried.track import Track, find_track
from ..carried.walk import calibrate_tracks
from ..io.fields import in_metres
from ..io.recordings import chosen_frames, is_unix
from ..io.timed import timed_frames
from ..result import ResultDoc, RunConfig, result_document
from ..verdict.fitness import judge
from ..verdict.statement import state_refusal
from .inputs import (
    CloudSource,
    Input,
    Listener,
    input_documents,
    read_placements,
    refuse_repeated,
    tell_repeated,
)


def calibrate_walk(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener,
) -> tuple[ResultDoc, tuple[Placement, ...]]:
    """Find pose and clock offset of two LiDARs before which one pole is carried.

    Parameters
    ----------
    target, source
        Recordings of several sweeps: paths, or clouds with ``frame`` and ``time``.
    config, listener
        As of `calibration.calibrate_with`.

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
            twice = refuse_repeated(pair, documents, partial(tell_repeated, pair))
            if twice is not None:
                raise twice
            with step("extract"):
                (of_target, first), (of_source, second) = (
                    _track(given, radius, listener) for given in pair
                )
            with step("adjust"):
                known = None if first is None or second is None else second - first
                sensors = pair.target.sensor, pair.source.sensor
                found = calibrate_tracks((of_target, of_source), sensors, radius, known)
            with step("refine"):
                stated = state_walk(found, placement, seconds, scene=config.refine)
            calibration = judge(stated, config.need)
        except Refusal as refusal:
            calibration = state_refusal(refusal, (placement,), (), seconds)
    document = result_document(calibration, inputs=documents, config=config, seconds=seconds)
    return document, calibration.placements


def _track(given: Input, radius: float, listener: Listener) -> tuple[Track, float | None]:
    """Find the carried pole, and by how much the LiDAR's clock is ahead of the recorder's, s."""
    ahead: list[float] = []
    sweeps = _sweeps_of(given, listener, ahead)
    track = find_track(sweeps, given.sensor, threshold=given.threshold, radius=radius)
    return track, float(np.median(ahead)) if ahead else None


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
        assert frame.cloud.time is not None
        if frame.stamp is not None and is_unix(frame.stamp):
            ahead.append(float(frame.cloud.time.min()) - frame.stamp)
        yield in_metres(frame.cloud, given.how.unit)
