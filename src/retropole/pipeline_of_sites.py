"""The calibration of a site on one page: recordings of many LiDARs in, all poses out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from threadpoolctl import threadpool_limits

from .adjustment.answer import SiteCalibration
from .adjustment.blunders import check_poles_of_hanging, without_blunders, worst_test
from .adjustment.datum import Hanging, find_datum, find_hanging
from .adjustment.descent import scene_pairs
from .adjustment.masts import with_masts
from .adjustment.shared import SharedPole, same_poles, shared_poles
from .adjustment.site import Adjusted, Recorded, adjust
from .adjustment.swapped import check_places, check_swapped
from .base.datatypes import Array, Placement
from .base.description import Site, is_pair
from .base.errors import Reason, Refusal
from .base.timing import timed
from .hypotheses.joint_choice import Choices, check_linked, choose_poses, linked_groups
from .hypotheses.links import link_by_candidates, link_by_place, with_own_candidates
from .hypotheses.pairs import Pair, find_pairs, poles_of
from .hypotheses.scans import SiteScans, Views, find_scans, patches_of, views_of
from .pipeline import calibrate_placements
from .surfaces.static import check_recordings
from .verdict.site import check_decided, confirm_links, radius_denied
from .verdict.statement import (
    exchanged,
    list_unusable,
    state_answer_of_two,
    state_site_answer,
    state_site_refusal,
)

LEFT_OUT = "placements_disagree", "poles_inconsistent"
"""Refusals of two LiDARs after which a recording or a pole may be left out."""


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
        if is_pair(site):
            answer = calibrate_two(site, scans, seconds, progress)
            if answer is not None:
                return answer
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
                hanging = find_hanging(pairs, choices.best.poses)
                datum = find_datum(site, scans.origins, choices.best.poses, poles, hanging)
                patches = patches_of(scans)
                recorded = Recorded(site, scans, patches, scene_pairs(patches, groups[0]))
                adjusted = adjust(recorded, datum)
                # Rough poses may be off by more than poles of few returns lie apart, and returns
                # that lie beside a pole under them pull no more; what of a survey they did not meet
                # may be met now.
                misfit = worst_test(adjusted.tests) is not None
                if misfit and (site.poles or site.points):
                    # A survey that is wrong has pulled at the poses.
                    adjusted = adjust_without_survey(recorded, choices.best.poses, poles, hanging)
                poses = dict(enumerate(adjusted.end.T))
                again = shared_poles(scans, poses, site.radius)
                if misfit or adjusted.datum.unmet or not same_poles(again, poles):
                    datum = find_datum(site, scans.origins, poses, again, hanging)
                    adjusted = adjust(recorded, datum)
            with step("test"):
                # Whatever is refused from here on, a radius that the returns deny may be why.
                blunders = list(radius_denied(adjusted))
                adjusted, blunders = without_blunders(recorded, adjusted)
                unchecked = list(check_poles_of_hanging(recorded, adjusted))
            with step("confirm"):
                unconfirmed = list(confirm_links(site, scans, adjusted, pairs))
        except Refusal as refusal:
            return state_site_refusal(site, scans, pairs, groups, refusal, blunders, seconds)
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
        None where no placement shows both, and where several placements do not agree: what does not
        fit is left out of a site.
    """
    if site.reference == 1:
        other = replace(site, lidars=site.lidars[::-1], reference=0)
        answer = calibrate_two(other, scans.exchanged, seconds, progress)
        return None if answer is None else exchanged(answer, site)
    both = list(zip(*scans.by_lidar, strict=True))
    numbers = [p for p, (first, second) in enumerate(both) if first and second]
    if not numbers:
        return None
    first, second = site.lidars
    answered = calibrate_placements(
        [Placement(a, b) for a, b in both if a and b],
        seconds,
        radius=site.radius,
        radius_sigma=site.radius_sigma,
        thresholds=(first.threshold, second.threshold),
        need=site.need,
        check=check_recordings,
        progress=progress,
    )
    reasons = answered.calibration.reasons
    if len(numbers) > 1 and reasons and reasons[0].code in LEFT_OUT:
        return None
    return state_answer_of_two(site, scans, numbers, answered, seconds)


def adjust_without_survey(
    recorded: Recorded,
    poses: dict[int, Array],
    poles: Sequence[SharedPole],
    hanging: Sequence[Hanging],
) -> Adjusted:
    """Adjust all poses by poles and scenes alone, in the frame of a LiDAR."""
    bare = replace(recorded.site, poles=(), points=())
    datum = find_datum(bare, recorded.scans.origins, poses, poles, hanging)
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
