"""The calibration of a site on one page: recordings of many LiDARs in, all poses out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from threadpoolctl import threadpool_limits

from .adjustment.agreement import check_contradiction
from .adjustment.answer import LidarPose, PairCheck, SiteCalibration, SitePole
from .adjustment.blunders import without_blunders, worst_test
from .adjustment.closures import close_loops
from .adjustment.contradiction import check_poles_of_hanging
from .adjustment.datum import find_datum
from .adjustment.hanging import Hanging, find_hanging
from .adjustment.masts import with_masts
from .adjustment.shared import SharedPole, same_poles, shared_poles
from .adjustment.site import Adjusted, Recorded, adjust, search_as_pair
from .adjustment.solved import axes_of
from .adjustment.swapped import check_places, check_swapped
from .adjustment.terms import scene_pairs
from .adjustment.without import without_placements
from .alignment.certainty import budget_of
from .alignment.unknowns import POSE
from .base.datatypes import Array
from .base.description import Site
from .base.errors import Reason, Refusal, warnings_and_notes
from .base.timing import timed
from .base.uncertainty import predicted_error
from .hypotheses.joint_choice import Choices, choose_poses, linked_groups
from .hypotheses.link_by_candidates import link_by_candidates, with_own_candidates
from .hypotheses.link_by_one_pole import link_by_place
from .hypotheses.linked import check_linked
from .hypotheses.pairs import Pair, find_pairs, poles_of
from .hypotheses.scans import SiteScans, Views, find_scans, patches_of, poses_in_clouds, views_of
from .verdict.preference import check_near_poles
from .verdict.site import check_decided, confirm_links, fitness_of, radius_denied, weaknesses


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
                adjusted = search_as_pair(recorded, adjusted)
            with step("confirm"):
                check_contradiction(adjusted.refined)
                check_near_poles(adjusted.poles, adjusted.refined)
                unconfirmed = list(confirm_links(site, scans, adjusted, pairs))
        except Refusal as refusal:
            return state_refusal(site, scans, pairs, groups, refusal, blunders, seconds)
        with step("state"):
            unusable = list_unusable(site, scans)
            found = [*unusable, *adjusted.datum.unmet, *blunders, *unchecked, *unconfirmed]
            return state_answer(site, scans, pairs, groups, adjusted, found, seconds)


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


def state_answer(
    site: Site,
    scans: SiteScans,
    pairs: Sequence[Pair],
    groups: Sequence[Sequence[int]],
    adjusted: Adjusted,
    found: Sequence[Reason],
    seconds: dict[str, float],
) -> SiteCalibration:
    """State the answer: all poses in the frames of the clouds, and everything that was checked."""
    end = adjusted.end
    poses, covariance = poses_in_clouds(end.T, adjusted.covariance, scans.origins)
    lidars = tuple(_lidar_pose(site, adjusted, i, T, covariance) for i, T in enumerate(poses))
    loops = tuple(close_loops(adjusted.solved, end))
    every = (*found, *weaknesses(site, scans, adjusted, loops, lidars))
    reasons, notes = warnings_and_notes(every)
    return SiteCalibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        site=site,
        datum=adjusted.datum.words,
        scans=scans.in_clouds,
        lidars=lidars,
        covariance=covariance,
        groups=tuple(tuple(group) for group in groups),
        poles=_site_poles(site, adjusted),
        pairs=tuple(_pair_check(pair, adjusted) for pair in pairs),
        loops=loops,
        tests=adjusted.tests,
        without=tuple(without_placements(adjusted.network, end, len(site.placements))),
        seconds=seconds,
        notes=notes,
    )


def state_refusal(
    site: Site,
    scans: SiteScans,
    pairs: Sequence[Pair],
    groups: Sequence[Sequence[int]],
    refusal: Refusal,
    blunders: Sequence[Reason],
    seconds: dict[str, float],
) -> SiteCalibration:
    """State a refusal, with all that was found before it."""
    reason = Reason(refusal.code, refusal.message, refusal.values)
    return SiteCalibration(
        status="refused",
        reasons=(reason, *list_unusable(site, scans, refusal), *blunders),
        site=site,
        datum="",
        scans=scans.in_clouds,
        lidars=(),
        covariance=None,
        groups=tuple(tuple(group) for group in groups),
        poles=(),
        pairs=tuple(_pair_check(pair, None) for pair in pairs),
        loops=(),
        tests=(),
        without=(),
        seconds=seconds,
    )


def list_unusable(site: Site, scans: SiteScans, told: Refusal | None = None) -> Iterator[Reason]:
    """Say which recordings could not be used, but for the one whose fault is `told`."""
    for (lidar, placement), refusal in scans.faults:
        if told is not None and refusal.message == told.message:
            continue
        name, where = site.lidars[lidar].name, site.placements[placement]
        yield Reason(
            "recording_unusable",
            f"{name} in placement {where}: {refusal.message}",
            {"lidar": name, "placement": where, "code": refusal.code},
        )


def _lidar_pose(
    site: Site, adjusted: Adjusted, lidar: int, T: Array, covariance: Array
) -> LidarPose:
    own = slice(POSE * lidar, POSE * (lidar + 1))
    block = covariance[own, own]
    names = [each.name for each in site.lidars]
    return LidarPose(
        lidar,
        T,
        block,
        budget_of(adjusted.parts, lidar, names),
        predicted_error(block),
        fitness_of(site, block),
    )


def _site_poles(site: Site, adjusted: Adjusted) -> tuple[SitePole, ...]:
    axes = axes_of(adjusted.solved)
    return tuple(
        SitePole(
            pole.name(site),
            pole.placement,
            point := axis.nearest(pole.extent.mean(axis=0)),
            axis.direction,
            pole.length,
            tuple(sorted(pole.seen)),
            pole.surveyed,
            axis.sigma_at(point),
            axis.direction_sigma,
        )
        for pole, axis in zip(adjusted.datum.poles, axes, strict=True)
    )


def _pair_check(pair: Pair, adjusted: Adjusted | None) -> PairCheck:
    """Say how two LiDARs agree: by the tests of the poles that both see."""
    poles = [] if adjusted is None else adjusted.datum.poles
    shared = {k for k, pole in enumerate(poles) if set(pair.lidars) <= pole.seen.keys()}
    tests = () if adjusted is None else adjusted.tests
    terms = () if adjusted is None else adjusted.end.scene
    return PairCheck(
        pair.lidars,
        len(shared),
        len(pair.standing),
        sum(len(term.weighed.weights) for term in terms if term.lidars == pair.lidars),
        max((test.w for test in tests if test.pole in shared), default=None),
        pair.refusal,
    )
