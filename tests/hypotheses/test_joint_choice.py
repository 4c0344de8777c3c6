"""The choice of hypotheses: the best there is, as trying all shows, whatever the order."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Hypothesis
from retropole.hypotheses.joint_choice import (
    EQUAL,
    choose_poses,
    linked_groups,
    most_of,
    where_they_differ,
)
from retropole.hypotheses.pairs import Pair, is_same_pose
from tests.hypotheses.conftest import hypothesis_at


def hypothesis(T: Array, placements: tuple[int, ...] = (0,), score: float = 0.5) -> Hypothesis:
    return hypothesis_at(T, dict.fromkeys(placements, 2), score)


def pair(lidars: tuple[int, int], *hypotheses: Hypothesis, overlaps: bool = True) -> Pair:
    return Pair(lidars, tuple(sorted(hypotheses, key=lambda h: -h.score)), overlaps)


def drawn(rng: np.random.Generator, count: int) -> tuple[list[Array], list[Array]]:
    """True poses of some LiDARs in one frame, and points on poles that each sees."""
    poses = [se3.random(rng, 15.0) for _ in range(count)]
    return poses, [rng.uniform(-6, 6, (4, 3)) for _ in range(count)]


def true_pair(poses: Sequence[Array], i: int, j: int) -> Array:
    return se3.inverse(poses[i]) @ poses[j]


def half_turn(rng: np.random.Generator) -> Array:
    """What lays two poles of equal lean on each other, about a vertical between them."""
    at = se3.from_rt(np.eye(3), np.r_[rng.uniform(2, 8, 2), 0.0])
    return at @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ se3.inverse(at)


def count_of(poses: dict[int, Array], pairs: Sequence[Pair], poles: Sequence[Array]) -> float:
    """How much agrees with some poses, as the head of `hypotheses.joint_choice` says."""
    count = 0.0
    for each in pairs:
        i, j = each.lidars
        met = each.at(se3.inverse(poses[i]) @ poses[j], poles[j])
        if met is not None:
            count += met.evidence * (1.0 if each.overlaps else 0.25)
    return count


def best_of_all(pairs: Sequence[Pair], poles: Sequence[Array]) -> float:
    """The largest count, by trying every tree of hypotheses."""
    lidars = range(len(poles))
    found = -np.inf
    for tree in combinations(pairs, len(lidars) - 1):
        for taken in product(*(each.standing for each in tree)):
            poses: dict[int, Array] = {0: np.eye(4)}
            while len(poses) < len(lidars):
                before = len(poses)
                for each, one in zip(tree, taken, strict=True):
                    i, j = each.lidars
                    if i in poses and j not in poses:
                        poses[j] = poses[i] @ one.T
                    elif j in poses and i not in poses:
                        poses[i] = poses[j] @ se3.inverse(one.T)
                if len(poses) == before:
                    break
            if len(poses) == len(lidars):
                found = max(found, count_of(poses, pairs, poles))
    return found


def messy(seed: int, count: int = 4) -> tuple[list[Pair], list[Array]]:
    """Pairs with a true hypothesis among others, some without the true one, and some missing."""
    rng = np.random.default_rng(seed)
    poses, poles = drawn(rng, count)
    pairs = []
    for i, j in combinations(range(count), 2):
        if j > i + 1 and rng.uniform() < 0.3:
            continue
        T = true_pair(poses, i, j)
        placements = tuple(range(1 + int(rng.integers(2))))
        own = [] if rng.uniform() < 0.15 else [hypothesis(T, placements, rng.uniform())]
        own += [
            hypothesis(T @ half_turn(rng), (0,), rng.uniform())
            for _ in range(int(rng.integers(0 if own else 1, 3)))
        ]
        pairs.append(pair((i, j), *own, overlaps=bool(rng.uniform() < 0.7)))
    return pairs, poles


@pytest.mark.parametrize("seed", range(12))
def test_no_choice_counts_more_than_the_one_that_is_found(seed: int) -> None:
    pairs, poles = messy(seed)
    found = choose_poses(range(4), pairs, poles, 0)
    assert found.complete
    assert found.best.count == pytest.approx(best_of_all(pairs, poles))
    assert found.best.count == pytest.approx(count_of(found.best.poses, pairs, poles))
    assert all(found.best.count >= one.count > found.best.count - EQUAL for one in found.rivals)


@pytest.mark.parametrize("seed", range(6))
def test_the_order_of_the_lidars_makes_no_difference(seed: int) -> None:
    pairs, poles = messy(seed)
    found = choose_poses(range(4), pairs, poles, 0)
    order = np.random.default_rng(seed + 100).permutation(4)
    number = {int(old): new for new, old in enumerate(order)}
    renamed = []
    for each in pairs:
        i, j = (number[k] for k in each.lidars)
        turned = each.hypotheses
        if i > j:
            turned = tuple(
                replace(one, match=replace(one.match, T_target_source=se3.inverse(one.T)))
                for one in turned
            )
        renamed.append(Pair((min(i, j), max(i, j)), turned, each.overlaps))
    again = choose_poses(range(4), renamed, [poles[k] for k in order], number[0])
    assert again.best.count == pytest.approx(found.best.count)
    assert len(again.rivals) == len(found.rivals)
    if not found.rivals:
        for i in range(4):
            np.testing.assert_allclose(again.best.poses[number[i]], found.best.poses[i], atol=1e-9)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_a_ring_decides_what_none_of_its_pairs_does(count: int) -> None:
    """Around the loop what is chosen composes to the identity; the scene prefers the other."""
    for seed in range(3):
        rng = np.random.default_rng([count, seed])
        poses, poles = drawn(rng, count)
        ring = [tuple(sorted((k, (k + 1) % count))) for k in range(count)]
        pairs = [
            pair(
                (i, j),
                hypothesis(true_pair(poses, i, j), (k,), 0.4),
                hypothesis(true_pair(poses, i, j) @ half_turn(rng), (k,), 0.6),
            )
            for k, (i, j) in enumerate(ring)
        ]
        found = choose_poses(range(count), pairs, poles, 0)
        assert found.complete
        assert not found.rivals
        assert found.best.count == count
        around = np.eye(4)
        for k in range(count):
            i, j = k, (k + 1) % count
            T = se3.inverse(found.best.poses[i]) @ found.best.poses[j]
            near = min(
                (one.T if i < j else se3.inverse(one.T) for p in pairs for one in p.hypotheses
                 if set(p.lidars) == {i, j}),
                key=lambda each: float(np.abs(each - T).max()),
            )  # fmt: skip
            around = around @ near
            np.testing.assert_allclose(T, true_pair(poses, i, j), atol=1e-9)
        np.testing.assert_allclose(around, np.eye(4), atol=1e-9)


def test_a_chain_leaves_open_what_its_pairs_leave_open() -> None:
    rng = np.random.default_rng(0)
    poses, poles = drawn(rng, 3)
    first = pair((0, 1), hypothesis(true_pair(poses, 0, 1)))
    T = true_pair(poses, 1, 2)
    second = pair((1, 2), hypothesis(T), hypothesis(T @ half_turn(rng)))
    found = choose_poses(range(3), [first, second], poles, 0)
    assert len(found.rivals) == 1
    assert where_they_differ(found.best, found.rivals[0], poles) == [2]
    # A third pair decides; one placement is enough.
    third = pair((0, 2), hypothesis(true_pair(poses, 0, 2), (1,)))
    decided = choose_poses(range(3), [first, second, third], poles, 0)
    assert not decided.rivals
    assert is_same_pose(decided.best.poses[2], true_pair(poses, 0, 2), poles[2])


def test_of_equal_choices_the_scene_prefers_one() -> None:
    rng = np.random.default_rng(1)
    poses, poles = drawn(rng, 2)
    T = true_pair(poses, 0, 1)
    turned = T @ half_turn(rng)
    both = pair((0, 1), hypothesis(T, score=0.6), hypothesis(turned, score=0.5))
    found = choose_poses(range(2), [both], poles, 0)
    np.testing.assert_allclose(found.best.poses[1], T)
    np.testing.assert_allclose(found.rivals[0].poses[1], turned)


def test_pairs_whose_scenes_do_not_overlap_do_not_outvote_one_that_does() -> None:
    rng = np.random.default_rng(2)
    poses, poles = drawn(rng, 3)
    wrong = true_pair(poses, 0, 1) @ half_turn(rng)
    pairs = [
        pair((0, 1), hypothesis(true_pair(poses, 0, 1))),
        pair((0, 2), hypothesis(true_pair(poses, 0, 2))),
        # Poles of one shape by chance.
        pair((1, 2), hypothesis(se3.inverse(wrong) @ true_pair(poses, 0, 2)), overlaps=False),
    ]
    assert most_of(pairs[2]) < most_of(pairs[0]) / 2
    found = choose_poses(range(3), pairs, poles, 0)
    np.testing.assert_allclose(found.best.poses[1], true_pair(poses, 0, 1), atol=1e-9)
    assert not found.rivals


def test_poles_that_agree_outvote_scenes_that_prefer_another_pose() -> None:
    """Two of four poles lie on each other after a half turn, and the scenes lie nearer then."""
    rng = np.random.default_rng(3)
    poses, poles = drawn(rng, 3)
    turn = half_turn(rng)
    pairs = []
    for i in (0, 1):
        right = true_pair(poses, i, 2)
        four = replace(hypothesis(right, score=0.1), poles={0: 4}, stands=False)
        two = hypothesis(right @ turn, score=0.2)
        pairs.append(pair((i, 2), two, four, overlaps=i == 0))
    pairs.append(pair((0, 1), hypothesis(true_pair(poses, 0, 1))))
    found = choose_poses(range(3), pairs, poles, 0)
    np.testing.assert_allclose(found.best.poses[2], true_pair(poses, 0, 2), atol=1e-9)
    assert not found.rivals


def test_groups_are_those_that_hypotheses_link() -> None:
    one = hypothesis(np.eye(4))
    pairs = [pair((0, 3), one), pair((1, 2), one), pair((2, 4), one), Pair((0, 1), (), False)]
    assert linked_groups(6, pairs) == [[1, 2, 4], [0, 3], [5]]
