"""The method on one page: clouds in, one extrinsic out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from .alignment.adjustment import BeamAlignment, align_beams
from .alignment.observations import beams_of
from .alignment.origins import beam_origins
from .base.datatypes import (
    DEFAULT_RADIUS,
    Array,
    Calibration,
    Hypothesis,
    Placement,
    PointCloud,
    Scan,
)
from .base.errors import Refusal
from .base.sensors import Sensor
from .base.systematic import ErrorModel, sizes_of
from .base.uncertainty import Confirmation, predicted_error, weakest_direction
from .base.uncertainty.purpose import Need
from .extraction.extent import located
from .extraction.poles import extract_poles
from .matching import correspondence
from .matching.budget import Share, Tried
from .matching.confirmation import Chosen, choose_with_doubtful, counts_doubtful
from .matching.placements import (
    PairedPlacement,
    PlacementHypotheses,
    PlacementMatches,
    leave_one_out,
    merged,
)
from .matching.prior import RotationPrior, agreeing_with_prior
from .scene import disambiguation, settling
from .scene.agreement import align_consistent, check_contradiction
from .scene.choice import as_listed, choose_best, margin_of, taken_by_hand
from .scene.confirmation import check_confirmation, confirm
from .scene.copies import without_copies
from .scene.preference import check_near_poles
from .scene.refinement import Refinement, refine
from .scene.similarity import check_similarity, explained
from .scene.static import check_poles, remove_dynamic_points
from .verdict import refused, weaknesses
from .verdict.fitness import judged


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
    by_hand: str | None = None,
    trust_poles: bool = False,
    doubtful: bool = True,
    need: Need | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    Parameters
    ----------
    target, source
        The two clouds, each in its own frame; both need an intensity. Or as many clouds of each as
        there were placements of the poles, in the same order: one pose is found for all.
    radius, radius_sigma
        Radius of the poles and its 1 σ, metres; a radius that is not known exactly is estimated.
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
        What is known of the rotation; hypotheses that contradict it are left out.
    by_hand
        Name of the hypothesis to take in the list that the same run gives without it; None lets
        the scene choose. Whatever it is, the scene may still deny it, and the verdict is no more
        than ``warn``.
    trust_poles
        Whether to take the poles' word where the scene has too little to confirm it.
    doubtful
        Whether to try the doubtful poles where the sure ones give no answer.
    need
        How accurate the answer must be, which the verdict answers; None only asks for usable.
    progress
        Called with the name of each step as it starts.

    Returns
    -------
    Calibration
        With `status` ``refused``, the reasons and no transform where the data carry no answer;
        never a guess.

    Raises
    ------
    UsageError
        Where no hypothesis that fits the poles has the name `by_hand`.
    """
    clouds = zip(_each(target), _each(source), strict=True)
    find_target, find_source = (
        partial(find_poles, sensor=sensor, threshold=threshold, radius=radius)
        for sensor, threshold in zip(sensors, thresholds, strict=True)
    )
    align_poles = partial(align, radius=radius, radius_sigma=radius_sigma)
    seconds: dict[str, float] = {}
    step = partial(timed, seconds, progress)
    chosen = Chosen((), ())
    hypotheses: tuple[Hypothesis, ...] = ()
    confirmation: Confirmation | None = None

    with ExitStack() as limits:
        with step("extract"):
            # Matrices here are small: threads of BLAS, which wait by spinning, only get in the way.
            limits.enter_context(threadpool_limits(1, user_api="blas"))
            found = tuple(Placement(find_target(t), find_source(s)) for t, s in clouds)
            origins = beam_origins(found)
            placements = origins.about(found)
        try:
            with step("check"):
                check_poles(placements)
            choose_from = partial(choose, count=poles, prior=prior, step=step)
            settle_from = partial(choose_settled, step=step)
            chosen = (
                choose_with_doubtful(choose_from, settle_from, placements, radius, step)
                if doubtful
                else choose_from(placements)
            )
            chosen = taken_by_hand(chosen, by_hand)
            hypotheses = chosen.hypotheses
            if chosen.refusal is not None:
                raise chosen.refusal
            refine_poles = partial(refine_by_scene, placements, sensors=sensors, scene=scene)
            paired: Sequence[PairedPlacement] = chosen.paired
            with step("align"):
                T_poles = hypotheses[0].match.T_target_source
                paired, aligned = align_consistent(paired, T_poles, align_poles, refine_poles)
                first = replace(hypotheses[0], match=paired[0].hypothesis.match)
                hypotheses = first, *hypotheses[1:]
                placements = leave_one_out(paired, aligned, align_poles)
            with step("refine"):
                refined = refine_poles(aligned)
                check_contradiction(refined)
                check_near_poles(aligned, refined)
            with step("confirm"):
                pose = (aligned if refined is None else refined).pose.T_target_source
                # The same recordings give the same answer.
                rng = np.random.default_rng(0)
                confirmation = confirm(paired, pose, hypotheses[1:], rng, trusted=trust_poles)
                check_confirmation(confirmation)
                check_similarity(refined, placements, pose)
        except Refusal as refusal:
            with step("explain"):
                cause = explained(refusal, placements, hypotheses, (find_target, find_source))
                answer = refused(cause, placements, hypotheses, seconds, confirmation)
                return origins.moved_back(as_listed(answer, chosen, by_hand))
        with step("judge"):
            answer = answered(
                paired, placements, hypotheses, aligned, refined, confirmation, seconds
            )
            # Ranges count from where the beams start.
            return origins.moved_back(judged(as_listed(answer, chosen, by_hand), need))


def find_poles(
    cloud: PointCloud, *, sensor: Sensor | None, threshold: float | None, radius: float
) -> Scan:
    """Find the poles in a cloud; of several frames, without what moved.

    Never raises a refusal: the scan holds it, and `check_poles` raises it, so that what was found
    elsewhere is not lost.
    """
    try:
        cloud = remove_dynamic_points(located(without_copies(cloud), radius))
        detection = extract_poles(cloud, sensor=sensor, threshold=threshold, radius=radius)
    except Refusal as refusal:
        return Scan(cloud, sensor, None, refusal)
    return Scan(cloud, sensor, detection)


def choose(
    placements: Sequence[Placement],
    count: int | None,
    prior: RotationPrior | None,
    step: Callable[[str], AbstractContextManager[None]],
) -> Chosen:
    """Match the poles of every placement and let the scene choose; a refusal is kept."""
    try:
        with step("match"):
            matched = [match_poles(placement, count, prior) for placement in placements]
        with step("disambiguate"):
            return choose_best([score_hypotheses(each) for each in matched])
    except Refusal as refusal:
        return Chosen((), (), refusal)


def choose_settled(chosen: Chosen, step: Callable[[str], AbstractContextManager[None]]) -> Chosen:
    """Let the scene move the hypotheses of a choice, if it has any, and choose once more."""
    if not chosen.scored:
        return chosen
    try:
        with step("settle"):
            settled = [settle(each) for each in chosen.scored]
            return choose_best([score_hypotheses(each) for each in settled])
    except Refusal as refusal:
        return Chosen((), (), refusal)


def match_poles(
    placement: Placement, count: int | None, prior: RotationPrior | None
) -> PlacementMatches:
    """Find the ways of laying the source poles on the target poles that the prior allows."""
    found, laid = correspondence.every_match(
        placement.target.poles, placement.source.poles, count, part=counts_doubtful(placement)
    )
    allowed = agreeing_with_prior(found, prior)
    best = allowed[: correspondence.MAX_HYPOTHESES]
    return PlacementMatches(placement, best, Tried(laid, Share(len(best), len(allowed))))


def score_hypotheses(matched: PlacementMatches) -> PlacementHypotheses:
    """Score every match of a placement by the scene."""
    target, source = matched.placement.target.cloud, matched.placement.source.cloud
    hypotheses = disambiguation.score_hypotheses(target, source, matched.matches)
    return PlacementHypotheses(matched.placement, hypotheses, matched.tried)


def settle(scored: PlacementHypotheses) -> PlacementMatches:
    """Let the scene move the hypotheses of a placement as far as their poles allow."""
    target, source = scored.placement.target, scored.placement.source
    matches = settling.settle(target.cloud, source.cloud, scored.hypotheses, source.poles)
    exact = sum(each.match.exact for each in scored.hypotheses)
    fitting = Share(min(exact, settling.SETTLED_AT_MOST), exact)
    return PlacementMatches(scored.placement, matches, scored.tried._replace(fitting=fitting))


def align(
    paired: Sequence[PairedPlacement], T_start: Array, *, radius: float, radius_sigma: float
) -> BeamAlignment:
    """Align the paired poles of all placements by where the beams can have met them."""
    target = [(pole, each.placement.target.cloud) for each in paired for pole in each.target_poles]
    source = [(pole, each.placement.source.cloud) for each in paired for pole in each.source_poles]
    sensors = paired[0].placement.target.sensor, paired[0].placement.source.sensor
    return align_beams(
        beams_of(target, sensors[0]),
        beams_of(source, sensors[1]),
        T_start,
        radius=radius,
        radius_sigma=radius_sigma,
        sizes=(sizes_of(sensors[0]), sizes_of(sensors[1])),
        placement=np.repeat(np.arange(len(paired)), [len(each.target_poles) for each in paired]),
    )


def refine_by_scene(
    placements: Sequence[Placement],
    aligned: BeamAlignment,
    *,
    sensors: tuple[Sensor | None, Sensor | None],
    scene: bool,
) -> Refinement | None:
    """Refine the poles' pose by the surfaces of all placements; None where there are too few."""
    if not scene:
        return None
    return refine(
        merged([placement.target.cloud for placement in placements]),
        merged([placement.source.cloud for placement in placements]),
        aligned.pose,
        factor=aligned.factor,
        model=ErrorModel((sizes_of(sensors[0]), sizes_of(sensors[1])), aligned.radius.given_sigma),
    )


def answered(
    paired: Sequence[PairedPlacement],
    placements: tuple[Placement, ...],
    hypotheses: tuple[Hypothesis, ...],
    aligned: BeamAlignment,
    refined: Refinement | None,
    confirmation: Confirmation,
    seconds: dict[str, float],
) -> Calibration:
    """State the answer: its pose, what error to expect, and what makes it weak."""
    pose = aligned.pose if refined is None else refined.pose
    assert pose.covariance is not None
    weakest = weakest_direction(
        pose.T_target_source, pose.covariance, aligned.axis_points, aligned.axis_directions
    )
    reasons = tuple(weaknesses(paired, hypotheses, aligned, weakest, refined, confirmation))
    return Calibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        T_target_source=pose.T_target_source,
        covariance=pose.covariance,
        poles=aligned.pose,
        refined=None if refined is None else refined.pose,
        hypotheses=hypotheses,
        margin=margin_of(hypotheses),
        predicted_error=predicted_error(pose.covariance),
        weakest=weakest,
        placements=placements,
        seconds=seconds,
        uncertainty=aligned.uncertainty if refined is None else refined.uncertainty,
        radius=aligned.radius,
        confirmation=confirmation,
    )


def _each(clouds: PointCloud | Sequence[PointCloud]) -> Sequence[PointCloud]:
    return [clouds] if isinstance(clouds, PointCloud) else clouds


@contextmanager
def timed(seconds: dict[str, float], progress: Callable[[str], None], name: str) -> Iterator[None]:
    """Name a step that starts, and note how long it took, also where it ends in a refusal."""
    progress(name)
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
