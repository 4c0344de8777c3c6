"""What hangs on a link that the place gives a part of: its pose is held there as far as the poles
are asked, and must be held by the scene in the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ..alignment.adjustment import PLACE_SIGMA
from ..alignment.survey import KnownPose
from ..base import se3
from ..base.datatypes import Array
from ..base.description import Site
from ..base.errors import Refusal
from ..base.se3 import joint_of, relative
from ..hypotheses.by_place import LEAN_ANOTHER, check_held_by_scene
from ..hypotheses.joint_choice import linked_groups
from ..hypotheses.pairs import Pair
from .shared import SharedPole


@dataclass(frozen=True, eq=False)
class Hanging:
    """LiDARs that hang on one pole which one of them shares with one of the others.

    Attributes
    ----------
    near, far
        Indices of the two LiDARs of the link: of the others, and of those that hang.
    T
        (4, 4) maps points of `far` into the frame of `near`: the pose that the place gave.
    lidars
        Indices of all that hang on the link, `far` among them.
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

    def parted(self, poles: Sequence[SharedPole]) -> list[SharedPole]:
        """The same poles, those across as one on each side: then they tell nothing of the link."""
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


def find_hanging(pairs: Sequence[Pair], poses: Mapping[int, Array]) -> tuple[Hanging, ...]:
    """Find the links by place that join what poles alone do not; none where these join all.

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
    hanging: list[Hanging] = []
    for near, far in reversed(tree):
        beyond = [each.lidars for each in hanging if each.near in part_of[far]]
        own = part_of[far].union(*beyond)
        hanging.append(Hanging(near, far, se3.inverse(poses[near]) @ poses[far], own))
    return tuple(reversed(hanging))


def hanging_off(hanging: Sequence[Hanging], anchor: int, all_: frozenset[int]) -> Iterator[Hanging]:
    """Say of each link which side hangs on it: the one that the frame is not laid on.

    Parameters
    ----------
    hanging
        By `find_hanging`.
    anchor
        The LiDAR that the frame of the site is laid on.
    all_
        All LiDARs that have a pose.
    """
    for each in hanging:
        if anchor in each.lidars:
            yield Hanging(each.far, each.near, se3.inverse(each.T), all_ - each.lidars)
        else:
            yield each


def known_poses(hanging: Sequence[Hanging], poses: Mapping[int, Array]) -> tuple[KnownPose, ...]:
    """Hold what hangs where the place puts it, as wide as that is taken to be known.

    Parameters
    ----------
    hanging
        What hangs, off the LiDAR that the frame is laid on.
    poses
        From the index of a LiDAR to its pose (4, 4), in the frame of the site.
    """
    return tuple(
        KnownPose("the place", each.far, poses[each.near] @ each.T, PLACE_SIGMA) for each in hanging
    )


def check_poles_left(site: Site, hanging: Sequence[Hanging], poles: Sequence[SharedPole]) -> None:
    """Refuse where the pole that a link hangs on is gone: the place alone is no calibration.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    for each in hanging:
        if not each.across(poles):
            raise Refusal(
                "degenerate_poles",
                f"no pole that fits is left which links {each.names(site)}; {LEAN_ANOTHER}",
                {"lidar": site.lidars[each.far].name},
            )


def check_hanging(site: Site, hanging: Sequence[Hanging], T: Array, covariance: Array) -> None:
    """Refuse what hangs where the scene holds it little better than the place was taken to.

    Parameters
    ----------
    site, hanging
        Names, and what hangs.
    T, covariance
        (L, 4, 4) poses and (6 L, 6 L) their joint covariance.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    for each in hanging:
        check_held_by_scene(each.covariance(T, covariance), each.names(site))
