"""The answer of two LiDARs or of a site, or why there is none, with everything that was checked."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs

from ..adjustment.agreement import agreement_tests
from ..adjustment.answer import LidarPose, PairCheck, SiteCalibration, SitePole
from ..adjustment.closures import close_loops
from ..adjustment.refinement import Refinement
from ..adjustment.site import Adjusted, adjusted_of_two
from ..adjustment.solved import axes_of, without_placements
from ..alignment.adjustment import BeamAlignment
from ..alignment.certainty import SIDES, Part, budget_of
from ..alignment.origins import BeamOrigins
from ..alignment.unknowns import POSE
from ..base.datatypes import Array, Calibration, Hypothesis, Placement, Test
from ..base.description import Site, SiteLidar
from ..base.errors import Reason, Refusal, warnings_and_notes
from ..base.uncertainty import predicted_error, weakest_direction
from ..base.uncertainty.confirmation import Confirmation
from ..hypotheses.choice import margin_of
from ..hypotheses.pairs import Pair
from ..hypotheses.placements import PairedPlacement, has_no_poles
from ..hypotheses.scans import SiteScans, poses_in_clouds
from . import weaknesses
from .site import fitness_of, poor_fit
from .site import weaknesses as weaknesses_of_site

NAMED = re.compile(r"(?<![-\w])(the )?(?P<side>target|source)( LiDAR)?(?![-\w])")
"""What a reason calls the LiDARs of a pair."""


@dataclass(frozen=True, eq=False)
class Answered:
    """A calibration of two LiDARs, and what it is based on unless it is refused."""

    calibration: Calibration
    paired: Sequence[PairedPlacement] = ()
    aligned: BeamAlignment | None = None
    refined: Refinement | None = None


def state_answer(
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
    without_poles = has_no_poles(paired)
    weakest = weakest_direction(
        pose.T_target_source, pose.covariance, aligned.axis_points, aligned.axis_directions
    )
    found = weaknesses(paired, hypotheses, aligned, weakest, refined, confirmation)
    tests, misfit = _tested(paired, aligned, refined)
    found += misfit
    reasons, notes = warnings_and_notes(found)
    return Calibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        T_target_source=pose.T_target_source,
        covariance=pose.covariance,
        poles=None if without_poles else aligned.pose,
        refined=None if refined is None else refined.pose,
        hypotheses=hypotheses,
        margin=margin_of(hypotheses),
        predicted_error=predicted_error(pose.covariance),
        weakest=weakest,
        placements=placements,
        seconds=seconds,
        uncertainty=aligned.uncertainty if refined is None else refined.uncertainty,
        radius=None if without_poles else aligned.radius,
        confirmation=confirmation,
        notes=notes,
        tests=tests,
    )


def _tested(
    paired: Sequence[PairedPlacement], aligned: BeamAlignment, refined: Refinement | None
) -> tuple[tuple[Test, ...], list[Reason]]:
    """Test a pair as a site is tested, and report what does not fit."""
    if aligned.joint is None:
        return (), []
    lidars = tuple(SiteLidar(name, ()) for name in SIDES)
    site = Site("pair", lidars, tuple(str(k) for k, _ in enumerate(paired, 1)))
    tested = adjusted_of_two(site, paired, range(len(paired)), aligned, refined)
    pairs = [pair for each in paired for pair in each.hypothesis.match.pairs]
    called = {
        pole.name(site): f"T{i}–S{j}" + f" of placement {pole.placement + 1}" * (len(paired) > 1)
        for pole, (i, j) in zip(tested.datum.poles, pairs, strict=True)
    }
    tests = tuple(replace(test, name=_called(test, called)) for test in tested.tests)
    misfit = list(poor_fit(site, replace(tested, tests=tests), of_two=True))
    return (*tests, *agreement_tests(aligned, refined)), misfit


def _called(test: Test, poles: Mapping[str, str]) -> str:
    """Name what is tested, a pole as the other tables of a pair do."""
    name, sees, seer = test.name.partition(" as ")
    return poles.get(name, name) + sees + seer


def state_refusal(
    refusal: Refusal,
    placements: tuple[Placement, ...],
    hypotheses: tuple[Hypothesis, ...],
    seconds: Mapping[str, float],
    confirmation: Confirmation | None = None,
) -> Calibration:
    """State a refusal, with all that was found before it."""
    return Calibration(
        status="refused",
        reasons=(refusal.reason,),
        hypotheses=hypotheses,
        margin=margin_of(hypotheses),
        placements=placements,
        seconds=seconds,
        confirmation=confirmation,
    )


def advising_no_poles(refused: Calibration, without_poles: Calibration) -> Calibration:
    """Advise to calibrate without poles, which no intensity shows, if that gives an answer."""
    if without_poles.T_target_source is None:
        return refused
    first, *others = refused.reasons
    said = f"{first.message}; or calibrate without poles: --poles 0 gives an answer here"
    return replace(refused, reasons=(replace(first, message=said), *others))


def state_site_answer(
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
    lidars = lidar_poses(site, adjusted.parts, poses, covariance)
    loops = tuple(close_loops(adjusted.solved, end))
    every = (*found, *weaknesses_of_site(site, scans, adjusted, loops, lidars))
    reasons, notes = warnings_and_notes(every)
    return SiteCalibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        site=site,
        datum=adjusted.datum.text,
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


def state_answer_of_two(
    site: Site,
    scans: SiteScans,
    numbers: Sequence[int],
    answered: Answered,
    seconds: dict[str, float],
) -> SiteCalibration:
    """State the answer of a site of two LiDARs that nothing but each other ties: that of a pair.

    Parameters
    ----------
    site, scans
        The second LiDAR's pose is found in the frame of the first.
    numbers
        Index of each placement that was used.
    answered
        About the LiDARs' beam origins.
    seconds
        Time of each step.
    """
    found = BeamOrigins(*scans.origins).moved_back(answered.calibration)
    names = [lidar.name for lidar in site.lidars]
    # The tests are made again, with the site's names for its placements.
    reasons = [named(each, names) for each in found.reasons if each.code != "misfit"]
    unusable = list(list_unusable(site, scans))
    rows = [list(row) for row in scans.in_clouds]
    for p, placement in zip(numbers, found.placements, strict=True):
        rows[0][p], rows[1][p] = placement.scans
    standing = sum(each.stands for each in found.hypotheses)
    refusal = reasons[0] if found.T_target_source is None else None
    check = PairCheck((0, 1), 0, standing, 0, None, refusal)
    answer = SiteCalibration(
        status="refused",
        reasons=(*reasons, *unusable),
        site=site,
        scans=tuple(map(tuple, rows)),
        groups=((0, 1),) if found.hypotheses else ((0,), (1,)),
        pairs=(check,),
        seconds=seconds,
        notes=tuple(named(note, names) for note in found.notes),
    )
    if found.T_target_source is None:
        return answer
    assert found.covariance is not None
    assert found.uncertainty is not None
    assert answered.aligned is not None
    refined = answered.refined
    tested = adjusted_of_two(site, answered.paired, numbers, answered.aligned, refined)
    reasons += poor_fit(site, tested, of_two=True)
    covariance = np.zeros((2 * POSE, 2 * POSE))
    covariance[POSE:, POSE:] = found.covariance
    budget = tuple(
        structs.replace(
            entry, name=f"{entry.name} of {names[SIDES.index(entry.sensor)]}", sensor=None
        )
        if entry.sensor is not None
        else entry
        for entry in found.uncertainty.budget
    )
    own = covariance[:POSE, :POSE]
    first = LidarPose(0, np.eye(4), own, (), predicted_error(own), fitness_of(site, own))
    second = LidarPose(
        1,
        found.T_target_source,
        found.covariance,
        budget,
        found.predicted_error,
        found.fitness or fitness_of(site, found.covariance),
    )
    poles = _site_poles(site, tested)
    moved = [structs.replace(pole, point=pole.point + scans.origins[0]) for pole in poles]
    check = replace(
        check,
        shared_poles=len(poles),
        patches=0 if refined is None else refined.patches,
        w=max((test.w for test in tested.tests if test.pole is not None), default=None),
    )
    return replace(
        answer,
        status="warn" if reasons or unusable else "ok",
        reasons=(*reasons, *unusable),
        datum=tested.datum.text,
        lidars=(first, second),
        covariance=covariance,
        poles=tuple(moved),
        pairs=(check,),
        tests=(*tested.tests, *agreement_tests(answered.aligned, refined)),
        without=tuple(without_placements(tested.network, tested.end, len(site.placements))),
    )


def named(reason: Reason, names: Sequence[str]) -> Reason:
    """Call the LiDARs of a reason by their names in the site, where it has target and source."""
    of_side: dict[str, str] = dict(zip(SIDES, names, strict=True))

    def name(found: re.Match[str]) -> str:
        return of_side[found["side"]]

    values = {key: of_side.get(str(value), value) for key, value in reason.values.items()}
    return Reason(reason.code, NAMED.sub(name, reason.message), values)


def exchanged(answer: SiteCalibration, site: Site) -> SiteCalibration:
    """Give the answer of a site whose two LiDARs came in the other order."""
    order = np.r_[POSE : 2 * POSE, :POSE]
    covariance = answer.covariance
    return replace(
        answer,
        site=site,
        scans=answer.scans[::-1],
        lidars=tuple(replace(each, lidar=1 - each.lidar) for each in answer.lidars[::-1]),
        covariance=None if covariance is None else covariance[np.ix_(order, order)],
        tests=tuple(
            each if each.lidar is None else replace(each, lidar=1 - each.lidar)
            for each in answer.tests
        ),
        without=tuple(
            each if each.lidar is None else structs.replace(each, lidar=1 - each.lidar)
            for each in answer.without
        ),
    )


def state_site_refusal(
    site: Site,
    scans: SiteScans,
    pairs: Sequence[Pair],
    groups: Sequence[Sequence[int]],
    refusal: Refusal,
    blunders: Sequence[Reason],
    seconds: dict[str, float],
) -> SiteCalibration:
    """State a refusal, with all that was found before it."""
    return SiteCalibration(
        status="refused",
        reasons=(refusal.reason, *list_unusable(site, scans, refusal), *blunders),
        site=site,
        scans=scans.in_clouds,
        groups=tuple(tuple(group) for group in groups),
        pairs=tuple(_pair_check(pair, None) for pair in pairs),
        seconds=seconds,
    )


def list_unusable(site: Site, scans: SiteScans, known: Refusal | None = None) -> Iterator[Reason]:
    """Report the recordings that could not be used, except for the one whose fault is `known`."""
    for (lidar, placement), refusal in scans.faults:
        if known is not None and refusal.message == known.message:
            continue
        name, where = site.lidars[lidar].name, site.placements[placement]
        yield Reason(
            "recording_unusable",
            f"{name} in placement {where}: {refusal.message}",
            {"lidar": name, "placement": where, "code": refusal.code},
        )


def lidar_poses(
    site: Site, parts: Sequence[Part], poses: Array, covariance: Array
) -> tuple[LidarPose, ...]:
    """State the pose of each LiDAR, (L, 4, 4), with what it is certain to and why.

    Parameters
    ----------
    site
        For names, and how accurate they must be.
    parts
        Every source of error.
    poses, covariance
        As `SiteCalibration` has them.
    """
    each = enumerate(poses)
    return tuple(_lidar_pose(site, parts, lidar, T, covariance) for lidar, T in each)


def _lidar_pose(
    site: Site, parts: Sequence[Part], lidar: int, T: Array, covariance: Array
) -> LidarPose:
    own = slice(POSE * lidar, POSE * (lidar + 1))
    block = covariance[own, own]
    names = [each.name for each in site.lidars]
    return LidarPose(
        lidar,
        T,
        block,
        budget_of(parts, lidar, names),
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
    """Summarise the agreement of two LiDARs: by the tests of the poles that both see."""
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
