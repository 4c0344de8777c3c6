"""Consistent hypotheses of all pairs: the poses with which most observations agree.

What one pair of LiDARs cannot decide, others may: around a loop the poses of the pairs must
compose to the identity, and a third LiDAR with poles in common with both constrains them. Poses
are given to one LiDAR after the other, each from a hypothesis of a pair with one that has its pose
already; if a pose agrees with a hypothesis of a pair, the poles that agree under it are counted.
The choice with the largest count is found by branch and bound, and with it every other one with
the same count: then the data do not decide.

Before that it is checked whether the LiDARs are linked at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Hypothesis
from ..base.description import Site
from ..base.errors import Refusal
from .pairs import Pair, is_same_pose
from .placements import AGREE_ANGLE
from .scans import SiteScans

WITHOUT_SCENE = 0.25
"""Weight of the poles of a pair whose scenes do not overlap: the same shape may be chance,
but the more poles, the less likely that is."""

UNLIKELY = 0.6
"""A hypothesis that fits the scene less well than the best, but is not ruled out, has
this part of the count: a loop that closes with two of them is more than one that does not close."""

EQUAL = 0.02
"""Choices whose counts differ by less are equally good: it is less than the count of any pole."""

ELSEWHERE = 2.0
"""A LiDAR has another pose in another choice if it differs by more than this many times the
uncertainty of the poles: from two LiDARs that see it poorly, its pose may result twice, one on
each side of the right one."""

MOST_STEPS = 60_000
"""Maximum number of steps of the search: cranes and posts with 12 LiDARs took 26,000 and 50,000."""

MOST_RIVALS = 8
"""Number of equally good choices that suffice to show where they differ."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Consistent poses of some LiDARs.

    Attributes
    ----------
    poses
        From index of the LiDAR to (4, 4), in the frame of the first.
    count
        Amount of observations that agree with them.
    """

    poses: dict[int, Array]
    count: float


@dataclass(frozen=True, eq=False)
class Choices:
    """The choices for one group of linked LiDARs, the best first.

    Attributes
    ----------
    best
        The one with the largest count, and of those the largest score of the scene.
    rivals
        Others with the same count, in which at least one LiDAR has another pose.
    complete
        Whether the search was completed.
    """

    best: Choice
    rivals: tuple[Choice, ...]
    complete: bool


def linked_groups(count: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Sort LiDARs into groups that hypotheses of pairs link, the largest first."""
    label = list(range(count))
    for pair in pairs:
        if pair.hypotheses:
            a, b = (label[k] for k in pair.lidars)
            label = [a if each == b else each for each in label]
    groups = [[i for i in range(count) if label[i] == one] for one in sorted(set(label))]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def choose_poses(
    group: Sequence[int], pairs: Sequence[Pair], poles: Sequence[Array], first: int
) -> Choices:
    """Choose the poses of a linked group of LiDARs.

    Parameters
    ----------
    group
        Indices of the LiDARs.
    pairs
        All pairs.
    poles
        For each LiDAR of the site, (N, 3) points on the poles that it sees, in its frame.
    first
        The LiDAR in whose frame the poses are.
    """
    linked = [each for each in pairs if each.hypotheses and set(each.lidars) <= set(group)]
    most: dict[tuple[int, int], float] = {}
    between: dict[tuple[int, int], list[Array]] = {}
    for pair in linked:
        i, j = pair.lidars
        most[i, j] = most[j, i] = most_of(pair)
        between[i, j] = [each.T for each in pair.possible]
        between[j, i] = [se3.inverse(T) for T in between[i, j]]
    search = _Search({each.lidars: each for each in linked}, poles, most, between)
    search.run(Choice({first: np.eye(4)}, 0.0), [i for i in group if i != first], [])
    found = sorted(search.found, key=lambda each: (-each.count, -_scene_score(each, search)))
    best, *others = found
    rivals = [
        each for each in others if each.count > best.count - EQUAL and _differs(each, best, poles)
    ]
    return Choices(best, tuple(rivals), search.steps < MOST_STEPS)


@dataclass(eq=False)
class _Search:
    """Branch and bound over the poses of one LiDAR after the other.

    `most` is the largest value of two LiDARs, `between` their possible poses, of points of the
    second in the frame of the first; both for either order. The same poses result in thousands of
    ways: `via`, `same` and `gains` store by identity the results for them, which `via` and the
    choice that the search starts from keep alive. `known` has one of each set of equal poses of a
    LiDAR, `numbers` the number of that set for each pose, and `reached` the count of the LiDARs
    when their poses were last the same: a branch that arrives there with no larger count finds
    nothing new. `still` has the largest count that LiDARs without a pose can add.
    """

    pairs: dict[tuple[int, int], Pair]
    poles: Sequence[Array]
    most: dict[tuple[int, int], float]
    between: dict[tuple[int, int], list[Array]]
    via: dict[tuple[int, int], list[Array]] = field(default_factory=dict)
    same: dict[tuple[int, int], bool] = field(default_factory=dict)
    gains: dict[tuple[int, int], float] = field(default_factory=dict)
    known: dict[int, Array] = field(default_factory=dict)
    numbers: dict[int, int] = field(default_factory=dict)
    reached: dict[frozenset[tuple[int, int]], float] = field(default_factory=dict)
    still: dict[frozenset[int], float] = field(default_factory=dict)
    steps: int = 0
    best: float = -np.inf
    found: list[Choice] = field(default_factory=list)

    def run(self, so_far: Choice, left: list[int], unlinked: list[int]) -> None:
        """Give poses to the remaining LiDARs; the unlinked have none from those that already have
        one."""
        self.steps += 1
        if self.steps > MOST_STEPS:
            return
        if so_far.count + self._most(left + unlinked) <= self.best - EQUAL:
            return
        if not unlinked and not self._is_new(so_far):
            return
        if not left:
            if not unlinked:
                self._keep(so_far)
            return
        lidar = max(left, key=lambda i: self._most_of(so_far.poses, i))
        others = [i for i in left if i != lidar]
        options = self._options(so_far, lidar)
        for T, gain in options:
            poses = {**so_far.poses, lidar: T}
            self.run(Choice(poses, so_far.count + gain), others + unlinked, [])
        if others and (not options or self._most_of(others, lidar) > 0):
            # Those that already have a pose may all be wrong about this one.
            self.run(so_far, others, [*unlinked, lidar])

    def _is_new(self, choice: Choice) -> bool:
        """Whether these poses were not reached yet, or with a smaller count."""
        same = frozenset((i, self._number(i, T)) for i, T in choice.poses.items())
        if self.reached.get(same, -np.inf) >= choice.count:
            return False
        self.reached[same] = choice.count
        return True

    def _number(self, lidar: int, T: Array) -> int:
        """Number a pose of a LiDAR: the same poses, the same numbers."""
        if id(T) not in self.numbers:
            known = self.known.get(lidar, np.zeros((0, 4, 4)))
            turned = np.einsum("kij,ij->k", known[:, :3, :3], T[:3, :3])
            near = np.flatnonzero(turned >= 1.0 + 2.0 * np.cos(AGREE_ANGLE))
            same = (int(k) for k in near if is_same_pose(T, known[k], self.poles[lidar]))
            self.numbers[id(T)] = number = next(same, len(known))
            if number == len(known):
                self.known[lidar] = np.concatenate([known, T[None]])
        return self.numbers[id(T)]

    def _keep(self, choice: Choice) -> None:
        self.best = max(self.best, choice.count)
        kept = [each for each in self.found if each.count > self.best - EQUAL]
        if all(_differs(choice, each, self.poles) for each in kept):
            kept.append(choice)
        kept.sort(key=lambda each: -each.count)
        self.found = kept[:MOST_RIVALS]

    def _options(self, so_far: Choice, lidar: int) -> list[tuple[Array, float]]:
        """Poses of a LiDAR by the hypotheses of its pairs, with the count of each."""
        poses: list[Array] = []
        for other, T_other in so_far.poses.items():
            for T in self._poses_via(other, T_other, lidar):
                if not any(self._is_same(lidar, T, known) for known in poses):
                    poses.append(T)
        gains = [
            (T, sum(self._gain(lidar, T, *other) for other in so_far.poses.items())) for T in poses
        ]
        return sorted(gains, key=lambda each: -each[1])

    def _poses_via(self, other: int, T_other: Array, lidar: int) -> list[Array]:
        """Poses of a LiDAR by the hypotheses of its pair with another."""
        key = id(T_other), lidar
        if key not in self.via:
            between = self.between.get((other, lidar), ())
            self.via[key] = [np.asarray(T_other @ T) for T in between]
        return self.via[key]

    def _is_same(self, lidar: int, T: Array, known: Array) -> bool:
        key = id(T), id(known)
        if key not in self.same:
            self.same[key] = is_same_pose(T, known, self.poles[lidar])
        return self.same[key]

    def _gain(self, lidar: int, T: Array, other: int, T_other: Array) -> float:
        """Count of a LiDAR's pose together with one other."""
        key = id(T), id(T_other)
        if key not in self.gains:
            pair = self._pair(other, lidar)
            self.gains[key] = 0.0
            if pair is not None:
                first, second = pair.lidars
                both = {other: T_other, lidar: T}
                met = pair.at(se3.inverse(both[first]) @ both[second], self.poles[second])
                self.gains[key] = 0.0 if met is None else weight_of(pair, met)
        return self.gains[key]

    def _pair(self, a: int, b: int) -> Pair | None:
        return self.pairs.get((min(a, b), max(a, b)))

    def _most_of(self, placed: Iterable[int], lidar: int) -> float:
        """Largest count of a LiDAR together with others."""
        return sum(self.most.get((other, lidar), 0.0) for other in placed)

    def _most(self, left: Sequence[int]) -> float:
        """Largest count that the remaining LiDARs can still add."""
        waiting = frozenset(left)
        if waiting not in self.still:
            touched = (pair for pair in self.pairs if not waiting.isdisjoint(pair))
            self.still[waiting] = sum(self.most[pair] for pair in touched)
        return self.still[waiting]


def weight_of(pair: Pair, hypothesis: Hypothesis) -> float:
    """Count of a hypothesis of a pair."""
    by_scene = 1.0 if pair.overlaps else WITHOUT_SCENE
    return by_scene * hypothesis.evidence * (1.0 if hypothesis.stands else UNLIKELY)


def most_of(pair: Pair) -> float:
    """Largest count of a pair."""
    return max(weight_of(pair, each) for each in pair.possible)


def _scene_score(choice: Choice, search: _Search) -> float:
    """Sum of the scene's scores of all hypotheses with which a choice agrees."""
    score = 0.0
    for (first, second), pair in search.pairs.items():
        T = se3.inverse(choice.poses[first]) @ choice.poses[second]
        met = pair.at(T, search.poles[second])
        score += 0.0 if met is None else met.score
    return score


def _differs(one: Choice, other: Choice, poles: Sequence[Array]) -> bool:
    """Whether some LiDAR has another pose, judged by its poles."""
    return any(
        not is_same_pose(T, other.poses[i], poles[i], ELSEWHERE) for i, T in one.poses.items()
    )


def where_they_differ(best: Choice, rival: Choice, poles: Sequence[Array]) -> list[int]:
    """LiDARs that have different poses in two choices."""
    return [
        i for i, T in best.poses.items() if not is_same_pose(T, rival.poses[i], poles[i], ELSEWHERE)
    ]


def check_linked(
    site: Site, scans: SiteScans, groups: Sequence[Sequence[int]], pairs: Sequence[Pair]
) -> None:
    """Refuse a site that falls into groups, or has no two LiDARs with poles.

    Raises
    ------
    Refusal
        ``too_few_lidars`` or ``disconnected``; of two LiDARs why they have no pose.
    """
    if len(groups) == 1:
        return
    if len(site.lidars) == 2:
        # As for a pair: the reason is not specific to sites.
        for refusal in (*(refusal for _, refusal in scans.faults), pairs[0].refusal):
            if refusal is not None:
                raise Refusal(refusal.code, refusal.message, refusal.values)
    named = "; ".join(", ".join(site.lidars[i].name for i in group) for group in groups)
    first = next((pair.refusal for pair in pairs if pair.refusal is not None), None)
    why = "" if first is None else f" ({first.message})"
    if len(groups[0]) < 2:
        raise Refusal(
            "too_few_lidars",
            f"no two LiDARs see the same two poles in one placement{why}",
            {"lidars": len(site.lidars)},
        )
    unmatched = "; ".join(_unmatched(site, scans, groups, pairs))
    other = f", or correct the files: {unmatched} see poles that do not match" if unmatched else ""
    raise Refusal(
        "disconnected",
        f"the LiDARs fall into {len(groups)} groups without two poles in common: {named}; add a "
        "placement with two poles that LiDARs of both groups see" + other,
        {"groups": len(groups), "names": named, "unmatched": unmatched},
    )


def _unmatched(
    site: Site, scans: SiteScans, groups: Sequence[Sequence[int]], pairs: Sequence[Pair]
) -> Iterator[str]:
    """Name LiDARs of two groups that both see three poles of a placement, of which no two match.

    Two may be other poles; with three near both, an error is more likely.
    """
    group_of = {i: number for number, group in enumerate(groups) for i in group}
    for pair in pairs:
        i, j = pair.lidars
        apart = group_of[i] != group_of[j] and pair.refusal is not None
        for p, name in enumerate(site.placements):
            if apart and min(len(scans.poles(i, p)), len(scans.poles(j, p))) > 2:
                yield f"{site.lidars[i].name} and {site.lidars[j].name} in placement {name}"
