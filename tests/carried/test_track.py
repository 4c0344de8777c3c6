"""The carried pole among what stands: found in each sweep, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import Threshold
from retropole.carried import expected as expected_module
from retropole.carried import track as track_module
from retropole.carried.expected import AGAIN, BARREN, Expected
from retropole.carried.track import (
    Beams,
    Found,
    Search,
    Sweep,
    _longest_way,
    _moving,
    _poles_in,
    find_track,
)
from retropole.extraction.poles import extract_poles
from retropole.simulation import EXACT, FIELD
from retropole.simulation.walks import simulate_walk
from tests.carried.walks import RADIUS, seen_walk


def found(sweep: int, x: float) -> Found:
    """A pole in one sweep at a place along x, metres."""
    none = np.zeros(0, dtype=np.int64)
    return Found(
        sweep, 0.1 * sweep, np.array([x, 4.0, 0.0]), np.array([0.0, 0.0, 1.0]),
        np.zeros((0, 3)), np.zeros(0), none, none.astype(bool),
    )  # fmt: skip


def test_what_stands_is_left_out_and_a_pole_that_rests_is_not() -> None:
    standing = [found(k, -3.0) for k in range(100)]
    carried = [found(k, 0.08 * max(k - 30, 0)) for k in range(100)]
    kept = _moving(sorted(standing + carried, key=lambda each: each.sweep), 100)
    assert len(kept) == 100
    assert min(each.point[0] for each in kept) >= 0.0


def test_a_way_that_nobody_walks_is_not_taken() -> None:
    carried = [found(k, 0.08 * k) for k in range(50)]
    elsewhere = [found(k, 20.0 + 3.0 * k) for k in range(0, 50, 7)]
    way = _longest_way(sorted(carried + elsewhere, key=lambda each: each.sweep))
    assert [each.sweep for each in way] == list(range(50))
    assert max(each.point[0] for each in way) < 10.0


def test_points_without_times_are_refused() -> None:
    cloud = PointCloud(np.ones((5, 3)), np.arange(5.0))
    with pytest.raises(Refusal) as refused:
        find_track([cloud])
    assert refused.value.reason.code == "no_times"


def test_recordings_without_a_walk_are_refused() -> None:
    cloud = PointCloud(np.ones((5, 3)), np.arange(5.0), time=np.zeros(5))
    with pytest.raises(Refusal) as refused:
        find_track([cloud, replace(cloud)])
    assert refused.value.reason.code == "no_walk"


@pytest.mark.full
def test_the_carried_pole_is_found_in_a_street() -> None:
    walk = simulate_walk("street", np.random.default_rng(3), seconds=8.0, noise=EXACT)
    recorder = walk.recorders[0]
    track = find_track(walk.record(0, np.random.default_rng(1)), recorder.sensor)
    assert len(track.times) > 50
    T = np.linalg.inv(recorder.T_world_sensor)
    times = track.stamps
    away = walk.walks[0].hand(times) @ T[:3, :3].T + T[:3, 3] - track.xyz
    along = walk.walks[0].axis(times) @ T[:3, :3].T
    across = away - np.einsum("ni,ni->n", away, along)[:, None] * along
    assert np.linalg.norm(across, axis=1).max() < walk.walks[0].size[0] + 1e-6


def test_a_pole_is_found_where_nothing_else_is_near() -> None:
    track = seen_walk(1.0).tracks[0]
    pole = track.xyz[track.sweep == 0]
    around = np.linspace(1.0, 5.0, 400)
    far = 20.0 * np.stack([np.cos(around), np.sin(around), 0.05 * np.cos(9 * around)], axis=1)
    cloud = PointCloud(
        np.concatenate([pole, far]),
        np.repeat([255.0, 10.0], [len(pole), len(far)]),
        time=np.zeros(len(pole) + len(far)),
    )
    sweep = Sweep(0, cloud, Beams(np.eye(4), None), Threshold(200.0, "given"))
    poles = _poles_in(sweep, None, RADIUS, Expected())
    assert len(poles) == 1
    assert len(poles[0].xyz) >= len(pole) - 2


def test_a_sign_is_searched_again_now_and_then_and_a_pole_before_it_always(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pole = seen_walk(1.0).tracks[0]
    pole_xyz = pole.xyz[pole.sweep == 0]
    y, z = (each.ravel() for each in np.meshgrid(np.linspace(-0.5, 0.5, 11), np.arange(0, 1, 0.1)))
    sign = np.stack([np.full(len(y), 9.05), y + 0.05, z + 0.05], axis=1)
    around = np.linspace(1.0, 5.0, 400)
    far = 20.0 * np.stack([np.cos(around), np.sin(around), 0.05 * np.cos(9 * around)], axis=1)
    searched = []

    def counted(part: PointCloud, **options: object) -> object:
        searched.append(len(part))
        return extract_poles(part, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(track_module, "extract_poles", counted)
    expected = Expected()

    def poles_in(bright: np.ndarray, sweep: int) -> int:
        intensity = np.repeat([255.0, 10.0], [len(bright), len(far)])
        times = np.full(len(intensity), 0.1 * sweep)
        cloud = PointCloud(np.concatenate([bright, far]), intensity, time=times)
        seen = Sweep(sweep, cloud, Beams(np.eye(4), None), Threshold(200.0, "given"))
        return len(_poles_in(seen, None, RADIUS, expected))

    assert sum(poles_in(sign, k) for k in range(1, 41)) == 0
    assert len(searched) == BARREN + 40 // AGAIN
    # As it comes near to the sign, both are one cluster, and its ends are others.
    before = pole_xyz + np.array([8.4, 0.9, 0.0]) - pole_xyz.mean(axis=0) * [1, 1, 0]
    count = len(searched)
    assert [poles_in(np.concatenate([sign, before]), k) for k in range(41, 49)] == [1] * 8
    assert len(searched) == count + 8


def test_the_track_is_the_same_where_every_sweep_is_searched_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    walk = simulate_walk("street", np.random.default_rng(7), seconds=8.0, noise=FIELD)
    sweeps = list(walk.record(0, np.random.default_rng(1)))
    searched = []

    def counted(part: PointCloud, **options: object) -> object:
        searched.append(len(part))
        return extract_poles(part, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(track_module, "extract_poles", counted)
    track = find_track(sweeps, walk.recorders[0].sensor)
    count = len(searched)
    monkeypatch.setattr(expected_module, "AGAIN", 1)
    whole = find_track(sweeps, walk.recorders[0].sensor)
    assert len(searched) > 2 * count + 20
    assert len(track.times) > 50
    for name in ("times", "points", "directions", "xyz", "stamps", "rings", "sweep", "is_whole"):
        np.testing.assert_array_equal(getattr(track, name), getattr(whole, name))


def test_a_second_pole_that_comes_late_is_noticed() -> None:
    seen = seen_walk(8.0).tracks[0]
    around = np.linspace(1.0, 5.0, 400)
    far = 20.0 * np.stack([np.cos(around), np.sin(around), 0.05 * np.cos(9 * around)], axis=1)
    sideways = np.array([[0.6, 0.0, 0.0], [0.0, 0.6, 0.0]])
    search, late = Search(radius=RADIUS, threshold=200.0), 33
    found = []
    for k in range(len(seen.times)):
        own = seen.xyz[seen.sweep == k]
        # The other is carried 5 m and more away.
        poles = [own] if k < late else [own, own[:, [1, 0, 2]] * [-1, 1, 1]]
        beside = [each.mean(axis=0) + sideways for each in poles]
        bright, dim = np.concatenate(poles), np.concatenate([*beside, far])
        xyz, times = np.concatenate([bright, dim]), np.full(len(bright) + len(dim), seen.times[k])
        intensity = np.repeat([255.0, 10.0], [len(bright), len(dim)])
        found.append(len(search.add(PointCloud(xyz, intensity, time=times))))
    assert found[:late] == [1] * late
    assert found[40:] == [2] * (len(found) - 40)
    assert search.track().crowded == pytest.approx(0.5, abs=0.02)
