"""Many frames of a static scene: what moved goes, what stands stays."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import BoolArray, Placement, PointCloud, Scan
from retropole.base.errors import Reason, Refusal
from retropole.checking.metrics import e_rt
from retropole.extraction.poles import extract_poles
from retropole.io.recordings import time_of_recording
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.static import (
    MAX_APART,
    check_recordings,
    check_static,
    check_still,
    other_times,
    pole_drift,
    recorded_together,
    remove_dynamic_points,
    turned_by,
    without_copies,
)
from tests.tiers import first_of

FRAMES = 6


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(3), frames=FRAMES)


def with_walker(cloud: PointCloud) -> tuple[PointCloud, BoolArray]:
    """Add a person who walks by, 1 m a frame; tell which points are theirs."""
    rng = np.random.default_rng(0)
    people, frames = [], []
    for k in range(FRAMES):
        body = rng.uniform(-1, 1, (150, 3)) * [0.15, 0.15, 0.6]
        people.append(body + np.array([2.5, -2.5 + k, -0.4]))
        frames.append(np.full(150, k))
    assert cloud.frame is not None
    assert cloud.intensity is not None
    walker = np.concatenate(people)
    joined = PointCloud(
        np.concatenate([cloud.xyz, walker]),
        intensity=np.concatenate([cloud.intensity, np.full(len(walker), 20.0)]),
        frame=np.concatenate([cloud.frame, *frames]),
    )
    return joined, np.arange(len(joined)) >= len(cloud)


@pytest.mark.full
def test_a_walker_goes_and_the_scene_stays(street: SimulatedPair) -> None:
    cloud, walks = with_walker(street.target)
    left = remove_dynamic_points(cloud)
    kept = np.isin(cloud.xyz[:, 0], left.xyz[:, 0])
    # Where no other frame has a return there is no telling.
    assert np.mean(kept[walks]) < 0.35
    assert np.mean(kept[~walks]) > 0.97


@pytest.mark.full
def test_poles_stay_whole(street: SimulatedPair) -> None:
    first = len(street.surfaces) - len(street.poles)
    on_poles = street.target.xyz[street.labels[0] >= first]
    left = remove_dynamic_points(street.target)
    assert np.mean(np.isin(on_poles[:, 0], left.xyz[:, 0])) > 0.98


@pytest.mark.full
def test_few_frames_are_left_alone(street: SimulatedPair) -> None:
    single = replace(street.target, frame=None)
    assert remove_dynamic_points(single) is single
    two = street.target.select(np.asarray(street.target.frame) < 2)
    assert remove_dynamic_points(two) is two


@pytest.mark.full
def test_a_pole_that_moves_is_refused(street: SimulatedPair) -> None:
    cloud = street.target
    poles = extract_poles(cloud).poles
    check_static("target", cloud, poles)
    assert cloud.frame is not None
    pole = poles[0]
    frame = cloud.frame[pole.index]
    distance, sigma = pole_drift(pole, frame)
    assert distance < 5 * sigma
    sideways = np.cross(pole.direction, [1.0, 0.0, 0.0])
    moved = replace(pole, xyz=pole.xyz + 0.1 * (frame >= 3)[:, None] * sideways)
    with pytest.raises(Refusal) as refusal:
        check_static("target", cloud, [moved])
    assert refusal.value.code == "moving_pole"


@pytest.mark.nightly
def test_frames_average_the_noise_away() -> None:
    """Compared scene by scene: which scenes are refused differs between one sweep and ten."""
    ratios: list[float] = []
    for seed in range(8):
        pair = simulate_pair("bare", np.random.default_rng(seed), frames=10)
        single = [
            replace(cloud.select(np.asarray(cloud.frame) == 0), frame=None)
            for cloud in (pair.target, pair.source)
        ]
        poses = [
            calibrate(*clouds, options=Options(scene=False)).T_target_source
            for clouds in ((pair.target, pair.source), single)
        ]
        errors = [e_rt(T, pair.T_target_source) for T in poses if T is not None]
        if len(errors) == 2:
            ratios.append(errors[0] / errors[1])
    assert len(ratios) >= 6
    # Returns on the tape average, the sensors' systematic errors do not.
    assert 0.3 < np.exp(np.mean(np.log(ratios))) < 0.8


def bumped(cloud: PointCloud, angle: float, frames: int = FRAMES) -> PointCloud:
    """Turn a LiDAR before the second half of its frames."""
    assert cloud.frame is not None
    R = se3.exp_so3(angle * np.array([0.0, 0.6, 0.8]))
    late = (cloud.frame >= frames // 2)[:, None]
    return replace(cloud, xyz=np.where(late, cloud.xyz @ R.T, cloud.xyz))


@pytest.mark.parametrize("degrees", [0.6, 2.0, 5.0])
@pytest.mark.full
def test_a_lidar_that_turned_while_it_recorded_is_refused(
    street: SimulatedPair, degrees: float
) -> None:
    moved = remove_dynamic_points(bumped(street.target, np.radians(degrees)))
    assert turned_by(moved) == pytest.approx(np.radians(degrees), rel=0.05)
    with pytest.raises(Refusal) as refusal:
        check_still("target", moved)
    assert refusal.value.code == "moving_lidar"
    assert "target" in str(refusal.value)


@pytest.mark.full
def test_a_lidar_that_stood_did_not_turn(street: SimulatedPair) -> None:
    for cloud in (street.target, street.source, replace(street.target, frame=None)):
        assert turned_by(cloud) < np.radians(0.1)
        check_still("target", cloud)


@pytest.fixture(scope="module", params=first_of([1000, 1001]))
def sparse(request: pytest.FixtureRequest) -> SimulatedPair:
    """Two LiDARs whose sweeps are sparse and never meet the same points, where little holds."""
    seed: int = request.param
    rng = np.random.default_rng(seed)
    return simulate_pair("corridor", rng, sensor_target="Mid-360", sensor_source="Mid-360")


@pytest.mark.parametrize("frames", first_of([3, 2, 5, 6]))
def test_single_sparse_sweeps_are_no_turn(sparse: SimulatedPair, frames: int) -> None:
    """Of the 32 recordings, GICP turns two by more than is allowed."""
    for seed in range(2):
        again = record_again(sparse, np.random.default_rng(seed), frames=frames)
        for cloud in (again.target, again.source):
            check_still("target", remove_dynamic_points(cloud))


@pytest.mark.parametrize("degrees", [0.5, 2.0])
@pytest.mark.full
def test_a_sparse_lidar_that_turned_is_refused(sparse: SimulatedPair, degrees: float) -> None:
    again = record_again(sparse, np.random.default_rng(0), frames=8)
    for cloud in (again.target, again.source):
        moved = remove_dynamic_points(bumped(cloud, np.radians(degrees), 8))
        with pytest.raises(Refusal, match="turned by"):
            check_still("target", moved)


@pytest.mark.full
def test_a_bumped_lidar_gives_no_answer(street: SimulatedPair) -> None:
    answer = calibrate(bumped(street.target, np.radians(1.0)), street.source)
    assert answer.status == "refused"
    assert answer.reasons[0].code == "moving_lidar"


HOUR = 3600.0
NOON = 1_700_000_000.0


def recorded_at(first: float, last: float, as_points: bool = False) -> PointCloud:
    xyz = np.array([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    if as_points:
        return PointCloud(xyz, time=np.array([first, last]))
    return PointCloud(xyz, recorded=(first, last))


def said_of(target: PointCloud, source: PointCloud) -> list[Reason]:
    return list(other_times([Placement(Scan(target), Scan(source))]))


@pytest.mark.parametrize("as_points", [False, True])
def test_recordings_of_other_times_are_told_apart(as_points: bool) -> None:
    target = recorded_at(NOON, NOON + 10, as_points)
    for apart, is_other in ((0.9 * MAX_APART, False), (1.1 * MAX_APART, True), (-5.0, False)):
        for start in (NOON + 10 + apart, NOON - apart - 10):
            said = said_of(target, recorded_at(start, start + 10, as_points))
            assert [reason.code for reason in said] == ["other_times"] * is_other
            if is_other:
                assert said[0].values["apart_s"] == pytest.approx(apart)
    (later,) = said_of(target, recorded_at(NOON + 3 * HOUR + 10, NOON + 3 * HOUR + 20))
    assert "differ by 3.0 h" in later.message
    assert "were still in between" in later.message


def test_clocks_that_show_no_date_say_nothing() -> None:
    dated = recorded_at(NOON, NOON + 1)
    unknown = PointCloud(np.ones((2, 3)))
    assert said_of(dated, unknown) == said_of(unknown, dated) == said_of(unknown, unknown) == []
    # Seconds since the sensor was switched on, of the week, or of the sweep.
    for start in (0.0, 245_370.0, 4e8):
        assert said_of(dated, recorded_at(start, start + 0.1, as_points=True)) == []


def test_of_several_placements_the_one_is_named() -> None:
    good, bad = recorded_at(NOON, NOON + 1), recorded_at(NOON + HOUR, NOON + HOUR + 1)
    pairs = [Placement(Scan(good), Scan(good)), Placement(Scan(good), Scan(bad))]
    (reason,) = other_times(pairs)
    assert reason.values["placement"] == 2
    assert "of placement 2" in reason.message


def test_recordings_that_overlap_were_made_together() -> None:
    """Only where both clocks show dates, and of every placement; whichever is the target."""
    target, unknown = recorded_at(NOON, NOON + 10), PointCloud(np.ones((2, 3)))
    for start, overlaps in ((-20.0, False), (-10.5, False), (-9.0, True), (9.0, True), (11, False)):
        source = recorded_at(NOON + start, NOON + start + 10)
        both = Placement(Scan(target), Scan(source)), Placement(Scan(source), Scan(target))
        assert [recorded_together([each]) for each in both] == [overlaps] * 2
        with_itself = Placement(Scan(target), Scan(target))
        assert recorded_together([with_itself, both[0]]) == overlaps
    assert not recorded_together([Placement(Scan(target), Scan(unknown))])


def test_points_times_go_before_those_of_the_recorder() -> None:
    both = replace(recorded_at(NOON, NOON + 1, as_points=True), recorded=(NOON + HOUR, NOON + HOUR))
    assert time_of_recording(both) == (NOON, NOON + 1)
    assert time_of_recording(replace(both, time=np.zeros(2))) == (NOON + HOUR, NOON + HOUR)


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
    with pytest.raises(Refusal, match=f"{words} are one recording.*separate recordings"):
        check((cloud(1), cloud(2)), (cloud(second[0]), cloud(second[1])))


def test_nothing_is_no_copy() -> None:
    empty = PointCloud(np.zeros((0, 3)))
    check((empty, cloud(1)))
    check((cloud(1), empty))
    assert len(without_copies(empty)) == 0
