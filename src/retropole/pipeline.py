"""The method on one page: clouds of two LiDARs in, one extrinsic out; of many, all their poses.

A site of two LiDARs that nothing but each other ties is a pair, and calibrated as one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from .adjustment.agreement import check_contradiction, without_misplaced
from .adjustment.answer import SiteCalibration
from .adjustment.blunders import check_poles_of_dependent, without_blunders, worst_test
from .adjustment.datum import Dependent, find_datum, find_dependent
from .adjustment.descent import scene_pairs
from .adjustment.masts import align_on_one_mast, with_masts
from .adjustment.refinement import refine_by_scene
from .adjustment.shared import SharedPole, same_poles, shared_poles
from .adjustment.site import Adjusted, Recorded, adjust
from .adjustment.swapped import check_places, check_swapped
from .alignment.origins import beam_origins
from .base.datatypes import DEFAULT_RADIUS, Array, Calibration, Hypothesis, Placement, PointCloud
from .base.description import Site, is_pair
from .base.errors import Reason, Refusal, UsageError
from .base.sensors import Sensor
from .base.timing import timed
from .base.uncertainty.confirmation import Confirmation
from .base.uncertainty.purpose import Need
from .hypotheses.by_place import (
    align_by_place_if_open,
    check_confirmed_by_surroundings,
    check_constrained,
)
from .hypotheses.choice import list_hypotheses, take_by_hand
from .hypotheses.evidence import check_confirmation, confirm
from .hypotheses.joint_choice import Choices, check_linked, choose_poses, linked_groups
from .hypotheses.links import link_by_candidates, link_by_place, with_own_candidates
from .hypotheses.pairs import Pair, find_pairs, poles_of
from .hypotheses.placements import Chosen, leave_one_out
from .hypotheses.prior import PosePrior
from .hypotheses.scans import SiteScans, Views, find_scans, patches_of, views_of
from .hypotheses.search import choose, choose_with_candidates
from .surfaces.scans import find_poles
from .surfaces.static import check_poles, check_recordings
from .verdict.fitness import judge
from .verdict.map import of_map
from .verdict.preference import check_near_poles
from .verdict.similarity import check_similarity, check_unit, explain
from .verdict.site import check_decided, confirm_links, radius_conflict
from .verdict.statement import (
    Answered,
    advising_no_poles,
    exchanged,
    list_unusable,
    state_answer,
    state_answer_of_two,
    state_refusal,
    state_site_answer,
    state_site_refusal,
)


@dataclass(frozen=True)
class Options:
    """What is known of two LiDARs and their poles, and how their pose is to be found.

    Attributes
    ----------
    radius, radius_sigma
        Radius of the poles and its 1 σ, metres; a radius that is not known exactly is estimated.
    sensors
        What the target and the source LiDAR are; None if not known.
    thresholds
        Intensity from which a return is treated as retro-reflective, in each cloud; None takes it
        from the sensor, or else the cloud.
    poles
        Exact number of poles that both LiDARs see; None takes any number from one up. Without any,
        0, the scene gives all of the pose, and the clouds need no intensity.
    scene
        Whether the scene refines the pose that the poles give.
    prior
        What is known of the rotation; hypotheses that contradict it are left out.
    by_hand
        Name of the hypothesis to use, in the list that the same run gives without it; None lets the
        scene choose. Whatever it is, the scene may still conflict with it, and the verdict is no
        more than ``warn``.
    trust_poles
        Whether to take the poles' word where the scene has too little to confirm it.
    deceiving
        Share of recordings like these that deceive, for which the probability of a wrong answer is
        stated; None takes what the times of both LiDARs allow.
    candidates
        Whether to try the candidate poles where the confirmed ones give no answer.
    need
        How accurate the answer must be, which the verdict answers; None only requires usable.
    mast_sway
        1 σ of the angle that the masts of both LiDARs are said to sway by, rad; None only takes
        what the sweeps of a recording show.
    """

    radius: float = DEFAULT_RADIUS
    radius_sigma: float = 0.0
    sensors: tuple[Sensor | None, Sensor | None] = (None, None)
    thresholds: tuple[float | None, float | None] = (None, None)
    poles: int | None = None
    scene: bool = True
    prior: PosePrior | None = None
    by_hand: str | None = None
    trust_poles: bool = False
    deceiving: float | None = None
    candidates: bool = True
    need: Need | None = None
    mast_sway: float | None = None


NO_OPTIONS = Options()


def calibrate(
    target: PointCloud | Sequence[PointCloud],
    source: PointCloud | Sequence[PointCloud],
    *,
    options: Options = NO_OPTIONS,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    Parameters
    ----------
    target, source
        The two clouds, each in the frame of its LiDAR; both need an intensity. Or as many clouds of
        each as there were placements of the poles, in the same order: one pose is found for all.
    options
        What is known of both, and how the pose is to be found.
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
        If no hypothesis that fits the poles has the name `Options.by_hand`, and where neither
        poles nor the scene may give the pose.
    """
    seconds: dict[str, float] = {}
    step = partial(timed, seconds, progress)
    searched = options.poles != 0
    find = partial(find_poles, radius=options.radius, search=searched, mast_sway=options.mast_sway)
    with step("extract"), threadpool_limits(1, user_api="blas"):
        found = []
        for pair in zip(_each(target), _each(source), strict=True):
            about = zip(pair, options.sensors, options.thresholds, strict=True)
            scans = [find(cloud, sensor=s, threshold=t) for cloud, s, t in about]
            found.append(Placement(scans[0], scans[1]))
    answer = calibrate_placements(found, seconds, options=options, progress=progress).calibration
    no_intensity = answer.reasons and answer.reasons[0].code == "no_intensity"
    if no_intensity and options.scene and options.poles is None:
        with step("explain"):
            bare = Options(sensors=options.sensors, poles=0, prior=options.prior)
            answer = advising_no_poles(answer, calibrate(target, source, options=bare))
    return answer


def calibrate_placements(
    found: Sequence[Placement],
    seconds: dict[str, float],
    *,
    options: Options,
    check: Callable[[Sequence[Placement]], None] = check_poles,
    progress: Callable[[str], None] = lambda step: None,
) -> Answered:
    """Find the transform from what two LiDARs recorded, searched for poles.

    Parameters
    ----------
    found
        Of each placement, in the frames of the clouds.
    seconds
        Time of each previous step; those of this one are added.
    options, progress
        As of `calibrate`.
    check
        Refuses what cannot be used as it was recorded.

    Raises
    ------
    UsageError
        As of `calibrate`.
    """
    poles, scene, prior, by_hand = options.poles, options.scene, options.prior, options.by_hand
    radius, thresholds, trusted = options.radius, options.thresholds, options.trust_poles
    if poles == 0 and not scene:
        raise UsageError("without poles the scene must determine the pose: leave out --no-refine")
    known = {"radius": radius, "radius_sigma": options.radius_sigma}
    step = partial(timed, seconds, progress)
    origins = beam_origins(found)
    placements = origins.about(found)
    chosen = Chosen((), ())
    hypotheses: tuple[Hypothesis, ...] = ()
    confirmation: Confirmation | None = None

    # Matrices here are small: threads of BLAS, which wait by spinning, only get in the way.
    with threadpool_limits(1, user_api="blas"):
        try:
            with step("check"):
                check(placements)
            search = (
                partial(choose_with_candidates, radius=radius, by_place=scene)
                if options.candidates or poles == 0
                else choose
            )
            chosen = search(placements, step=step, count=poles, prior=prior)
            chosen = take_by_hand(chosen, by_hand)
            hypotheses = chosen.hypotheses
            if chosen.refusal is not None:
                raise chosen.refusal
            with step("align"):
                chosen, aligned = align_by_place_if_open(
                    chosen, **known, by_place=scene and by_hand is None, count=poles, prior=prior
                )
                hypotheses = chosen.hypotheses
                paired, aligned = align_on_one_mast(chosen.paired, aligned, **known)
                paired, aligned = without_misplaced(paired, aligned, **known, scene=scene)
                first = replace(hypotheses[0], match=paired[0].hypothesis.match)
                hypotheses = first, *hypotheses[1:]
                placements = leave_one_out(paired, aligned, **known)
            with step("refine"):
                refined = refine_by_scene(paired, aligned) if scene else None
                by_surfaces = (None, None) if refined is None else (refined.pose, refined.held)
                check_constrained(paired, *by_surfaces)
                check_contradiction(refined)
                check_near_poles(aligned, refined)
            with step("confirm"):
                pose = (aligned if refined is None else refined).pose.T_target_source
                # The same recordings give the same answer.
                rng = np.random.default_rng(0)
                others = hypotheses[1:]
                confirmation = confirm(
                    paired, pose, others, rng, trusted=trusted, deceiving=options.deceiving
                )
                check_confirmation(confirmation)
                check_confirmed_by_surroundings(paired, confirmation)
                check_similarity(refined, placements, pose)
                if poles != 0:
                    check_unit(found[0], radius=radius, thresholds=thresholds)
        except Refusal as refusal:
            with step("explain"):
                cause = explain(
                    refusal, placements, hypotheses, radius=radius, thresholds=thresholds
                )
                cause = of_map(cause) if placements[0].target.cloud.is_map else cause
                answer = state_refusal(cause, placements, hypotheses, seconds, confirmation)
                answer = list_hypotheses(answer, chosen, by_hand)
                return Answered(origins.moved_back(answer))
        with step("judge"):
            answer = state_answer(
                paired, placements, hypotheses, aligned, refined, confirmation, seconds
            )
            # Ranges count from where the beams start.
            answer = judge(list_hypotheses(answer, chosen, by_hand), options.need)
            return Answered(origins.moved_back(answer), paired, aligned, refined)


def _each(clouds: PointCloud | Sequence[PointCloud]) -> Sequence[PointCloud]:
    return [clouds] if isinstance(clouds, PointCloud) else clouds


MOVED = {
    *("placements_disagree", "poles_inconsistent", "degenerate_poles"),
    *("poles_scene_contradict", "scene_contradicts"),
}
"""Refusals of two LiDARs after which the tests of a site may name what to leave out."""


def calibrate_site(
    site: Site, *, progress: Callable[[str], None] = lambda step: None
) -> SiteCalibration:
    """Find the poses of all LiDARs of a site in one frame.

    Parameters
    ----------
    site
        LiDARs with their clouds, and what was surveyed.
    progress
        Called with the name of each step as it starts.

    Returns
    -------
    SiteCalibration
        With `status` ``refused``, the reasons and no poses where the data carry no answer.
    """
    seconds: dict[str, float] = {}
    step = partial(timed, seconds, progress)
    count = len(site.lidars)
    pairs: tuple[Pair, ...] = ()
    groups: list[list[int]] = []
    blunders: list[Reason] = []
    # Matrices here are small: the threads of BLAS, which wait by spinning, only get in the way.
    with threadpool_limits(1, user_api="blas"):
        with step("extract"):
            scans = find_scans(site)
        of_two = calibrate_two(site, scans, seconds, progress) if is_pair(site) else None
        if of_two is not None and not (of_two.reasons and of_two.reasons[0].code in MOVED):
            return of_two
        try:
            with step("match"):
                views = views_of(scans)
                check_places(site, views)
                pairs = find_pairs(scans, views)
                scans, pairs = link_by_candidates(scans, pairs, site.radius)
                scans, pairs = link_by_place(scans, pairs, site.radius)
                groups = linked_groups(count, pairs)
            with step("choose"):
                at = [poles_of(scans, lidar) for lidar in range(count)]
                choices = choose_poses(groups[0], pairs, at, groups[0][0])
                if choices.rivals:
                    scans, pairs, choices = decide_by_candidates(
                        scans, views, pairs, groups[0], choices, site.radius
                    )
                    at = [poles_of(scans, lidar) for lidar in range(count)]
                check_swapped(site, scans, views, pairs, choices.best, at)
                check_linked(site, scans, groups, pairs)
                check_decided(site, choices, pairs, at)
            with step("adjust"):
                scans = with_masts(scans, choices.best.poses)
                poles = shared_poles(scans, choices.best.poses, site.radius)
                dependent = find_dependent(pairs, choices.best.poses)
                datum = find_datum(site, scans.origins, choices.best.poses, poles, dependent)
                patches = patches_of(scans)
                recorded = Recorded(site, scans, patches, scene_pairs(patches, groups[0]))
                adjusted = adjust(recorded, datum)
                # Rough poses may be off by more than poles of few returns differ, and returns
                # that lie next to a pole under them pull no more; what of a survey they did not
                # encounter may occur now.
                misfit = worst_test(adjusted.tests) is not None
                if misfit and (site.poles or site.points):
                    # A survey that is wrong has pulled at the poses.
                    adjusted = adjust_without_survey(recorded, choices.best.poses, poles, dependent)
                poses = dict(enumerate(adjusted.end.T))
                again = shared_poles(scans, poses, site.radius)
                if misfit or adjusted.datum.unmet or not same_poles(again, poles):
                    datum = find_datum(site, scans.origins, poses, again, dependent)
                    adjusted = adjust(recorded, datum)
            with step("test"):
                # Whatever is refused from here on, a radius that the returns contradict may be why.
                blunders = list(radius_conflict(adjusted))
                adjusted, blunders = without_blunders(recorded, adjusted)
                unchecked = list(check_poles_of_dependent(recorded, adjusted))
            with step("confirm"):
                unconfirmed = list(confirm_links(site, scans, adjusted, pairs))
        except Refusal as refusal:
            return state_site_refusal(site, scans, pairs, groups, refusal, blunders, seconds)
        if of_two is not None and not blunders:
            return of_two
        with step("state"):
            unusable = list_unusable(site, scans)
            found = [*unusable, *adjusted.datum.unmet, *blunders, *unchecked, *unconfirmed]
            return state_site_answer(site, scans, pairs, groups, adjusted, found, seconds)


def calibrate_two(
    site: Site,
    scans: SiteScans,
    seconds: dict[str, float],
    progress: Callable[[str], None],
) -> SiteCalibration | None:
    """Find the pose of two LiDARs that nothing but each other ties: they are a pair.

    Returns
    -------
    SiteCalibration or None
        None if no placement shows both, and if one of them does not show one place in all.
    """
    if site.reference == 1:
        other = replace(site, lidars=site.lidars[::-1], reference=0)
        answer = calibrate_two(other, scans.exchanged, seconds, progress)
        return None if answer is None else exchanged(answer, site)
    both = list(zip(*scans.by_lidar, strict=True))
    numbers = [p for p, (first, second) in enumerate(both) if first and second]
    if not numbers:
        return None
    if len(numbers) > 1:
        try:
            check_places(site, views_of(scans))
        except Refusal:
            return None
    first, second = site.lidars
    calibrate_some = partial(
        calibrate_placements,
        seconds=seconds,
        options=Options(
            radius=site.radius,
            radius_sigma=site.radius_sigma,
            thresholds=(first.threshold, second.threshold),
            need=site.need,
        ),
        check=check_recordings,
        progress=progress,
    )
    answered = calibrate_some([Placement(a, b) for a, b in both if a and b])
    # A placement that shows no two poles is done without where others do.
    of_poles = [p for p in numbers if min(len(scan.poles) for scan in both[p] if scan) > 1]
    if answered.aligned is None and 0 < len(of_poles) < len(numbers):
        numbers = of_poles
        answered = calibrate_some(
            [Placement(a, b) for a, b in (both[p] for p in numbers) if a and b]
        )
    return state_answer_of_two(site, scans, numbers, answered, seconds)


def adjust_without_survey(
    recorded: Recorded,
    poses: dict[int, Array],
    poles: Sequence[SharedPole],
    dependent: Sequence[Dependent],
) -> Adjusted:
    """Adjust all poses by poles and scenes alone, in the frame of a LiDAR."""
    bare = replace(recorded.site, poles=(), points=())
    datum = find_datum(bare, recorded.scans.origins, poses, poles, dependent)
    return adjust(replace(recorded, site=bare), datum)


def decide_by_candidates(
    scans: SiteScans,
    views: Views,
    pairs: tuple[Pair, ...],
    group: Sequence[int],
    choices: Choices,
    radius: float,
) -> tuple[SiteScans, tuple[Pair, ...], Choices]:
    """Count candidate poles, too, where with them one choice alone goes together."""
    more = with_own_candidates(scans, radius)
    found = find_pairs(more, views)
    if not set(group) <= set(linked_groups(len(more.by_lidar), found)[0]):
        # What links some of them is not found among pairs of poles.
        return scans, pairs, choices
    at = [poles_of(more, lidar) for lidar in range(len(more.by_lidar))]
    again = choose_poses(group, found, at, group[0])
    if again.rivals or again.best.count <= choices.best.count:
        return scans, pairs, choices
    return more, found, again
