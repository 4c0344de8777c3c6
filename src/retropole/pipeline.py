"""The method on one page: two clouds in, one extrinsic out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .alignment import align_axes
from .correspondence import match_poles
from .datatypes import Calibration, Detection, Hypothesis, Match, PointCloud, Reason
from .disambiguation import judge
from .errors import Refusal
from .extraction import extract_poles
from .refinement import refine
from .sensors import Sensor
from .uncertainty import predicted_error
from .verdict import check_choice, check_pull, margin_of, weaknesses

RADIUS = 0.02
"""Radius of the taped poles, metres (Xue et al. 2019)."""


def calibrate(
    target: PointCloud,
    source: PointCloud,
    *,
    radius: float = RADIUS,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
    poles: int | None = None,
    scene: bool = True,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    Parameters
    ----------
    target, source
        The two clouds, each in its own frame; both need an intensity.
    radius
        Radius of the poles, metres.
    sensors
        What the target and the source LiDAR are; None where not known.
    thresholds
        Intensity from which a return counts as retro-reflective, in each cloud; None asks the
        sensor, or else the cloud itself.
    poles
        Exact number of poles that both LiDARs see; None takes any number from two up.
    scene
        Whether the scene refines the pose that the poles give.
    progress
        Called with the name of each step as it starts.

    Returns
    -------
    Calibration
        With `status` ``refused``, the reasons and no transform where the data carry no answer;
        never a guess.
    """
    seconds: dict[str, float] = {}
    target_found: Detection | None = None
    source_found: Detection | None = None
    hypotheses: tuple[Hypothesis, ...] = ()

    @contextmanager
    def step(name: str) -> Iterator[None]:
        progress(name)
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    try:
        with step("extract"):
            target_found = extract_poles(
                target, sensor=sensors[0], threshold=thresholds[0], radius=radius
            )
            source_found = extract_poles(
                source, sensor=sensors[1], threshold=thresholds[1], radius=radius
            )
        with step("match"):
            matches = match_poles(target_found.poles, source_found.poles, poles)
        with step("disambiguate"):
            hypotheses = judge(target, source, matches)
            check_choice(hypotheses)
        chosen: Match = hypotheses[0].match
        paired = (
            [target_found.poles[i] for i, _ in chosen.pairs],
            [source_found.poles[j] for _, j in chosen.pairs],
        )
        with step("align"):
            aligned = align_axes(
                *paired,
                chosen.T_target_source,
                radius=radius,
                origins=(target.origin, source.origin),
            )
        with step("refine"):
            refined = refine(target, source, aligned) if scene else None
    except Refusal as refusal:
        return Calibration(
            status="refused",
            reasons=(Reason(refusal.code, refusal.message, refusal.values),),
            T_target_source=None,
            covariance=None,
            poles=None,
            refined=None,
            hypotheses=hypotheses,
            margin=margin_of(hypotheses),
            predicted_error=(),
            detections=(target_found, source_found),
            seconds=seconds,
        )
    answer = aligned if refined is None else refined.stage
    reasons = weaknesses(*paired, hypotheses) + check_pull(refined)
    return Calibration(
        status="warn" if reasons else "ok",
        reasons=tuple(reasons),
        T_target_source=answer.T_target_source,
        covariance=answer.covariance,
        poles=aligned,
        refined=None if refined is None else refined.stage,
        hypotheses=hypotheses,
        margin=margin_of(hypotheses),
        predicted_error=predicted_error(answer.covariance),
        detections=(target_found, source_found),
        seconds=seconds,
    )
