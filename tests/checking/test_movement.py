"""Same, moved, or cannot tell: laws of the test of two poses."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, PoseEstimate
from retropole.base.uncertainty import Uncertainty
from retropole.checking.movement import (
    CONFIDENCE,
    FALSE_ALARM,
    REPEATED,
    ROTATION,
    TRANSLATION,
    CheckResult,
    compare_poses,
    detection_power,
    kept,
    step_covariance,
    upper_limit,
)
from retropole.checking.tolerance import DEFAULT_TOLERANCE, WIDEST_TOLERANCE, RequestedTolerance
from retropole.export.transform import Transform, inverted


def covariance(
    rng: np.random.Generator, rotation: float = 3e-4, translation: float = 2e-3
) -> Array:
    """Draw a covariance of about these sigmas, with correlations."""
    A = rng.normal(size=(6, 6)) * np.repeat([rotation, translation], 3)[:, None] / np.sqrt(6)
    return np.asarray(A @ A.T + np.diag(np.repeat([rotation, translation], 3) ** 2) / 10)


def drawn(T: Array, spread: Array, rng: np.random.Generator) -> PoseEstimate:
    return PoseEstimate(se3.retract(T, rng.multivariate_normal(np.zeros(6), spread)), spread, 0.0)


def test_equal_poses_are_the_same() -> None:
    rng = np.random.default_rng(0)
    T, spread = se3.random(rng), covariance(rng)
    answer = compare_poses(PoseEstimate(T, spread, 0.0), PoseEstimate(T, spread, 0.0), "poles")
    assert answer.status == "same"
    assert answer.chi2 == pytest.approx(0.0, abs=1e-12)
    assert answer.p_value == pytest.approx(1.0)
    assert answer.covariance is not None
    np.testing.assert_allclose(answer.covariance, 2 * spread)


@pytest.mark.full
def test_the_false_alarm_rate_holds_for_errors_that_repeat() -> None:
    """Systematic errors ten times the random ones, all of which both poses have, move nothing."""
    rng = np.random.default_rng(9)
    T, random, systematic = se3.random(rng), covariance(rng), 100 * covariance(rng)
    parts = Uncertainty(random, systematic)
    nothing, runs, alarms, squares = np.zeros(6), 1000, 0, []
    for _ in range(runs):
        repeated = rng.multivariate_normal(nothing, REPEATED * systematic)
        one, other = (
            PoseEstimate(se3.retract(T, repeated + own), parts.covariance, 0.0)
            for own in rng.multivariate_normal(nothing, random + (1 - REPEATED) * systematic, 2)
        )
        answer = compare_poses(
            one, other, "poles", RequestedTolerance(1e-9, 1e-9), uncertainties=(parts, parts)
        )
        assert answer.chi2 is not None
        squares.append(answer.chi2)
        alarms += answer.status == "moved"
    assert np.mean(squares) == pytest.approx(6.0, abs=0.6)
    assert alarms / runs == pytest.approx(FALSE_ALARM, abs=4 * np.sqrt(FALSE_ALARM / runs))


def test_stored_and_new_may_change_places() -> None:
    rng = np.random.default_rng(1)
    T = se3.random(rng)
    one, other = drawn(T, covariance(rng), rng), drawn(T, covariance(rng), rng)
    forth, back = compare_poses(one, other, "poles"), compare_poses(other, one, "poles")
    assert forth.chi2 is not None
    assert forth.chi2 == pytest.approx(back.chi2)
    assert forth.power == pytest.approx(back.power)
    assert forth.status == back.status


def test_a_rotation_of_the_targets_frame_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    T, C, D = se3.random(rng), covariance(rng), covariance(rng)
    one, other = drawn(T, C, rng), drawn(T, D, rng)
    A = se3.random(rng)
    R = np.kron(np.eye(2), A[:3, :3])
    plain = compare_poses(one, other, "scene")
    moved = compare_poses(
        PoseEstimate(A @ one.T_target_source, R @ C @ R.T, 0.0),
        PoseEstimate(A @ other.T_target_source, R @ D @ R.T, 0.0),
        "scene",
    )
    assert moved.chi2 == pytest.approx(plain.chi2)
    assert moved.power == pytest.approx(plain.power)
    for ours, theirs in ((moved.rotation, plain.rotation), (moved.translation, plain.translation)):
        assert ours is not None
        assert theirs is not None
        assert ours.length == pytest.approx(theirs.length)
        assert ours.sigma == pytest.approx(theirs.sigma)


def test_exchanging_the_lidars_changes_nothing_to_first_order() -> None:
    rng = np.random.default_rng(3)
    T = se3.random(rng, 2.0)
    C, D = covariance(rng), covariance(rng)
    one, other = drawn(T, C, rng), drawn(T, D, rng)

    def the_other_way(pose: PoseEstimate) -> PoseEstimate:
        back = inverted(Transform(pose.T_target_source, "a", "b", pose.covariance))
        return PoseEstimate(back.T_parent_child, back.covariance, 0.0)

    forth = compare_poses(one, other, "poles")
    back = compare_poses(the_other_way(one), the_other_way(other), "poles")
    assert forth.chi2 is not None
    assert back.chi2 == pytest.approx(forth.chi2, rel=0.02)


@pytest.mark.full
def test_the_false_alarm_rate_is_as_stated() -> None:
    rng = np.random.default_rng(4)
    T, C, D = se3.random(rng), covariance(rng), covariance(rng)
    runs = 2000
    # Of a tolerance of nothing, no movement is below it.
    alarms = sum(
        compare_poses(
            drawn(T, C, rng), drawn(T, D, rng), "poles", RequestedTolerance(1e-9, 1e-9)
        ).status
        == "moved"
        for _ in range(runs)
    )
    assert alarms / runs == pytest.approx(FALSE_ALARM, abs=4 * np.sqrt(FALSE_ALARM / runs))


@pytest.mark.parametrize("part", [0, 1])
def test_the_power_is_what_sampling_gives_in_the_worst_direction(part: int) -> None:
    rng = np.random.default_rng(5 + part)
    # One part certain, the other just not certain enough.
    spread = covariance(rng, *((1.0e-3, 1e-4) if part == 0 else (1e-5, 6e-3)))
    own = slice(3 * part, 3 * part + 3)
    values, vectors = np.linalg.eigh(spread[own, own])
    tolerance = (DEFAULT_TOLERANCE.rotation, DEFAULT_TOLERANCE.translation)[part]
    # Of all movements with this part, the one that the covariance most likes.
    worst = spread[:, own] @ vectors[:, -1] / values[-1] * tolerance
    assert np.linalg.norm(worst[own]) == pytest.approx(tolerance)
    power = detection_power(spread, DEFAULT_TOLERANCE)
    assert 0.1 < power < 0.98
    runs = 20_000
    seen = rng.multivariate_normal(worst, spread, runs)
    chi2 = np.einsum("ni,ij,nj->n", seen, np.linalg.inv(spread), seen)
    limit = 16.811893829770927
    assert np.mean(chi2 > limit) == pytest.approx(power, abs=4 * np.sqrt(0.25 / runs))
    for _ in range(20):
        any_other = rng.normal(size=6) * np.repeat([1e-2, 1e-1], 3)
        any_other *= tolerance / np.linalg.norm(any_other[own])
        least = worst @ np.linalg.solve(spread, worst)
        assert any_other @ np.linalg.solve(spread, any_other) >= least * (1 - 1e-9)


def test_the_power_has_its_limits() -> None:
    assert detection_power(1e-12 * np.eye(6), DEFAULT_TOLERANCE) == pytest.approx(1.0)
    assert detection_power(1e6 * np.eye(6), DEFAULT_TOLERANCE) == pytest.approx(
        FALSE_ALARM, rel=1e-3
    )
    powers = [
        detection_power(s * np.diag([1e-6] * 3 + [1e-4] * 3), DEFAULT_TOLERANCE) for s in (1, 2, 4)
    ]
    assert powers == sorted(powers, reverse=True)


@pytest.mark.parametrize("part", [ROTATION, TRANSLATION])
def test_a_movement_is_above_its_upper_limit_as_rarely_as_stated(part: slice) -> None:
    rng = np.random.default_rng(10 + part.start)
    spread = covariance(rng)
    values, vectors = np.linalg.eigh(spread[part, part])
    size = 8.0 * np.sqrt(values[-1])
    for direction, missed in ((vectors[:, -1], 1 - CONFIDENCE), (vectors[:, 0], 0.0)):
        movement = np.zeros(6)
        movement[part] = size * direction
        runs = 4000
        seen = rng.multivariate_normal(movement, spread, runs)
        limits = [upper_limit(step, spread) for step in seen]
        below = np.mean([(lim.rotation, lim.translation)[part.start // 3] < size for lim in limits])
        assert below < 1 - CONFIDENCE + 4 * np.sqrt(0.05 / runs)
        assert below >= missed / 3


def test_same_is_reported_within_as_little_as_the_data_tell() -> None:
    rng = np.random.default_rng(7)
    T, spread = se3.random(rng), covariance(rng, 2e-4, 8e-3)
    for seed in range(40):
        own = np.random.default_rng(seed)
        one, other = drawn(T, spread, own), drawn(T, spread, own)
        answer = compare_poses(one, other, "poles")
        if answer.status == "moved":
            continue
        assert answer.step is not None
        assert answer.covariance is not None
        limit = upper_limit(answer.step, answer.covariance)
        assert answer.tolerance == DEFAULT_TOLERANCE.or_wider(limit)
        codes = [r.code for r in answer.reasons]
        if limit.is_within(DEFAULT_TOLERANCE):
            assert (answer.status, codes) == ("same", [])
        elif limit.is_within(WIDEST_TOLERANCE):
            assert (answer.status, codes) == ("same", ["wider_tolerance"])
            assert answer.tolerance.in_words in answer.reasons[0].message
        else:
            assert (answer.status, codes) == ("cannot_tell", ["too_weak"])
        # Of what is asked for, the same data confirm all that is no narrower than that.
        for factor in (0.9, 1.1):
            asked = RequestedTolerance(factor * limit.rotation, factor * limit.translation)
            held = compare_poses(one, other, "poles", asked)
            assert held.status == ("same" if factor > 1 else "cannot_tell")
            assert [r.code for r in held.reasons] == ([] if factor > 1 else ["too_weak"])
            assert held.tolerance == asked.least.or_wider(limit)


def test_each_part_of_the_tolerance_is_held_to_by_itself() -> None:
    rng = np.random.default_rng(8)
    T, weak = se3.random(rng), covariance(rng, 1e-4, 1e-2)
    pose = PoseEstimate(T, weak, 0.0)
    assert (
        compare_poses(pose, pose, "poles", RequestedTolerance(rotation=np.radians(0.3))).status
        == "same"
    )
    assert (
        compare_poses(pose, pose, "poles", RequestedTolerance(translation=0.01)).status
        == "cannot_tell"
    )


def test_what_no_surface_holds_is_not_confirmed_by_the_search_for_it() -> None:
    rng = np.random.default_rng(9)
    T, spread = se3.random(rng), covariance(rng)
    along = spread + np.diag([0, 0, 0, WIDEST_TOLERANCE.translation**2, 0, 0])
    one, other = PoseEstimate(T, spread, 0.0), PoseEstimate(T, along, 0.0)
    for asked in (RequestedTolerance(), RequestedTolerance(1.0, 1.0)):
        answer = compare_poses(one, other, "scene", asked)
        assert (answer.status, [r.code for r in answer.reasons]) == ("cannot_tell", ["too_weak"])
    assert compare_poses(one, other, "poles", RequestedTolerance(1.0, 1.0)).status == "same"


def test_what_was_taken_back_confirms_nothing() -> None:
    T, spread = se3.random(np.random.default_rng(0)), covariance(np.random.default_rng(1))
    answer = compare_poses(PoseEstimate(T, spread, 0.0), PoseEstimate(T, spread, 0.0), "poles")
    assert answer.status == "same"
    back = answer.withdrawn()
    assert (back.status, back.tolerance, back.chi2) == ("cannot_tell", None, answer.chi2)


def test_the_weaker_of_both_poses_is_named() -> None:
    rng = np.random.default_rng(7)
    T = se3.random(rng)
    certain, uncertain = (
        PoseEstimate(T, covariance(rng), 0.0),
        PoseEstimate(T, covariance(rng, 0.01, 0.05), 0.0),
    )
    for stored, new, blamed in ((certain, uncertain, "new"), (uncertain, certain, "stored")):
        answer = compare_poses(stored, new, "poles")
        assert answer.status == "cannot_tell"
        assert [r.code for r in answer.reasons] == ["too_weak"]
        assert f"the {blamed} " in answer.reasons[0].message
    far = PoseEstimate(se3.retract(T, np.r_[0, 0, 0, 1.0, 0, 0]), uncertain.covariance, 0.0)
    answer = compare_poses(certain, far, "poles")
    assert (answer.status, answer.tolerance) == ("moved", None)
    assert [r.code for r in answer.reasons] == ["size_unsure"]


def test_a_movement_below_the_tolerance_is_reported_as_such() -> None:
    rng = np.random.default_rng(8)
    T, spread = se3.random(rng), covariance(rng, 1e-6, 1e-5)
    near = PoseEstimate(se3.retract(T, np.r_[0, 0, 1e-4, 0.001, 0, 0]), spread, 0.0)
    answer = compare_poses(PoseEstimate(T, spread, 0.0), near, "poles")
    assert answer.status == "same"
    assert [r.code for r in answer.reasons] == ["within_tolerance"]
    assert answer.p_value is not None
    assert answer.p_value < FALSE_ALARM
    assert (
        compare_poses(
            PoseEstimate(T, spread, 0.0), near, "poles", RequestedTolerance(1e-5, 1e-3)
        ).status
        == "moved"
    )


def test_properties_of_an_answer_without_pose() -> None:
    nothing = CheckResult("cannot_tell", ())
    assert nothing.rotation is None
    assert nothing.translation is None


SCALE = np.repeat([3e-4, 2e-3], 3)


def any_covariance(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(6, 6)) * SCALE[:, None] / np.sqrt(6)
    return np.asarray(A @ A.T + np.diag(SCALE**2) / 10)


def floor_free(stored: Array, new: Array) -> Array:
    """Give what is kept, less what is kept of nothing but the floor."""
    tiny = 1e-12 * np.diag(SCALE**2)
    return kept(stored, new) - kept(tiny, tiny)


def test_of_equal_errors_the_part_is_kept_that_does_not_repeat() -> None:
    S = covariance(np.random.default_rng(0))
    np.testing.assert_allclose(floor_free(S, S), 2 * (1 - REPEATED) * S, atol=1e-12, rtol=1e-6)


def test_a_pose_from_elsewhere_shares_nothing() -> None:
    S, none = covariance(np.random.default_rng(1)), np.zeros((6, 6))
    np.testing.assert_allclose(kept(S, none), S)
    np.testing.assert_allclose(kept(none, S), S)
    np.testing.assert_allclose(kept(none, none), none)


def test_errors_of_other_directions_do_not_cancel() -> None:
    rng = np.random.default_rng(2)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0] * 1e-2
    one, other = np.diag([1.0, 1, 1, 1e-8, 1e-8, 1e-8]), np.diag([1e-8, 1e-8, 1e-8, 1.0, 1, 1])
    one, other = (axes @ each @ axes.T for each in (one, other))
    np.testing.assert_allclose(floor_free(one, other), one + other, atol=1e-7)


def test_units_axes_and_which_is_stored_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    one, other = any_covariance(rng), any_covariance(rng)
    J = rng.normal(size=(6, 6))
    plain = floor_free(one, other)
    np.testing.assert_allclose(floor_free(other, one), plain, atol=1e-12)
    np.testing.assert_allclose(
        floor_free(J @ one @ J.T, J @ other @ J.T), J @ plain @ J.T, atol=1e-9, rtol=1e-4
    )


@pytest.mark.parametrize("alike", [True, False])
def test_it_holds_the_scatter_of_errors_that_repeat(alike: bool) -> None:
    """Errors b of the devices move the poses by A b and A' b, or alike, and repeat to ρ."""
    rng = np.random.default_rng(4)
    A = rng.normal(size=(6, 20)) * SCALE[:, None]
    B = A if alike else A + 0.5 * rng.normal(size=(6, 20)) * SCALE[:, None]
    covered = kept(A @ A.T, B @ B.T)
    b = rng.normal(size=(2000, 20))
    again = REPEATED * b + np.sqrt(1 - REPEATED**2) * rng.normal(size=b.shape)
    steps = again @ B.T - b @ A.T
    square = np.einsum("ni,ij,nj->n", steps, np.linalg.inv(covered), steps)
    # χ² with 6 degrees of freedom has a mean of 6; the floor makes it less.
    assert (3.0 if alike else 4.0) < square.mean() < (6.0 if alike else 12.0)


def test_random_errors_add_up() -> None:
    rng = np.random.default_rng(5)
    R, Q, S = (any_covariance(rng) for _ in range(3))
    both = step_covariance(Uncertainty(R, S), Uncertainty(Q, S))
    np.testing.assert_allclose(both - kept(S, S), R + Q)
    assert np.linalg.eigvalsh(R + Q + 2 * S - both).min() > -1e-5
