from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest

from retropole.alignment.unknowns import Unknowns
from retropole.planning.choice import (
    Design,
    Rules,
    carried,
    choose,
    constrained_twice,
    count_dependent,
    error_of,
    errors_of,
    rules_of,
)
from retropole.planning.place import Candidates
from tests.planning.places import planned

pytestmark = pytest.mark.full


def drawn(seed: int, count: int = 9) -> Design:
    """A design of random poles that each say little of a few directions."""
    rng = np.random.default_rng(seed)
    bands = (np.arange(2), np.arange(2))
    unknowns = Unknowns(bands, 0, 0)
    roots = []
    for _ in range(count):
        place = np.sort(rng.choice(np.arange(6, unknowns.kept), 12, replace=False))
        place = np.union1d(place, np.arange(6, 12))
        roots.append((place, rng.normal(size=(len(place), 4)) * rng.uniform(10, 1000)))
    prior = np.diag(np.r_[np.zeros(12), np.full(unknowns.kept - 12, 1e4)])
    every = np.ones((count, count), dtype=bool)
    apart = np.cumsum(np.arange(count))
    gap = np.abs(apart[:, None] - apart).astype(np.float64)
    rules = Rules(every, every[:, :2], every, gap, gap)
    feet = rng.uniform(-5, 5, size=(count, 2))
    return Design(roots, (prior, prior), unknowns, 30.0, rules, feet)


@pytest.mark.parametrize("seed", range(4))
def test_exchange_finds_the_best_set(seed: int) -> None:
    design = drawn(seed)
    chosen = choose(design, 3)
    assert chosen is not None
    # Of those that hang on one pole as little.
    most = count_dependent(design, chosen)
    sets = [each for each in combinations(range(9), 3) if count_dependent(design, [each]) <= most]
    best = min(error_of(design, [each]) for each in sets)
    assert error_of(design, chosen) <= 1.05 * best
    assert chosen == choose(design, 3)


def test_the_error_with_one_more_is_that_of_the_set_with_it() -> None:
    design = drawn(1)
    with_each = design.with_each(design.inverse([2, 5]))
    for k in (0, 7):
        assert with_each[k] == pytest.approx(errors_of(design, [[2, 5, k]])[0].max(), rel=1e-6)


def test_the_error_with_one_less_is_that_of_the_set_without_it() -> None:
    design = drawn(1)
    every = design.inverse([2, 5, 7], alone=True)
    less = design.squares(every) + design.change(every, 5, -1.0)
    assert less == pytest.approx(design.squares(design.inverse([2, 7], alone=True)), rel=1e-5)


def test_a_lidar_that_hangs_on_one_pole_is_counted_and_gets_another() -> None:
    design = drawn(3)
    place = np.arange(6, 12)
    held = 1e3 * np.eye(6)[:, :3], 1e3 * np.eye(6)[:, 3:], 1e3 * np.eye(6)
    roots = [(place, each) for each in (*held, *[1e-3 * np.eye(6)] * 6)]
    design = replace(design, roots=roots)
    assert count_dependent(design, [[0, 1]]) == 2
    assert count_dependent(design, [[2, 3]]) == 1
    assert count_dependent(design, [[0, 1, 2]]) == 0
    again = constrained_twice(design, [[2, 3], [1]])
    assert count_dependent(design, again) == 0
    assert sum(map(len, again)) == 3


def test_poles_are_carried_to_the_nearest_place() -> None:
    design = drawn(5)
    first, second = carried(design, [[0, 1, 2], [3, 4, 5]])
    assert first == [0, 1, 2]
    walks = [
        sum(
            np.linalg.norm(design.feet[a] - design.feet[b]) for a, b in zip(first, own, strict=True)
        )
        for own in permutations([3, 4, 5])
    ]
    own = sum(
        np.linalg.norm(design.feet[a] - design.feet[b]) for a, b in zip(first, second, strict=True)
    )
    assert own == pytest.approx(min(walks))
    # Where a few metres more bring hardly anything, poles stay near.
    alike = replace(design, roots=[design.roots[0]] * 9)
    chosen = choose(alike, 1, 2)
    assert chosen is not None
    gap = np.linalg.norm(alike.feet[chosen[1][0]] - alike.feet, axis=1)
    assert chosen[0][0] == np.argsort(gap)[1]


def test_more_poles_never_harm() -> None:
    design = drawn(2)
    errors = [error_of(design, choose(design, n) or []) for n in (1, 2, 3, 4)]
    assert errors == sorted(errors, reverse=True)


def test_rules_are_kept() -> None:
    design = planned().design
    for placements in (1, 2):
        chosen = choose(design, 2, placements)
        assert chosen is not None
        for own in chosen:
            assert all(design.rules.allow(k, [o for o in own if o != k]) for k in own)
        every = [k for own in chosen for k in own]
        assert len(set(every)) == len(every)


def test_none_may_stand() -> None:
    design = drawn(0)
    none = np.zeros((9, 9), dtype=bool)
    alone = replace(design, rules=replace(design.rules, pairs=none))
    assert choose(alone, 1) is not None
    assert choose(alone, 2) is None


def test_poles_that_lean_alike_do_not_stand_together_where_there_are_few() -> None:
    leans = np.radians([0.0, 20.0, 35.0, 20.0])
    turns = np.radians([0.0, 90.0, 0.0, -90.0])
    axis = np.stack(
        [np.sin(leans) * np.cos(turns), np.sin(leans) * np.sin(turns), np.cos(leans)], axis=1
    )
    foot = np.array([[4, 0, 0], [3, 2, 0], [2, -1, 0], [3, -2, 0]], dtype=float)
    poles = Candidates(foot, axis, 2.0, 0.02)
    at = [np.array([-3.0, 0.5, 1.0]), np.array([-3.0, 1.5, 2.0])]
    rules = rules_of(poles, np.ones((4, 2), dtype=bool), at)
    assert rules.allow(1, [0])
    assert not rules.allow(3, [1])
    assert rules.allow(2, [0, 1])
    assert not rules.allow(3, [0, 1])


def test_poles_whose_exchange_looks_the_same_do_not_stand_together() -> None:
    every = np.ones((4, 4), dtype=bool)
    angle = np.array([[0, 3, 4, 4], [3, 0, 5, 5], [4, 5, 0, 6], [4, 5, 6, 0]]) / 10
    gap = np.array([[0, 1, 2, 2.1], [1, 0, 3, 3.2], [2, 3, 0, 1], [2.1, 3.2, 1, 0]])
    rules = Rules(every, every[:, :2], every, angle, gap)
    assert not rules.allow(3, [0, 1, 2])
    gap[0, 3] = gap[3, 0] = 2.5
    assert rules.allow(3, [0, 1, 2])
