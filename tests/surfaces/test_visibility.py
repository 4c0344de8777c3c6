"""Overlap and free space: what two views of one place must agree on, and what they may not know."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Match, PointCloud
from retropole.base.errors import Refusal
from retropole.surfaces.visibility import (
    IMAGE_SHAPE,
    Cells,
    cells_of,
    compare_views,
    free_space_violation,
    nearest_around,
    nearest_by_frame,
    overlap,
    range_image,
    score_hypotheses,
    view_of,
)
from tests.surfaces.conftest import flipped


@pytest.mark.parametrize("shift", [[8.0, 0, 0], [0, 20.0, 5.0], [3.0, -2.0, 10.0]])
def test_a_wrong_beam_origin_does_not_turn_free_space_against_the_truth(
    views: tuple[PointCloud, PointCloud, Array], shift: list[float]
) -> None:
    target, source, T = views
    T_shift = se3.from_rt(np.eye(3), np.array(shift))
    lost = PointCloud(se3.apply(T_shift, target.xyz))
    image = range_image(lost)
    assert free_space_violation(image, se3.apply(T_shift @ T, source.xyz)) < 0.03


def test_free_space_knows_what_it_did_not_look_at() -> None:
    ahead = PointCloud(np.array([[10.0, 0.0, 0.0]]))
    image = range_image(ahead)
    assert free_space_violation(image, np.array([[5.0, 0.0, 0.0]])) == 1.0, "looked through there"
    assert free_space_violation(image, np.array([[15.0, 0.0, 0.0]])) == 0.0, "hidden behind"
    assert free_space_violation(image, np.array([[0.0, 5.0, 0.0]])) == 0.0, "never looked there"
    assert free_space_violation(image, np.array([[9.8, 0.0, 0.0]])) == 0.0, (
        "within the pose's error"
    )


def test_a_map_looked_through_nothing_and_what_is_beyond_the_view_counts_for_nothing(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    """Of a map many times as large as the view, what a LiDAR sees of it decides alone."""
    target, source, T = views
    rng = np.random.default_rng(0)
    beyond = rng.uniform([500.0, -50.0, 0.0], [600.0, 50.0, 9.0], (20_000, 3))
    seen = [
        compare_views(view_of(one, 0.25), view_of(source, 0.25), T, within=0.5)
        for one in (
            replace(target, is_map=True),
            replace(target, xyz=np.r_[target.xyz, beyond], intensity=None, ring=None, is_map=True),
        )
    ]
    assert seen[0].overlap == seen[1].overlap > 0.3
    assert seen[0].free_space_violation == seen[1].free_space_violation < 0.03
    assert seen[0].covisible_overlap == seen[1].covisible_overlap
    image = range_image(replace(target, is_map=True))
    assert free_space_violation(image, source.xyz) == 0.0
    aside = se3.retract(T, np.array([0, 0, 0.6, 0.0, 0.0, 0.0]))
    wrong = compare_views(
        view_of(replace(target, is_map=True), 0.25), view_of(source, 0.25), aside, within=0.5
    )
    assert wrong.overlap < seen[0].overlap
    assert wrong.free_space_violation > seen[0].free_space_violation


def test_every_direction_has_a_cell() -> None:
    rays = np.random.default_rng(1).normal(size=(5000, 3))
    extremes = np.concatenate([rays, np.eye(3), -np.eye(3)])
    cells = cells_of(extremes)
    assert cells.row.min() >= 0
    assert cells.row.max() < IMAGE_SHAPE[0]
    assert cells.column.min() >= 0
    assert cells.column.max() < IMAGE_SHAPE[1]
    farther = cells_of(7.0 * rays)
    np.testing.assert_array_equal(farther.row, cells_of(rays).row)
    np.testing.assert_array_equal(farther.column, cells_of(rays).column)


def test_the_least_ranges_of_each_frame_are_those_of_its_own_returns() -> None:
    rng = np.random.default_rng(2)
    rays, frame = rng.normal(size=(6000, 3)), rng.integers(3, size=6000)
    ranges, cells = se3.lengths(rays), cells_of(rays)
    found = nearest_by_frame(cells, ranges, frame, 4)
    for k in range(4):
        own = frame == k
        alone = nearest_around(Cells(cells.row[own], cells.column[own]), ranges[own])
        np.testing.assert_array_equal(found[k], alone.ranges)


def test_exchanging_the_views_changes_nothing(views: tuple[PointCloud, PointCloud, Array]) -> None:
    target, source, T = views
    forth = compare_views(view_of(target, 0.2), view_of(source, 0.2), T, within=0.3)
    back = compare_views(view_of(source, 0.2), view_of(target, 0.2), se3.inverse(T), within=0.3)
    assert forth.overlap == pytest.approx(back.overlap)
    assert forth.free_space_violation == pytest.approx(back.free_space_violation)


def test_the_right_pose_agrees_and_a_wrong_one_does_not(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    target, source, T = views
    seen = view_of(target, 0.2), view_of(source, 0.2)
    right = compare_views(*seen, T, within=0.3)
    wrong = compare_views(*seen, flipped(T), within=0.3)
    assert right.overlap > 0.95 > wrong.overlap
    assert right.free_space_violation < 0.02 < wrong.free_space_violation


def test_a_wider_limit_shows_further_neighbours_and_counts_no_more(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    target, source, T = views
    seen = view_of(target, 0.2), view_of(source, 0.2)
    off = T @ se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.4]))
    near = compare_views(*seen, off, within=0.2)
    far = compare_views(*seen, off, within=0.2, limit=2.0)
    assert near.overlap == far.overlap
    assert np.isfinite(far.distances).sum() > np.isfinite(near.distances).sum()


def test_a_sample_is_a_part_of_the_whole(views: tuple[PointCloud, PointCloud, Array]) -> None:
    whole, part = view_of(views[0], 0.2), view_of(views[0], 0.2, 500)
    assert part.size == whole.size
    assert 250 < len(part.points) <= 500
    assert overlap([whole.tree.query(part.points)[0]], 1e-9) == 1.0


def match(T: Array, rms: float = 0.01, exact: bool = True) -> Match:
    return Match(((0, 0), (1, 1)), T, rms, exact, True, np.eye(6))


def test_the_right_hypothesis_has_the_best_score(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    target, source, T = views
    best, other = score_hypotheses(target, source, [match(flipped(T)), match(T)])
    np.testing.assert_array_equal(best.match.T_target_source, T)
    assert best.overlap > 0.95
    assert best.free_space_violation < 0.02
    assert other.free_space_violation > best.free_space_violation
    assert best.score > other.score + 0.2
    assert best.icp_rotation is not None
    assert best.icp_rotation < 0.02


def test_swapping_the_clouds_changes_no_score(views: tuple[PointCloud, PointCloud, Array]) -> None:
    target, source, T = views
    forth = score_hypotheses(target, source, [match(T), match(flipped(T))])
    back = score_hypotheses(source, target, [match(se3.inverse(T)), match(se3.inverse(flipped(T)))])
    for a, b in zip(forth, back, strict=True):
        assert a.overlap == pytest.approx(b.overlap, abs=1e-9)
        assert a.free_space_violation == pytest.approx(b.free_space_violation, abs=1e-9)


@pytest.mark.parametrize("keep_origin", [True, False])
def test_moving_a_cloud_changes_the_choice_in_nothing(
    views: tuple[PointCloud, PointCloud, Array], keep_origin: bool
) -> None:
    target, source, T = views
    A = se3.random(np.random.default_rng(3), 20.0)
    moved = target.transformed(A)
    if not keep_origin:
        moved = PointCloud(moved.xyz)
    hypotheses = score_hypotheses(moved, source, [match(A @ flipped(T)), match(A @ T)])
    np.testing.assert_allclose(hypotheses[0].match.T_target_source, A @ T)
    assert hypotheses[0].score > hypotheses[1].score + 0.2


def test_inexact_matches_come_last_whatever_their_score(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    target, source, T = views
    hypotheses = score_hypotheses(target, source, [match(T, 0.3, False), match(flipped(T))])
    assert [h.match.exact for h in hypotheses] == [True, False]


def test_a_cloud_too_small_to_compare_is_refused(
    views: tuple[PointCloud, PointCloud, Array],
) -> None:
    target, source, T = views
    with pytest.raises(Refusal) as refusal:
        score_hypotheses(target, source.select(np.arange(20)), [match(T)])
    assert refusal.value.code == "too_few_points"
    assert refusal.value.values["lidar"] == "source"
