"""Where the frame of a site is: aligned with what was surveyed, levelled, or that of a LiDAR.

Surveyed poles are matched to those that the LiDARs see as the poles of one more LiDAR would be;
control points are known by name.

Where the surroundings alone give a part of a link, the poses beyond it are fixed there while only
poles are adjusted; in the end the scene must determine them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..alignment.adjustment import SURROUNDINGS_SIGMA
from ..alignment.survey import ControlPoint, MeasuredUp, PriorPose, SeenPoint, Surveyed, SurveyedEnd
from ..base import se3
from ..base.datatypes import Array, BoolArray
from ..base.description import Site
from ..base.errors import Reason, Refusal
from ..base.quantities import counted
from ..base.se3 import joint_of, relative
from ..hypotheses.by_place import LEAN_ANOTHER, check_constrained_by_scene
from ..hypotheses.joint_choice import linked_groups
from ..hypotheses.pairs import Pair
from .shared import SharedPole
from .survey import Fit, align_to_survey, list_unmet, pole_at, transformed

SIDE = "side on which poles were surveyed"
"""An error that all ends surveyed on surfaces share, 1 σ radius / √2 in each direction: whoever
measures them from one place, or always puts the rod on the same side, is off by the radius. Each
end has another, 1 σ radius: √2 more than if each were on a side by chance, as both ends of a pole
may be on one. So none of these habits makes a stated error too small."""


@dataclass(frozen=True, eq=False)
class Dependent:
    """LiDARs that depend on one pole which one of them shares with one of the others.

    Attributes
    ----------
    near, far
        Indices of the two LiDARs of the link: of the others, and of the dependent ones.
    T
        (4, 4) maps points of `far` into the frame of `near`: the pose that the surroundings gave.
    lidars
        Indices of all that depend on the link, `far` among them.
    """

    near: int
    far: int
    T: Array
    lidars: frozenset[int]

    def across(self, poles: Sequence[SharedPole]) -> list[int]:
        """Indices of the poles that LiDARs of both sides see."""
        return [
            k
            for k, pole in enumerate(poles)
            if self.lidars & pole.seen.keys() and pole.seen.keys() - self.lidars
        ]

    def split_across(self, poles: Sequence[SharedPole]) -> list[SharedPole]:
        """The same poles, those across as one on each side: then they do not constrain the link."""
        own, others = list(poles), []
        for k in self.across(poles):
            seen = poles[k].seen
            here = {i: pole for i, pole in seen.items() if i not in self.lidars}
            there = {i: pole for i, pole in seen.items() if i in self.lidars}
            own[k] = replace(poles[k], seen=here)
            others.append(replace(poles[k], seen=there, surveyed=None))
        return own + others

    def covariance(self, T: Array, covariance: Array) -> Array:
        """(6, 6) of the pose between the two LiDARs, by poses (L, 4, 4) and (6 L, 6 L) of all."""
        joint = joint_of(covariance, self.near, self.far)
        return relative(T[self.near], T[self.far], joint).covariance

    def names(self, site: Site) -> str:
        """What the two LiDARs of the link are called."""
        return f"{site.lidars[self.near].name} and {site.lidars[self.far].name}"


def find_dependent(pairs: Sequence[Pair], poses: Mapping[int, Array]) -> tuple[Dependent, ...]:
    """Find the links by surroundings that join what poles alone do not; none where these join all.

    Parameters
    ----------
    pairs
        All pairs.
    poses
        From the index of a LiDAR to its chosen pose (4, 4), in any common frame.
    """
    links = [pair for pair in pairs if pair.by_place and set(pair.lidars) <= poses.keys()]
    if not links:
        return ()
    by_poles = linked_groups(1 + max(poses), [pair for pair in pairs if not pair.by_place])
    part_of = {i: frozenset(part) for part in by_poles for i in part}
    links.sort(key=lambda pair: -pair.hypotheses[0].score)
    reached = set(part_of[min(poses)])
    tree: list[tuple[int, int]] = []
    while link := next((each for each in links if len(reached & set(each.lidars)) == 1), None):
        near, far = sorted(link.lidars, key=lambda i: i not in reached)
        tree.append((near, far))
        reached |= part_of[far]
    dependent: list[Dependent] = []
    for near, far in reversed(tree):
        beyond = [each.lidars for each in dependent if each.near in part_of[far]]
        own = part_of[far].union(*beyond)
        dependent.append(Dependent(near, far, se3.inverse(poses[near]) @ poses[far], own))
    return tuple(reversed(dependent))


def orient_links(
    dependent: Sequence[Dependent], anchor: int, all_: frozenset[int]
) -> Iterator[Dependent]:
    """Orient each link: the side that the frame is not aligned with depends on it.

    Parameters
    ----------
    dependent
        By `find_dependent`.
    anchor
        The LiDAR that the frame of the site is aligned with.
    all_
        All LiDARs that have a pose.
    """
    for each in dependent:
        if anchor in each.lidars:
            yield Dependent(each.far, each.near, se3.inverse(each.T), all_ - each.lidars)
        else:
            yield each


def prior_poses(
    dependent: Sequence[Dependent], poses: Mapping[int, Array]
) -> tuple[PriorPose, ...]:
    """Give each dependent LiDAR the pose from its surroundings as a prior, as wide as assumed.

    Parameters
    ----------
    dependent
        The LiDARs that depend on one pole, away from the one that defines the frame.
    poses
        From the index of a LiDAR to its pose (4, 4), in the frame of the site.
    """
    return tuple(
        PriorPose("the place", each.far, poses[each.near] @ each.T, SURROUNDINGS_SIGMA)
        for each in dependent
    )


def check_poles_left(
    site: Site, dependent: Sequence[Dependent], poles: Sequence[SharedPole]
) -> None:
    """Refuse if the pole that a link depends on is gone: surroundings alone are not a calibration.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    for each in dependent:
        if not each.across(poles):
            raise Refusal(
                "degenerate_poles",
                f"no pole that fits is left which links {each.names(site)}; {LEAN_ANOTHER}",
                {"lidar": site.lidars[each.far].name},
            )


def check_dependent(
    site: Site, dependent: Sequence[Dependent], T: Array, covariance: Array
) -> None:
    """Refuse dependent LiDARs that the scene constrains little better than their prior does.

    Parameters
    ----------
    site, dependent
        Names, and the dependent LiDARs.
    T, covariance
        (L, 4, 4) poses and (6 L, 6 L) their joint covariance.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    for each in dependent:
        check_constrained_by_scene(each.covariance(T, covariance), each.names(site))


@dataclass(frozen=True, eq=False)
class Datum:
    """The frame of a site, and what is known in it.

    Attributes
    ----------
    poses
        From the index of a LiDAR to its pose (4, 4) in that frame, about its beam origin.
    poles
        The shared poles in that frame, those that were surveyed marked.
    surveyed
        What the survey gives for them.
    free
        (6 L,) which parameters of the poses are estimated.
    text
        What fixes the frame.
    unmet
        What was surveyed and matches nothing that the LiDARs see.
    dependent
        What depends on a link that the surroundings give in part, seen from what defines the
        frame.
    """

    poses: dict[int, Array]
    poles: list[SharedPole]
    surveyed: Surveyed
    free: BoolArray
    text: str
    unmet: tuple[Reason, ...] = ()
    dependent: tuple[Dependent, ...] = ()


def find_datum(
    site: Site,
    origins: Array,
    poses: dict[int, Array],
    poles: Sequence[SharedPole],
    dependent: Sequence[Dependent] = (),
) -> Datum:
    """Lay the frame of the site on what was surveyed; without, level it, or leave it a LiDAR's.

    Parameters
    ----------
    site
        With what was surveyed.
    origins
        (L, 3) where the beams of each LiDAR start in its frame.
    poses, poles
        In the frame of the first of the linked LiDARs.
    dependent
        By `find_dependent`: poses partly from the surroundings get a prior (`Surveyed.poses`).

    Raises
    ------
    Refusal
        ``survey_unmatched`` if no surveyed point fits the recordings, ``survey_ambiguous`` if the
        survey fits in several ways, ``survey_contradicts`` if parts of the survey fit in different
        ways.
    """
    count = len(site.lidars)
    free = np.zeros((count, 6), dtype=bool)
    free[list(poses)] = True
    up = tuple(
        MeasuredUp(f"up of {lidar.name}", i, lidar.up.direction, lidar.up.sigma)
        for i, lidar in enumerate(site.lidars)
        if lidar.up is not None and i in poses
    )
    if site.poles or site.points:
        fit = align_to_survey(site, origins, poses, poles)
        T = fit.T
        moved = {i: T @ pose for i, pose in poses.items()}
        found = [transformed(pole, T) for pole in poles]
        marked = [_marked(pole, site) for pole in found]
        marked = [each for each in marked if len(each.seen) > 1 or each.surveyed is not None]
        surveyed = replace(_known(site, origins, marked, moved, fit), up=up)
        off = tuple(
            orient_links(dependent, _most_surveyed(marked, surveyed, moved), frozenset(moved))
        )
        surveyed = replace(surveyed, poses=prior_poses(off, moved))
        what = " and ".join(_counts(surveyed))
        text = f"{site.frame.name}, by {what}"
        unmet = tuple(list_unmet(site, origins, poses, poles, fit))
        return Datum(moved, marked, surveyed, free.reshape(-1), text, unmet, off)
    reference = site.reference if site.reference in poses else next(iter(poses))
    name = site.lidars[reference].name
    kept = [pole for pole in poles if len(pole.seen) > 1]
    if up:
        level = _levelling(up, poses)
        T = se3.from_rt(level, np.zeros(3)) @ se3.inverse(_unturned(poses[reference]))
        # Turning about the vertical and shifts are nobody's to say: they are the reference's.
        free[reference] = [True, True, False, False, False, False]
        text = f"origin and heading of {name}, vertical by {counted(len(up), 'inertial sensor')}"
    else:
        T = se3.inverse(poses[reference])
        # Where its beams start in its frame is where they start in the site's.
        T = se3.from_rt(np.eye(3), origins[reference]) @ T
        free[reference] = False
        text = of_lidar(name)
    moved = {i: T @ pose for i, pose in poses.items()}
    off = tuple(orient_links(dependent, reference, frozenset(moved)))
    return Datum(
        moved,
        [transformed(pole, T) for pole in kept],
        Surveyed(up=up, poses=prior_poses(off, moved)),
        free.reshape(-1),
        text,
        dependent=off,
    )


def of_lidar(name: str) -> str:
    """Say that the frame of a site is that of a LiDAR."""
    return f"frame of {name}; nothing was surveyed"


def _most_surveyed(poles: Sequence[SharedPole], surveyed: Surveyed, poses: dict[int, Array]) -> int:
    """The LiDAR that sees most of what was surveyed: what it sees does not depend on the others."""
    counts = dict.fromkeys(poses, 0)
    for end in surveyed.ends:
        for i in poles[end.axis].seen:
            counts[i] += 1
    for sight in surveyed.seen:
        counts[sight.lidar] += 1
    return max(counts, key=lambda i: counts[i])


def _unturned(T: Array) -> Array:
    return se3.from_rt(np.eye(3), T[:3, 3])


def _levelling(up: Sequence[MeasuredUp], poses: dict[int, Array]) -> Array:
    """(3, 3) shortest rotation that turns the mean up of the LiDARs upright."""
    mean = np.sum([poses[each.lidar][:3, :3] @ each.direction for each in up], axis=0)
    mean /= np.linalg.norm(mean)
    axis = np.cross(mean, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3) if mean[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.exp_so3(axis / sine * np.arctan2(sine, mean[2]))


def _marked(pole: SharedPole, site: Site) -> SharedPole:
    for k, each in enumerate(site.poles):
        if pole_at(each, [pole]) is not None:
            return replace(pole, surveyed=k)
    return pole


def _known(
    site: Site,
    origins: Array,
    poles: Sequence[SharedPole],
    poses: dict[int, Array],
    fit: Fit,
) -> Surveyed:
    """Write what was surveyed and is matched as observations of axes and points."""
    ends = []
    for k, pole in enumerate(poles):
        if pole.surveyed is None:
            continue
        each = site.poles[pole.surveyed]
        spread = site.radius if each.on == "surface" else 0.0
        for name, end, sigma in each.ends:
            ends.append(SurveyedEnd(f"{name} of {each.name}", k, end, sigma, spread))
    known, seen = [], []
    for q, point in enumerate(site.points):
        sights = [sight for k, sight in enumerate(point.seen) if (q, k) in fit.sightings]
        if not sights:
            continue
        sigmas = np.full(3, point.sigma) if point.sigmas is None else point.sigmas
        known.append(ControlPoint(point.name, point.at, sigmas))
        for sight in sights:
            name = f"{point.name} as {site.lidars[sight.lidar].name} sees it"
            at = sight.at - origins[sight.lidar]
            seen.append(SeenPoint(name, sight.lidar, len(known) - 1, at, sight.sigma))
    if any(end.spread for end in ends):
        ends = [replace(end, side=len(known)) if end.spread else end for end in ends]
        known.append(ControlPoint(SIDE, np.zeros(3), site.radius / np.sqrt(2.0), is_side=True))
    return Surveyed(tuple(ends), tuple(known), tuple(seen))


def _counts(surveyed: Surveyed) -> Iterator[str]:
    if surveyed.ends:
        yield f"{counted(len(surveyed.ends), 'surveyed end')} of poles"
    points = sum(not point.is_side for point in surveyed.known)
    if points:
        yield counted(points, "control point")


def without_poles(datum: Datum, gone: set[int]) -> Datum:
    """Leave out some poles, and their surveyed ends."""
    kept = [k for k in range(len(datum.poles)) if k not in gone]
    ends = tuple(
        replace(end, axis=kept.index(end.axis))
        for end in datum.surveyed.ends
        if end.axis not in gone
    )
    return replace(
        datum,
        poles=[datum.poles[k] for k in kept],
        surveyed=replace(datum.surveyed, ends=ends),
    )


def without_survey(surveyed: Surveyed, name: str) -> Surveyed:
    """Leave out one surveyed end or control point, by name."""
    if any(each.name == name for each in surveyed.known):
        number = next(q for q, each in enumerate(surveyed.known) if each.name == name)
        seen = tuple(
            replace(each, point=each.point - (each.point > number))
            for each in surveyed.seen
            if each.point != number
        )
        known = tuple(each for each in surveyed.known if each.name != name)
        ends = tuple(
            each if each.side is None else replace(each, side=each.side - 1)
            for each in surveyed.ends
        )
        return replace(surveyed, ends=ends, known=known, seen=seen)
    return replace(
        surveyed,
        ends=tuple(each for each in surveyed.ends if each.name != name),
        seen=tuple(each for each in surveyed.seen if each.name != name),
        up=tuple(each for each in surveyed.up if each.name != name),
    )
