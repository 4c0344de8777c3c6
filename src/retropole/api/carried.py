"""Recordings of a walk with one pole: read sweep by sweep, and calibrated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from msgspec import structs
from threadpoolctl import threadpool_limits

from ..adjustment.answer import SiteCalibration
from ..base.datatypes import Array, Placement, PointCloud
from ..base.errors import Refusal, UsageError, refusing_of
from ..base.quantities import step_of
from ..base.timing import timed
from ..carried.site import from_reference, state_walk_of_site
from ..carried.statement import state_walk
from ..carried.track import Track, find_track
from ..carried.walk import solve_tracks, taken
from ..hypotheses.scans import find_scans
from ..io.fields import in_metres
from ..io.recordings import Frame, chosen_frames, is_unix
from ..io.timed import timed_frames
from ..result import ResultDoc, RunConfig, result_document
from ..result.site import RecordingDoc
from ..verdict.fitness import judge
from ..verdict.statement import state_refusal, state_site_refusal
from .inputs import (
    CloudSource,
    Input,
    Listener,
    input_documents,
    read_placements,
    refuse_repeated,
    warn_repeated,
)
from .site_inputs import SiteInputs


class SeenWalk(NamedTuple):
    """What LiDARs saw of the pole, the target first.

    ``ahead`` is by how much each one's clock is ahead of the recorder's, s; None is not known.
    """

    tracks: tuple[Track, ...]
    ahead: tuple[float | None, ...]

    @property
    def between(self) -> Array | None:
        """(L,) by how much each clock is ahead of the target's, as the recorders say, s."""
        known = [each for each in self.ahead if each is not None]
        return np.array(known) - known[0] if len(known) == len(self.ahead) else None


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
        The document, and the recordings of both LiDARs without moving objects.

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
                found = taken(solve_tracks(seen.tracks, sensors, radius, seen.between))
            with step("refine"):
                stated = state_walk(found, placement, seconds, scene=config.refine)
            calibration = judge(stated, config.need)
        except Refusal as refusal:
            calibration = state_refusal(refusal, (placement,), (), seconds)
    document = result_document(calibration, inputs=documents, config=config, seconds=seconds)
    return document, calibration.placements


def calibrate_site_walk(
    read: SiteInputs, documents: Sequence[RecordingDoc], listener: Listener
) -> tuple[SiteCalibration, list[RecordingDoc]]:
    """Find poses and clocks of all LiDARs of a site before which one pole is carried.

    Parameters
    ----------
    read, documents
        The site, one recording of each LiDAR, and their entries in the result document.
    listener
        As of `calibration.calibrate_site`.

    Returns
    -------
    SiteCalibration, list of RecordingDoc
        The answer, or why there is none; and the entries with the thresholds that were used.

    Raises
    ------
    UsageError
        If a cloud is one sweep.
    """
    site, seconds, stated = read.site, dict[str, float](), list(documents)
    step = partial(timed, seconds, listener.progress)
    order = from_reference(site)
    names, given = [site.lidars[k].name for k in order], [read.inputs[k, 0] for k in order]
    with threadpool_limits(1, user_api="blas"):
        with step("extract"):
            scans = find_scans(site)
        try:
            for (lidar, _), fault in scans.faults:
                with refusing_of(site.lidars[lidar].name):
                    raise fault
            with step("extract"):
                seen = _search(given, site.radius, listener, names)
            thresholds = dict(zip(order, (each.threshold for each in seen.tracks), strict=True))
            stated = [structs.replace(each, threshold=thresholds[each.lidar]) for each in stated]
            with step("adjust"):
                sensors = [each.sensor for each in given]
                solved = solve_tracks(seen.tracks, sensors, site.radius, seen.between, names)
            with step("confirm"):
                answer = state_walk_of_site(site, scans, solved, seconds)
        except Refusal as refusal:
            answer = state_site_refusal(site, scans, (), (), refusal, (), seconds)
    return answer, stated


def _search(
    given: Iterable[Input], radius: float, listener: Listener, names: Sequence[str] = ("", "")
) -> SeenWalk:
    found = []
    for each, name in zip(given, names, strict=True):
        with refusing_of(name):
            found.append(_track(each, radius, listener))
    tracks, ahead = zip(*found, strict=True)
    return SeenWalk(tracks, ahead)


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
    """The median over all sweeps; None without any."""
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
