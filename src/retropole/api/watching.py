"""`watch`: two live LiDARs, from the first sweep to an answer that is accurate enough."""

from __future__ import annotations

import hashlib
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from threading import Thread
from typing import TypeVar

import numpy as np
from msgspec.structs import replace as with_options

from ..base.errors import ReadError, RetropoleError, UsageError, quoting
from ..base.files import write_together
from ..base.quantities import counted
from ..base.sensors import sensor_or_auto
from ..base.uncertainty.purpose import USABLE
from ..export.documents import found_in_result
from ..export.recording import TOPICS, Published, Track, publish, write_recording
from ..export.recording import check_publishing as check_publishing
from ..export.transform import Transform, choose
from ..io import sha256_of
from ..io.live import Source as Source
from ..io.live import names_of as names_of
from ..io.live import open_sources as open_sources
from ..planning.comparison import against_plan
from ..planning.live_advice import (
    Advice,
    Outcome,
    advice_after,
    advise,
    another,
    keep_still,
    outcome_of,
)
from ..planning.live_poles import (
    SWEEPS,
    Capture,
    Tracked,
    View,
    Watched,
    angle_between,
    begun,
    is_new_placement,
    present,
    seen_now,
    take,
)
from ..report.field_test import render_field_test
from ..result import CERTIFICATE, RunConfig, encode, pole_documents
from ..result.pole_plan import PolePlanDoc
from ..result.watching import Phase, WatchDoc
from . import certification
from .calibration import calibrate_with
from .checking import CheckResult, Stored, check_recordings
from .result import CalibrationResult

RECORDING = "placement{}.mcap"
"""Name of the recording of a placement, numbered from 1."""

WORKING_OUT = Advice("calibrating", "Good: the answer is being computed.", True)

T = TypeVar("T")


@dataclass(frozen=True)
class Wish:
    """Options of a watch.

    Attributes
    ----------
    config
        As of a calibration: radius, sensors, thresholds, the need.
    names
        Names of target and source in messages.
    sweeps
        Number of sweeps of each LiDAR that are kept for a placement.
    plan
        Planned positions of the poles; with its names of the LiDARs as `names`.
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
            If the plan has no LiDARs with these names.
        """
        planned = None if self.plan is None else {each.name for each in self.plan.lidars}
        if planned is not None and not planned >= set(self.names):
            raise UsageError(
                f"the plan is for {', '.join(sorted(planned))}: use these names for both LiDARs, "
                f"not {' and '.join(self.names)}"
            )


class Watch:
    """A watch of two LiDARs: `step` it until it `is_over`, then `finish` it.

    Parameters
    ----------
    sources
        Of target and source.
    wish
        The options.
    out
        Folder for recordings, result, report and certificate.
    clock
        Monotonic seconds.

    Attributes
    ----------
    result, checked
        The answer; None before there is one.
    published
        The answer on ``/tf_static``, as long as it is published.
    written
        Files that were written.
    is_over
        Whether the answer is good enough, or no more data will arrive.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        wish: Wish,
        out: Path,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.result: CalibrationResult | None = None
        self.checked: CheckResult | None = None
        self.published: Published | None = None
        self.written: list[Path] = []
        self.is_over = False
        self._wish, self._out, self._clock, self._start = wish, out, clock, clock()
        read = wish.config.of_target, wish.config.of_source
        self._lidars = [
            Watched(source, View(name, sensor=sensor_or_auto(how.sensor)), how.threshold)
            for source, name, how in zip(sources, wish.names, read, strict=True)
        ]
        self._messages: deque[str] = deque(maxlen=40)
        self._capture: Capture | None = None
        self._kept: Capture | None = None
        # Placements that are complete, but could not be written yet.
        self._unwritten: Capture | None = None
        self._no_room: tuple[Advice, float] | None = None
        self._recorded = 0
        # Recordings, and the SHA-256 of the captured data.
        self._used: dict[Path, str] = {}
        self._trial: Future[CalibrationResult] | None = None
        self._work: Future[CalibrationResult | CheckResult] | None = None
        self._expected: Outcome | None = None
        self._outcome: Outcome | None = None

    def step(self) -> WatchDoc:
        """Process new data, and report what is seen and the next action."""
        for k in range(len(self._lidars)):
            self._take(k)
        now = self._clock()
        self._collect()
        return self._document_of(self._next(now), now)

    def finish(self) -> list[Path]:
        """Write remaining data, run the field test of the LiDARs if possible, close the sources.

        Returns
        -------
        list of Path
            All files that were written.
        """
        for lidar in self._lidars:
            lidar.source.close()
        left, self._unwritten, self._capture = self._unwritten or self._capture, None, None
        if left is not None and left.count:
            try:
                self._record(left)
            except OSError as error:
                lost = f"{error.strerror}; {counted(left.count, 'sweep')} of each LiDAR are lost"
                raise OSError(error.errno, lost, error.filename) from None
        if self.is_over and self._used and self._outcome is not None:
            used, config = list(self._used), self._of_recordings()
            with suppress(RetropoleError):
                test = _of_captured(self._used, lambda: certification.certify(used, used, config))
                if test.status != "refused":
                    document, page = (self._out / name for name in CERTIFICATE)
                    files = {document: encode(test), page: render_field_test(test).encode()}
                    write_together(files)
                    self.written += files
        return self.written

    def frames(self) -> tuple[str, str] | None:
        """Give the frames of the sweeps, for `publish`; None before both sent sweeps.

        Raises
        ------
        UsageError
            If no transform can refer to the sweeps: they have no frame_id, the same one,
            or an invalid name.
        """
        for own, name in zip(self._lidars, self._wish.names, strict=True):
            if own.frame_id == "":
                raise UsageError(
                    f"the sweeps of {name} have no frame_id, so no transform on /tf_static could "
                    "refer to them: watch without --publish, then use retropole export"
                )
        target, source = (each.frame_id for each in self._lidars)
        if target is None or source is None:
            return None
        if target == source:
            raise UsageError(
                f"the sweeps of both LiDARs name the frame {target!r}, so no transform "
                "on /tf_static could relate them: give each driver a different frame_id"
            )
        # As for publishing, so that an invalid name of a frame is found now.
        Transform(np.eye(4), target, source)
        return target, source

    def publish(self, *, domain: int | None = None, interface: str | None = None) -> None:
        """Publish the answer on ``/tf_static``, between the frames of the sweeps. The

        previous one is withdrawn. If the frames have changed so that it no longer
        applies, a note reports it.

        Raises
        ------
        UsageError, MissingExtraError
            As `export.recording.publish`.
        Refusal
            If the answer was refused.
        """
        self.withdraw()
        assert self.result is not None
        found = found_in_result(self.result.document)
        try:
            now = self.frames()
        except UsageError as error:
            self._note(f"not published: {error}")
            return
        if now is None or now != (found.parent, found.child):
            self._note(
                "not published: the sweeps have other frames now than during the calibration"
            )
            return
        self.published = publish([choose([found], *now)], domain=domain, interface=interface)
        self._note(f"published on /tf_static: {now[0]} to {now[1]}")

    def withdraw(self) -> None:
        """Withdraw the previous answer."""
        if self.published is not None:
            self.published.withdraw()
            self.published = None
            self._note(
                "withdrawn from /tf_static: the previous answer is no longer valid; programs "
                "that received it keep it until they are restarted"
            )

    def _take(self, k: int) -> None:
        """Read the newest sweep of a LiDAR; keep it while sweeps are kept."""
        radius, busy = self._wish.config.radius_m, self._work is not None
        received = take(self._lidars[k], radius, self._clock, busy=busy)
        for message in received.messages:
            self._note(f"{self._wish.names[k]}: {message}")
        if received.is_of_another_frame:
            self._capture = None
        elif received.frame is not None and self._capture is not None:
            self._capture = self._capture.with_frame(k, received.frame)

    def _next(self, now: float) -> Advice:
        """Report the next action; keep sweeps while all is good, and compute the answer."""
        again = another(len(self._used))
        if self.checked is not None:
            return Advice(
                self.checked.status, checked_words(self.checked), self.checked.status == "same"
            )
        if self._unwritten is not None:
            return self._keep(self._unwritten, now)
        if self._work is not None:
            return WORKING_OUT if self._no_room is None else self._no_room[0]
        if self._outcome is not None and self._outcome.is_enough:
            return advice_after(self._outcome, again)
        advice = self._seen(now)
        capture, ended = self._capture, any(each.source.has_ended for each in self._lidars)
        if ended:
            if capture is None or not capture.count:
                self.is_over = True
                if self._outcome is not None:
                    return advice_after(self._outcome, again)
                return Advice("ended", "The recordings have ended before anything was kept.")
        elif not advice.is_good:
            if capture is not None:
                self._note(f"not kept: {advice.text}")
            self._capture = None
            return advice
        elif capture is None:
            kept, outcome = self._kept, self._outcome
            if kept and outcome and not is_new_placement(kept, self._tracks, now):
                return advice_after(outcome, again)
            self._capture = capture = begun(self._tracks, now)
        assert capture is not None
        if self._trial is None and capture.count and self._wish.stored is None:
            first, second = (own[0].cloud for own in capture.frames)
            self._trial = in_background(lambda: calibrate_with(first, second, self._wish.config))
        if ended or capture.is_full(self._wish.sweeps, now):
            return self._keep(capture, now)
        left = capture.seconds - (now - capture.start)
        return keep_still(capture.count, self._wish.sweeps, left)

    @property
    def _tracks(self) -> list[tuple[Tracked, ...]]:
        return [each.view.tracks for each in self._lidars]

    def _seen(self, now: float) -> Advice:
        """Give advice on the current view, then on deviations from the plan."""
        views = [each.view for each in self._lidars]
        advice = advise(views, now, needs_poles=self._wish.stored is None)
        if not advice.is_good or self._wish.plan is None:
            return advice
        for view in views:
            poles = pole_documents([each.pole for each in present(view.tracks, now)])
            compared = against_plan(self._wish.plan, poles, view.name).deviations
            wrong = next((each.text for each in compared if not each.is_as_planned), None)
            if wrong is not None:
                return Advice("off_plan", f"{wrong[0].upper()}{wrong[1:]}.")
        return advice

    def _of_recordings(self) -> RunConfig:
        target, source = TOPICS.values()
        return with_options(self._wish.config, target_topic=target, source_topic=source)

    def _keep(self, capture: Capture, now: float) -> Advice:
        """Write a placement, and calibrate by all placements, or check by this one.

        If it cannot be written it stays in memory, and is tried again.
        """
        if self._unwritten is None:
            for lidar in self._lidars:
                lidar.kept = lidar.origin
        self._unwritten, self._capture = capture, None
        if self._is_to_wait(now):
            assert self._no_room is not None
            return self._no_room[0]
        try:
            path, own = self._record(capture)
        except OSError as error:
            return self._wait_for_room(error, f"{counted(capture.count, 'sweep')} are", now)
        self._used[path] = own
        self._kept, self._unwritten, self._no_room = capture, None, None
        stored, used, config = self._wish.stored, list(self._used), self._of_recordings()
        target, source = config.target_topic, config.source_topic

        def work() -> CalibrationResult | CheckResult:
            if stored is None:
                return calibrate_with(used, used, config)
            return check_recordings(stored, path, path, target_topic=target, source_topic=source)

        captured = dict(self._used)
        self._work = in_background(lambda: _of_captured(captured, work))
        return WORKING_OUT

    def _is_to_wait(self, now: float) -> bool:
        """Whether it is too early to try again to write."""
        return self._no_room is not None and now < self._no_room[1]

    def _wait_for_room(self, error: OSError, what: str, now: float) -> Advice:
        """Report what cannot be written, with advice; it is tried again later."""
        why = quoting(f"{error.filename or self._out}: {error.strerror or error}")
        message = f"{why}. Free disk space: {what} kept in memory, and written as soon as possible."
        if self._no_room is None:
            self._note(message)
        # It is tried again 5 s later.
        self._no_room = Advice("not_written", message), now + 5.0
        return self._no_room[0]

    def _record(self, capture: Capture) -> tuple[Path, str]:
        """Write a placement to the folder, next to those of an earlier watch, and give its
        SHA-256."""
        number = self._recorded + 1
        while (path := self._out / RECORDING.format(number)).exists():
            number += 1
        tracks = {
            topic: Track(lidar.frame_id or lidar.view.name, frames)
            for topic, lidar, frames in zip(
                TOPICS.values(), self._lidars, capture.frames, strict=True
            )
        }
        recording = write_recording(tracks)
        write_together({path: recording})
        self._recorded = number
        self.written.append(path)
        kept = counted(capture.count, "sweep")
        self._note(f"placement {self._recorded} is kept: {kept} of each LiDAR")
        return path, hashlib.sha256(recording).hexdigest()

    def _collect(self) -> None:
        """Process the answers that are ready."""
        need = self._wish.config.need
        if self._trial is not None and self._trial.done() and self._expected is None:
            with suppress(RetropoleError):
                self._expected = outcome_of(self._trial.result().document, need)
        now = self._clock()
        if self._work is None or not self._work.done() or self._is_to_wait(now):
            return
        try:
            found = self._work.result()
        except RetropoleError as error:
            self._work = None
            self._leave_out(error)
            return
        if isinstance(found, CheckResult):
            self._work, self.checked, self.is_over = None, found, True
            return
        try:
            written = found.save(self._out)
        except OSError as error:
            self._wait_for_room(error, "the result is", now)
            return
        self._work = self._no_room = None
        self.result = found
        self._outcome = self._expected = outcome_of(found.document, need)
        self.written += [each for each in written if each not in self.written]
        message = "; ".join(reason.message for reason in found.reasons)
        self._note(f"calibrated: {found.status}{': ' + message if message else ''}")
        self.is_over = self._outcome.is_enough
        more = self._outcome.seconds_more
        if more and self._kept is not None:
            self._note(f"the masts sway: {math.ceil(more)} s more are recorded")
            self._capture = replace(self._kept, seconds=self._kept.seconds + more)
            self._used.popitem()
        elif self._outcome.is_spoilt and len(self._used) > 1:
            self._note(f"placement {self._recorded} is left out")
            self._used.popitem()

    def _leave_out(self, error: RetropoleError) -> None:
        """Leave the newest placement out; if recordings have changed since they were captured,
        those."""
        others = [path for path, own in self._used.items() if not _is_still(path, own)]
        for path in others:
            self._note(f"{path.name} is left out: it has changed since it was recorded")
            del self._used[path]
        if not others:
            self._note(f"placement {self._recorded} is left out: {error}")
            self._used.popitem()
        if not self._used:
            for lidar in self._lidars:
                lidar.kept = None

    def _note(self, message: str) -> None:
        self._messages.append(f"{datetime.now():%H:%M:%S} {quoting(message)}")

    def _document_of(self, advice: Advice, now: float) -> WatchDoc:
        """Write the current view and advice as a document."""
        outcome, expected, capture = self._outcome, self._expected, self._capture
        angles = [angle_between([each.pole for each in present(own, now)]) for own in self._tracks]
        known = [each for each in angles if each is not None]
        status = self.checked.status if self.checked else outcome and outcome.document.status
        return WatchDoc(
            phase=self._phase(),
            is_good=advice.is_good,
            code=advice.code,
            next=advice.text,
            seconds=now - self._start,
            lidars=[seen_now(each, now) for each in self._lidars],
            angle_rad=sum(known) / len(known) if known else None,
            captured=capture.count if capture else 0,
            wanted=self._wish.sweeps if capture else 0,
            placements=len(self._used),
            need=self._wish.config.need or USABLE,
            predicted_error=list(expected.document.predicted_error or []) if expected else [],
            bound_m=expected.bound if expected else None,
            probability=expected.probability if expected else None,
            status=status or None,
            words=list(self._messages),
        )

    def _phase(self) -> Phase:
        if self.is_over:
            return "done"
        if self._work is not None:
            return "calibrating"
        if self._capture is not None:
            return "capturing"
        none_yet = any(each.view.looked is None for each in self._lidars)
        return "waiting" if none_yet else "placing"


def _of_captured(captured: Mapping[Path, str], work: Callable[[], T]) -> T:
    """Call a function that reads recordings, and check that these are the captured ones.

    Raises
    ------
    ReadError
        If one is not.
    """

    def check() -> None:
        for path, own in captured.items():
            if not _is_still(path, own):
                raise ReadError(f"{path}: has changed since it was recorded")

    check()
    found = work()
    check()
    return found


def _is_still(path: Path, own: str) -> bool:
    """Whether a recording has this SHA-256."""
    try:
        return sha256_of(path) == own
    except ReadError:
        return False


def checked_words(checked: CheckResult) -> str:
    """Describe the result of a check."""
    texts = {"same": "Same: neither LiDAR has moved.", "moved": "Moved: calibrate again."}
    message = " ".join(reason.message for reason in checked.reasons[:1])
    return texts.get(checked.status, f"Undecided: {message}")


def in_background(work: Callable[[], T]) -> Future[T]:
    """Begin work that Ctrl-C does not wait for."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, daemon=True).start()
    return future
