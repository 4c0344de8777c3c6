"""What is there twice was measured once."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.base.errors import Refusal
from retropole.surfaces.static import check_recordings, without_copies


def cloud(seed: int, count: int = 4000) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(rng.normal(size=(count, 3)) * 10, rng.uniform(0, 255, count))


def test_points_given_twice_count_once() -> None:
    once = cloud(1)
    assert without_copies(once) is once
    twice = once.select(np.repeat(np.arange(len(once)), 3))
    np.testing.assert_array_equal(without_copies(twice).xyz, once.xyz)


def test_the_same_point_of_two_sweeps_was_measured_twice() -> None:
    sweep, half = cloud(1), len(cloud(1)) // 2
    both = replace(
        sweep.select(np.r_[np.arange(len(sweep)), np.arange(half)]),
        frame=np.repeat(np.arange(2), [len(sweep), half]),
    )
    assert without_copies(both) is both


def test_a_sweep_that_is_repeated_counts_once() -> None:
    rng = np.random.default_rng(0)
    sweeps = [rng.normal(size=(50, 3)) for _ in range(2)]
    order = [0, 1, 0, 0, 1]
    xyz = np.concatenate([rng.permutation(sweeps[k]) for k in order])
    cloud = PointCloud(xyz, frame=np.repeat(np.arange(5), 50))
    kept = without_copies(cloud)
    assert kept.frame is not None
    assert np.unique(kept.frame).tolist() == [0, 1]
    np.testing.assert_array_equal(kept.xyz, xyz[:100])
    # One that shares all but a point is another.
    xyz[-1] += 1e-9
    kept = without_copies(replace(cloud, xyz=xyz))
    assert kept.frame is not None
    assert np.unique(kept.frame).tolist() == [0, 1, 4]


def test_points_that_differ_in_one_coordinate_differ() -> None:
    xyz = np.array([[1.0, 2, 3], [1, 2, 4], [1, 3, 2], [2, 1, 3], [3, 2, 1], [-1, 2, 3]])
    assert len(without_copies(PointCloud(xyz))) == len(xyz)
    assert len(without_copies(PointCloud(np.array([[0.0, 1, 1], [-0.0, 1, 1]])))) == 1


def check(*pairs: tuple[PointCloud, PointCloud]) -> None:
    check_recordings([Placement(Scan(target), Scan(source)) for target, source in pairs])


@pytest.mark.parametrize(("share", "refused"), [(0.3, False), (0.45, False), (0.6, True)])
def test_a_recording_that_is_mostly_the_other_is_refused(share: float, refused: bool) -> None:
    target, other = cloud(1), cloud(2)
    count = int(share * len(target))
    rng = np.random.default_rng(0)
    order = rng.permutation(len(target))
    source = PointCloud(np.concatenate([target.xyz[:count], other.xyz[count:]])[order])
    if not refused:
        check((target, source))
        return
    with pytest.raises(Refusal, match="the target and the source are one recording") as why:
        check((target, source))
    assert why.value.code == "same_recording"
    assert why.value.values["shared"] == pytest.approx(share, abs=0.05)


def test_one_sweep_of_many_is_found_whichever_side_it_is_on() -> None:
    sweeps = PointCloud(np.concatenate([cloud(k).xyz for k in range(10)]))
    for pair in ((cloud(3), sweeps), (sweeps, cloud(3))):
        with pytest.raises(Refusal, match="one recording"):
            check(pair)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        ((1, 4), "the target of placement 1 and the target of placement 2"),
        ((4, 2), "the source of placement 1 and the source of placement 2"),
        ((2, 4), "the source of placement 1 and the target of placement 2"),
    ],
)
def test_each_placement_has_recordings_of_its_own(second: tuple[int, int], words: str) -> None:
    check((cloud(1), cloud(2)), (cloud(3), cloud(4)))
    with pytest.raises(Refusal, match=f"{words} are one recording.*recordings of its own"):
        check((cloud(1), cloud(2)), (cloud(second[0]), cloud(second[1])))


def test_nothing_is_no_copy() -> None:
    empty = PointCloud(np.zeros((0, 3)))
    check((empty, cloud(1)))
    check((cloud(1), empty))
    assert len(without_copies(empty)) == 0
