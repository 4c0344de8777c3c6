import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.alignment.point_to_line import LineAlignment, Lines, align_each
from retropole.base import se3
from retropole.base.datatypes import Array, Pole
from retropole.base.errors import Refusal
from retropole.hypotheses import correspondence
from retropole.hypotheses.correspondence import (
    every_match,
    line_pair,
    match_poles,
    pair_starts,
    widest_angle,
)
from tests.conftest import PoleMaker

AXES = [
    (np.array([4.0, -1.0, 0.2]), np.array([0.1, 0.25, 1.0])),
    (np.array([5.0, 1.3, -0.1]), np.array([-0.2, -0.3, 1.0])),
]
THIRD = (np.array([3.0, 2.5, 0.0]), np.array([0.35, 0.0, 1.0]))


def same(A: Array, B: Array, atol: float = 1e-6) -> bool:
    return bool(np.allclose(A, B, atol=atol))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_line_pair_moves_with_the_lines(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, n = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    T = se3.random(rng)
    before = line_pair(p[0], n[0], p[1], n[1])
    q, m = se3.apply(T, p), n @ T[:3, :3].T
    after = line_pair(q[0], m[0], q[1], m[1])
    np.testing.assert_allclose(after.frame, T @ before.frame, atol=1e-6)
    assert after.angle == pytest.approx(before.angle, abs=1e-9)
    assert after.handedness == pytest.approx(before.handedness, abs=1e-6)
    # A mirror image has the other hand, so no proper motion lays one on the other.
    mirror = np.array([1.0, 1.0, -1.0])
    image = line_pair(p[0] * mirror, n[0] * mirror, p[1] * mirror, n[1] * mirror)
    assert image.handedness == pytest.approx(-before.handedness, abs=1e-9)


def test_handedness_does_not_depend_on_names_or_directions() -> None:
    (p, n), (q, m) = AXES
    n, m = n / np.linalg.norm(n), m / np.linalg.norm(m)
    one = line_pair(p, n, q, m).handedness
    for other in (line_pair(q, m, p, n), line_pair(p, -n, q, m), line_pair(p, -n, q, -m)):
        assert other.handedness == pytest.approx(one)


def test_eight_starts_four_exact(make_pole: PoleMaker) -> None:
    T_true = se3.random(np.random.default_rng(4), 3.0)
    target = [make_pole(p, n) for p, n in AXES]
    source = [make_pole(p, n, T=se3.inverse(T_true)) for p, n in AXES]
    starts = pair_starts((target[0], target[1]), (source[0], source[1]))
    assert len(starts) == 8
    matches = match_poles(target, source)
    assert len(matches) == 8
    exact = [m for m in matches if m.exact]
    assert len(exact) == 4
    assert all(m.pole_rms < 1e-9 for m in exact)
    assert all(m.pole_rms > 0.05 for m in matches if not m.exact)
    assert matches[:4] == exact, "exact matches come first"
    # The four differ by the Klein four-group: every quotient is a half turn, or nothing.
    for a in exact:
        for b in exact:
            turn = a.T_target_source @ se3.inverse(b.T_target_source)
            angle = se3.rotation_angle(turn[:3, :3])
            assert a is b or angle == pytest.approx(np.pi, abs=1e-6)
            assert same(turn @ turn, np.eye(4))
    assert any(same(m.T_target_source, T_true) for m in exact)


def test_swapping_the_clouds_inverts_the_matches(make_pole: PoleMaker) -> None:
    T_true = se3.random(np.random.default_rng(5), 3.0)
    target = [make_pole(p, n) for p, n in AXES]
    source = [make_pole(p, n, T=se3.inverse(T_true)) for p, n in AXES]
    forth = [m.T_target_source for m in match_poles(target, source) if m.exact]
    back = [m.T_target_source for m in match_poles(source, target) if m.exact]
    assert len(back) == 4
    for T in back:
        assert any(same(se3.inverse(T), other) for other in forth)


def test_three_poles_have_one_match_solved_together(make_pole: PoleMaker) -> None:
    rng = np.random.default_rng(6)
    T_true = se3.random(rng, 3.0)
    axes = [*AXES, THIRD]
    target = [make_pole(p, n, sigma=0.003, rng=rng) for p, n in axes]
    source = [make_pole(p, n, sigma=0.003, rng=rng, T=se3.inverse(T_true)) for p, n in axes]
    source = [source[2], source[0], source[1]]
    matches = match_poles(target, source)
    assert matches[0].pairs == ((0, 1), (1, 2), (2, 0))
    assert same(matches[0].T_target_source, T_true, 0.02)
    assert [len(m.pairs) for m in matches].count(3) == 1


def test_a_pole_that_one_lidar_alone_sees_is_left_out(make_pole: PoleMaker) -> None:
    T_true = se3.random(np.random.default_rng(7), 3.0)
    target = [make_pole(p, n) for p, n in [THIRD, *AXES]]
    source = [make_pole(p, n, T=se3.inverse(T_true)) for p, n in AXES]
    matches = match_poles(target, source)
    assert len(matches) == 4
    assert all({i for i, _ in m.pairs} == {1, 2} for m in matches)
    assert any(same(m.T_target_source, T_true) for m in matches)


def test_exact_number_of_poles(make_pole: PoleMaker) -> None:
    axes = [*AXES, THIRD]
    poles = [make_pole(p, n) for p, n in axes]
    assert len(match_poles(poles, poles, 3)[0].pairs) == 3
    with pytest.raises(Refusal) as refusal:
        match_poles(poles[:2], poles[:2], 3)
    assert refusal.value.code == "too_few_poles"


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_poles(make_pole: PoleMaker, count: int) -> None:
    poles = [make_pole(p, n) for p, n in AXES]
    for target, source in ((poles[:count], poles), (poles, poles[:count])):
        with pytest.raises(Refusal) as refusal:
            match_poles(target, source)
        assert refusal.value.code == "too_few_poles"
        assert refusal.value.values["poles"] == count


@pytest.mark.parametrize("angle_deg", [0.0, 2.0, 4.0])
def test_parallel_poles_are_refused_with_their_angle(
    make_pole: PoleMaker, angle_deg: float
) -> None:
    lean = np.array([np.sin(np.radians(angle_deg)), 0, np.cos(np.radians(angle_deg))])
    poles = [make_pole(np.array([4.0, -1, 0]), np.array([0.0, 0, 1])), make_pole([4.0, 1, 0], lean)]
    with pytest.raises(Refusal) as refusal:
        match_poles(poles, poles)
    assert refusal.value.code == "parallel_poles"
    assert refusal.value.values["angle_deg"] == pytest.approx(angle_deg, abs=0.1)
    assert widest_angle([pole.direction for pole in poles]) == pytest.approx(
        np.radians(angle_deg), abs=1e-6
    )


def test_poles_of_another_shape_do_not_match(make_pole: PoleMaker) -> None:
    target = [make_pole(p, n) for p, n in AXES]
    source = [make_pole(AXES[0][0], AXES[0][1]), make_pole([5.0, 3.3, 0], [0.9, 0.3, 1.0])]
    with pytest.raises(Refusal) as refusal:
        match_poles(target, source)
    assert refusal.value.code == "no_match"


def test_a_pole_that_the_others_deny_is_left_out_where_it_may_be(make_pole: PoleMaker) -> None:
    T_true = se3.random(np.random.default_rng(8), 3.0)
    lines = [*AXES, THIRD, (np.array([3.5, 0.2, 0.0]), np.array([-0.35, 0.3, 1.0]))]
    beside = [*lines[:3], (lines[3][0] + np.array([0.0, 0.14, 0.0]), lines[3][1])]
    target = [make_pole(p, n) for p, n in lines]
    source = [make_pole(p, n, T=se3.inverse(T_true)) for p, n in beside]
    best = match_poles(target, source, part=True)[0]
    assert best.pairs == ((0, 0), (1, 1), (2, 2))
    assert same(best.T_target_source, T_true)
    assert not any(
        same(match.T_target_source, T_true) and len(match.pairs) > 2
        for match in match_poles(target, source)
    )


def tubes(rng: np.random.Generator, radius: float, eye: Array, count: int = 40) -> list[Pole]:
    """Tubes about the axes of two leaning poles, as a LiDAR at ``eye`` sees them, in its frame."""
    found = []
    for p, n in AXES:
        n = n / np.linalg.norm(n)
        sight = p - eye - ((p - eye) @ n) * n
        sight /= np.linalg.norm(sight)
        beside = rng.uniform(-radius, radius, count)
        depth = np.sqrt(radius**2 - beside**2)
        along = np.linspace(-1, 1, count)
        xyz = p - eye + np.outer(along, n) + np.outer(beside, np.cross(n, sight))
        xyz -= np.outer(depth, sight)
        centre, axes = se3.principal_axes(xyz)
        off = np.linalg.norm(np.cross(xyz - centre, axes[:, 2]), axis=1)
        rms, deeper = float(np.sqrt(np.mean(off**2))), np.pi / 4 * max(radius - 0.02, 0.0)
        index = np.arange(count)
        found.append(Pole(centre, axes[:, 2], xyz, 2.0, rms, count, index, deeper * sight))
    return found


@pytest.mark.parametrize("radius", [0.02, 0.055, 0.08])
def test_tubes_seen_from_two_sides_match(radius: float) -> None:
    rng = np.random.default_rng(3)
    eyes = np.zeros(3), np.array([5.0, 9.0, 0.5])
    target, source = (tubes(rng, radius, eye) for eye in eyes)
    exact = [each.T_target_source for each in match_poles(target, source) if each.exact]
    near = min(exact, key=lambda T: float(np.linalg.norm(T[:3, 3] - eyes[1])))
    # No farther off than a pole of 2 cm is, whose line runs 16 mm in front of its axis.
    assert se3.difference(near, se3.from_rt(np.eye(3), eyes[1])).translation < 0.06
    assert len(exact) == 4


def test_a_match_is_granted_what_far_and_thick_poles_leave_open_and_near_ones_nothing() -> None:
    rng = np.random.default_rng(0)
    pairs = [(0, 0), (1, 1)]
    thin, thick = (tubes(rng, radius, np.zeros(3)) for radius in (0.02, 0.08))
    few = tubes(rng, 0.08, np.zeros(3), 4)
    limits = [correspondence.exact_rms(t, s, pairs) for t, s in ((thin, thin), (thin, thick),
        (thick, thick), (few, thick))]  # fmt: skip
    assert limits[0] == correspondence.EXACT_RMS
    assert limits == sorted(limits)
    # What the returns of a tube scatter themselves is the least.
    assert limits[1] ** 2 > 0.05**2 + (0.6 * 0.08) ** 2 - 0.03**2


def row_beside_two_poles(make_pole: PoleMaker, T: Array | None = None) -> list[Pole]:
    """Eleven upright posts, a metre apart, beside two poles that lean alike to either side."""
    posts = [make_pole((k - 5.0, 2.0, 1.0), (0, 0, 1), length=1.0, T=T) for k in range(11)]
    leaning = [
        make_pole((-1.0, 0.3, 1.0), (0.3, 0.05, 1), T=T),
        make_pole((1.2, 0.0, 1.0), (-0.3, 0.1, 1), T=T),
    ]
    return [*leaning, *posts]


def test_a_row_of_posts_is_matched_in_bounded_time(
    make_pole: PoleMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = 0

    def counted(lines: Lines, starts: Array) -> list[LineAlignment]:
        nonlocal solved
        solved += len(starts)
        return align_each(lines, starts)

    monkeypatch.setattr(correspondence, "align_each", counted)
    T = se3.random(np.random.default_rng(4))
    target = row_beside_two_poles(make_pole)
    source = row_beside_two_poles(make_pole, se3.inverse(T))
    matches = match_poles(target, source)
    assert len(matches[0].pairs) == 13
    np.testing.assert_allclose(matches[0].T_target_source, T, atol=1e-6)
    # Each pair of pairs is solved in eight ways, and again with the poles that it takes in.
    assert 8 * 20 < solved <= 16 * correspondence.ENOUGH_PAIR_MATCHES


def test_only_the_best_of_many_matches_go_on(make_pole: PoleMaker) -> None:
    """Of posts in a circle that lean alike hundreds of pairs are alike."""
    turns = [
        se3.from_rt(se3.exp_so3(np.array([0, 0, k * np.pi / 6])), np.zeros(3)) for k in range(12)
    ]
    ring = [make_pole((4.0, 0.0, 0.0), (0.2, 0.5, 1.0), T=T) for T in turns]
    one = [*ring[:2], make_pole((0.5, 0.2, 0.0), (0.4, 0.0, 1.0))]
    found = every_match(ring, one)
    best = match_poles(ring, one)
    assert len(found.matches) > len(best) == correspondence.MAX_HYPOTHESES
    for match, one_by_one in zip(found.matches, best, strict=False):
        assert match.pairs == one_by_one.pairs
    assert found.laid.tried <= correspondence.MAX_PAIR_MATCHES
    assert found.laid.found >= found.laid.tried


def test_poles_are_paired_as_one_by_one(make_pole: PoleMaker) -> None:
    """By the distances between each two, written out."""
    rng = np.random.default_rng(7)
    target = row_beside_two_poles(make_pole)
    for _ in range(20):
        T = se3.retract(se3.random(rng), np.zeros(6))
        source = row_beside_two_poles(make_pole, se3.inverse(T))[::-1]
        off = se3.retract(T, np.r_[rng.normal(size=3) * 0.03, rng.normal(size=3) * 0.1])
        expected = set()
        for i, pole in enumerate(target):
            for j, other in enumerate(source):
                ends = se3.apply(off, np.stack([other.xyz[0], other.point, other.xyz[-1]]))
                across = np.cross(ends - pole.point, pole.direction)
                leaning = np.linalg.norm(np.cross(off[:3, :3] @ other.direction, pole.direction))
                along = abs((ends[1] - pole.point) @ pole.direction)
                gap = along - (pole.length + other.length) / 2
                misfit = np.linalg.norm(across, axis=1).max()
                if misfit <= 0.15 and leaning < np.sin(np.radians(10.0)) and gap < 1.0:
                    expected.add((i, j))
        assert set(correspondence.extended(target, source, off, 0.15)) == expected
