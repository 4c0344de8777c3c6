"""A pole that moves while few beams find it: where the line is, and which returns are of it."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.carried.moving import Returns, follow
from retropole.simulation import NOISE_MODELS
from retropole.simulation.walks import simulate_walk
from tests.carried.walks import RADIUS, axis_at

T = se3.from_rt(se3.exp_so3(np.array([0.4, -0.2, 1.1])), np.array([1.0, -2.0, 0.5]))
"""To the frame of the LiDAR: nothing depends on how it is mounted."""


def seen(per_sweep: int, seconds: float = 3.0, seed: int = 0) -> Returns:
    """Returns of a carried pole and of a vest beside it, at random times of sweeps of 0.1 s."""
    rng = np.random.default_rng(seed)
    count = int(10 * seconds) * per_sweep
    times = np.sort(rng.uniform(0.0, seconds, count))
    middle, along = axis_at(times)
    on_pole = middle + rng.uniform(-0.9, 0.9, (count, 1)) * along
    on_pole += rng.uniform(-RADIUS, RADIUS, (count, 3))
    beside = rng.random(count) < 0.1
    on_pole[beside] += np.array([0.25, 0.15, 0.0]) + rng.normal(0.0, 0.03, (int(beside.sum()), 3))
    return Returns(
        se3.apply(T, on_pole), times, (times / 0.1).astype(np.int64),
        np.full(count, -1), np.ones(count, dtype=bool),
    )  # fmt: skip


def found_at(times: Array) -> tuple[Array, Array, Array]:
    """Sweeps in which the pole was found, as `follow` takes them."""
    middle, along = axis_at(times)
    return times, se3.apply(T, middle), along @ T[:3, :3].T


def off(times: Array, points: Array, directions: Array) -> tuple[Array, Array]:
    """Distance of points from the true axis at some times, metres, and angles to it, rad."""
    middle, along = axis_at(times)
    away = points - se3.apply(T, middle)
    along = along @ T[:3, :3].T
    away -= np.einsum("ni,ni->n", away, along)[:, None] * along
    turned = np.abs(np.einsum("ni,ni->n", directions, along))
    return np.linalg.norm(away, axis=1), np.arccos(np.clip(turned, 0.0, 1.0))


def test_a_pole_is_followed_from_few_sweeps_to_all() -> None:
    returns = seen(6)
    lines = follow(*found_at(np.array([0.45, 1.55])), returns)
    assert len(lines) > 27
    times, points, directions = (
        np.array([getattr(line, name) for line in lines]) for name in ("time", "point", "direction")
    )
    distance, angle = off(times, points, directions)
    # 30 returns within ± 2 cm: 4 mm; of the motion, which is not even, more.
    assert 1e-3 < np.median(distance) < 0.015
    assert np.degrees(np.median(angle)) < 1.5
    # At both ends, half of a window is seen.
    assert np.degrees(angle.max()) < 8.0


def test_each_return_is_of_its_own_sweep_and_none_of_a_vest() -> None:
    returns = seen(6)
    lines = follow(*found_at(np.array([0.45, 1.55])), returns)
    for line in lines:
        own = returns.select(line.returns)
        assert len(np.unique(own.sweep)) == 1
        distance, _ = off(own.times, own.xyz, np.tile(line.direction, (len(own.times), 1)))
        assert distance.max() < 0.12
    assert len(np.concatenate([line.returns for line in lines])) > 0.75 * len(returns.times)


def test_other_frames_give_the_same_pole() -> None:
    returns, moved = seen(6, seconds=1.5), se3.random(np.random.default_rng(3))
    times, points, directions = found_at(np.array([0.45, 0.95]))
    lines = follow(times, points, directions, returns)
    others = follow(
        times,
        se3.apply(moved, points),
        directions @ moved[:3, :3].T,
        returns._replace(xyz=se3.apply(moved, returns.xyz)),
    )
    assert len(lines) == len(others)
    for one, other in zip(lines, others, strict=True):
        np.testing.assert_array_equal(one.returns, other.returns)
        np.testing.assert_allclose(se3.apply(moved, one.point[None])[0], other.point, atol=1e-6)


def test_too_few_returns_are_no_line() -> None:
    returns = seen(1)
    few = returns.select(np.arange(0, len(returns.times), 3))
    assert follow(*found_at(np.array([1.05, 2.05])), few) == []


@pytest.mark.full
def test_a_walk_before_a_lidar_that_does_not_repeat_is_seen_in_most_sweeps() -> None:
    from retropole.carried.track import find_track

    walk = simulate_walk(
        "harbor",
        np.random.default_rng(705),
        seconds=20.0,
        sensors=("Mid-360", "VLP-16"),
        noise=NOISE_MODELS["field"],
    )
    track = find_track(walk.record(0, np.random.default_rng(1)), walk.recorders[0].sensor)
    # As lines at rest, the pole is found in half of these.
    assert len(track.times) > 120
