"""KISS-Matcher: which of the voxels it tries decides."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.evaluation.rivals.kiss import ENOUGH_INLIERS, KISS_VOXELS, best_match

CLOUD = PointCloud(np.zeros((100, 3)))


@dataclass
class FakeMatching:
    """Answers each voxel with a translation by it, and the inliers that it is told."""

    inliers: dict[float, int]
    invalid: tuple[float, ...] = ()
    tried: list[float] = field(default_factory=list)

    def KISSMatcherConfig(self, voxel: float) -> float:
        return voxel

    def KISSMatcher(self, voxel: float) -> SimpleNamespace:
        self.tried.append(voxel)
        solution = SimpleNamespace(
            valid=voxel not in self.invalid,
            rotation=np.eye(3),
            translation=np.array([voxel, 0.0, 0.0]),
        )

        def estimate(source: Array, target: Array) -> SimpleNamespace:
            assert source.dtype == target.dtype == np.float32
            return solution

        return SimpleNamespace(
            estimate=estimate, get_num_final_inliers=lambda: self.inliers.get(voxel, 0)
        )


@pytest.mark.parametrize("best", KISS_VOXELS)
def test_the_voxel_with_the_most_inliers_decides(best: float) -> None:
    few = dict.fromkeys(KISS_VOXELS, 3) | {best: ENOUGH_INLIERS - 1}
    matching = FakeMatching(few)
    found = best_match(matching, CLOUD, CLOUD)
    assert matching.tried == list(KISS_VOXELS), "none has enough: all are tried"
    assert found.inliers == ENOUGH_INLIERS - 1
    assert found.start[0, 3] == best


def test_no_further_voxel_is_tried_once_there_are_enough() -> None:
    matching = FakeMatching({KISS_VOXELS[0]: ENOUGH_INLIERS, KISS_VOXELS[1]: 10 * ENOUGH_INLIERS})
    assert best_match(matching, CLOUD, CLOUD).inliers == ENOUGH_INLIERS
    assert matching.tried == [KISS_VOXELS[0]]


def test_what_it_calls_invalid_does_not_count() -> None:
    matching = FakeMatching(dict.fromkeys(KISS_VOXELS, 100), invalid=KISS_VOXELS[:1])
    assert best_match(matching, CLOUD, CLOUD).start[0, 3] == KISS_VOXELS[1]
    assert best_match(FakeMatching({}, invalid=KISS_VOXELS), CLOUD, CLOUD).inliers == 0
