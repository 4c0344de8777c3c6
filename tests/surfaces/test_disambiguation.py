import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Match, PointCloud
from retropole.base.errors import Refusal
from retropole.surfaces.disambiguation import score_hypotheses
from tests.surfaces.conftest import flipped


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
