"""The method on one page: clouds in, one extrinsic out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from threadpoolctl import threadpool_limits

from . import se3
from .alignment.adjustment import BeamAlignment, align_beams
from .alignment.observations import beams_of
from .datatypes import Calibration, Hypothesis, Placement, PointCloud, Pole, Reason
from .errors import Refusal
from .extraction.poles import extract_poles
from .matching.correspondence import match_poles
from .matching.placements import merged, recurring
from .matching.prior import RotationPrior, agreeing
from .scene.disambiguation import judge
from .scene.refinement import refine
from .scene.static import check_static, remove_dynamic_points
from .sensors import Sensor
from .uncertainty import predicted_error, weakest_direction
from .verdict import check_choice, margin_of, weaknesses

DEFAULT_RADIUS = 0.02
"""Radius of the taped poles, metres (Xue et al. 2019)."""

Pairing = tuple[list[Pole], list[Pole]]
"""The poles of a placement that the chosen hypothesis pairs: the target's, the source's."""


def calibrate(
    target: PointCloud | Sequence[PointCloud],
    source: PointCloud | Sequence[PointCloud],
    *,
    radius: float = DEFAULT_RADIUS,
    radius_sigma: float = 0.0,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
    poles: int | None = None,
    scene: bool = True,
    prior: RotationPrior | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    Parameters
    ----------
    target, source
        The two clouds, each in its own frame; both need an intensity. Or as many clouds of each as
        there were placements of the poles, in the same order: one pose is found for all.
    radius, radius_sigma
        Radius of the poles and its 1 σ, metres; a radius that is not known for sure is estimated.
    sensors
        What the target and the source LiDAR are; None where not known.
    thresholds
        Intensity from which a return counts as retro-reflective, in each cloud; None asks the
        sensor, or else the cloud itself.
    poles
        Exact number of poles that both LiDARs see; None takes any number from two up.
    scene
        Whether the scene refines the pose that the poles give.
    prior
        What is known of the rotation; hypotheses that contradict it are passed over.
    progress
        Called with the name of each step as it starts.

    Returns
    -------
    Calibration
        With `status` ``refused``, the reasons and no transform where the data carry no answer;
        never a guess.
    """
    seconds: dict[str, float] = {}
    placements: list[Placement] = []
    hypotheses: tuple[Hypothesis, ...] = ()

    @contextmanager
    def step(name: str) -> Iterator[None]:
        progress(name)
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    def align(paired: Sequence[Pairing], start: np.ndarray) -> BeamAlignment:
        """Align the poles of some placements (their index in `placements` is that in `paired`)."""
        beams = []
        for side in (0, 1):
            standing = [(pole, k) for k, pair in enumerate(paired) for pole in pair[side]]
            clouds = [(placements[k].target, placements[k].source)[side] for _, k in standing]
            beams.append(beams_of([pole for pole, _ in standing], clouds, sensors[side]))
        return align_beams(beams[0], beams[1], start, radius=radius, radius_sigma=radius_sigma)

    # Matrices here are small: the threads of BLAS, which wait by spinning, only get in the way.
    one_thread = threadpool_limits(1, user_api="blas")
    try:
        with step("extract"):
            for cloud_target, cloud_source in zip(_each(target), _each(source), strict=True):
                here = Placement(
                    remove_dynamic_points(cloud_target), remove_dynamic_points(cloud_source)
                )
                placements.append(here)
                for side, cloud in enumerate((here.target, here.source)):
                    found = extract_poles(
                        cloud, sensor=sensors[side], threshold=thresholds[side], radius=radius
                    )
                    here = placements[-1] = here.with_detection(side, found)
                    check_static(("target", "source")[side], cloud, found.poles)
        with step("match"):
            matches = [
                agreeing(match_poles(p.target_poles, p.source_poles, poles), prior)
                for p in placements
            ]
        with step("disambiguate"):
            judged = [
                judge(p.target, p.source, m) for p, m in zip(placements, matches, strict=True)
            ]
            hypotheses = judged[0]
            choices = recurring(judged, [p.source_poles for p in placements])
            joint = [choice.joint for choice in choices]
            left = [h for h in judged[0] if all(h.match is not j.match for j in joint)]
            hypotheses = tuple(joint + (left if len(placements) == 1 else []))
            check_choice(hypotheses)
            paired: list[Pairing] = [
                (
                    [p.target_poles[i] for i, _ in h.match.pairs],
                    [p.source_poles[j] for _, j in h.match.pairs],
                )
                for p, h in zip(placements, choices[0].each, strict=True)
            ]
        with step("align"):
            aligned = align(paired, hypotheses[0].match.T_target_source)
            placements = _left_out(placements, paired, aligned, align)
        with step("refine"):
            refined = (
                refine(
                    merged([p.target for p in placements]),
                    merged([p.source for p in placements]),
                    aligned.stage,
                )
                if scene
                else None
            )
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
            weakest=None,
            placements=tuple(placements),
            seconds=seconds,
        )
    finally:
        one_thread.restore_original_limits()
    answer = aligned.stage if refined is None else refined.stage
    weakest = weakest_direction(answer, aligned.axis_points, aligned.axis_directions)
    reasons = weaknesses(paired, hypotheses, aligned, sensors, weakest, refined)
    return Calibration(
        status="warn" if reasons else "ok",
        reasons=tuple(reasons),
        T_target_source=answer.T_target_source,
        covariance=answer.covariance,
        poles=aligned.stage,
        refined=None if refined is None else refined.stage,
        hypotheses=hypotheses,
        margin=margin_of(hypotheses),
        predicted_error=predicted_error(answer.covariance),
        weakest=weakest,
        placements=tuple(placements),
        seconds=seconds,
    )


def _each(clouds: PointCloud | Sequence[PointCloud]) -> Sequence[PointCloud]:
    return [clouds] if isinstance(clouds, PointCloud) else clouds


def _left_out(
    placements: list[Placement],
    paired: list[Pairing],
    aligned: BeamAlignment,
    align: Callable[[Sequence[Pairing], np.ndarray], BeamAlignment],
) -> list[Placement]:
    """Say of each of several placements how the poles' pose differs without it."""
    if len(placements) < 2:
        return placements
    T = aligned.stage.T_target_source
    found = []
    for k, placement in enumerate(placements):
        rest: list[Pairing] = [p if j != k else ([], []) for j, p in enumerate(paired)]
        try:
            step = se3.local(T, align(rest, T).stage.T_target_source)
        except Refusal:
            found.append(placement)
            continue
        apart = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
        found.append(placement.with_left_out(apart))
    return found
