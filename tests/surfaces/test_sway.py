"""A LiDAR that sways is brought to rest, within what is stated; one at rest is left as it is."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.io import read_cloud
from retropole.surfaces.static import remove_dynamic_points
from retropole.surfaces.sway import Steadied, steadied
from tests.paths import SHARED
from tests.surfaces.swaying import HALF, recorded, swaying
from tests.tiers import first_of

DATA = SHARED / "pandaset"
SIGMA = float(np.radians(0.05))


@pytest.mark.full
def test_a_lidar_that_stands_is_left_as_it_is() -> None:
    for seed in range(3):
        cloud = recorded(np.zeros((80, 6)), np.random.default_rng(seed))
        same, sway, _ = steadied(cloud)
        assert sway is None
        assert same is cloud


@pytest.mark.parametrize("times", first_of([True, False]))
@pytest.mark.full
def test_what_sways_is_brought_to_rest(times: bool) -> None:
    rng = np.random.default_rng(0)
    motion = swaying(30, SIGMA, 1.0, rng)
    moved = recorded(motion, rng, 0.003)
    rest = recorded(np.zeros_like(motion), np.random.default_rng(0), 0.003)
    given = moved if times else replace(moved, time=None)
    steady, sway, _ = steadied(given)
    assert sway is not None
    assert sway.angle_rad == pytest.approx(SIGMA, rel=0.15)
    assert sway.frequency == pytest.approx(1.0, rel=0.1)
    assert sway.seconds == pytest.approx(3.0)
    assert sway.seconds_more == 0
    before, after, noise = (
        np.sqrt(np.mean(np.abs(HALF - np.abs(each.xyz)).min(axis=1) ** 2))
        for each in (moved, steady, rest)
    )
    assert before > 1.5 * noise
    assert after < (1.02 if times else 1.2) * noise
    assert sway.left_rad < SIGMA / 10


@pytest.mark.parametrize(
    ("second", "runs"),
    [(0.25, 2), (0.0, 8), pytest.param(0.25, 8, marks=pytest.mark.nightly)],
)
@pytest.mark.full
def test_the_rest_is_within_what_is_stated_also_of_a_third_of_a_period(
    second: float, runs: int
) -> None:
    """Of masts drawn as they are assumed to be, and with a faster mode, which in so short a time
    may look like all there is; too wide would show as well as too narrow."""
    squares = []
    for seed in range(runs):
        rng = np.random.default_rng(100 + seed)
        frequency = 0.3 if seed % 3 or second else 1.0
        motion = swaying(10, SIGMA * (1 + seed % 2), frequency, rng, second=second)
        cloud = recorded(motion, rng)
        steady, sway, _ = steadied(cloud)
        assert sway is not None
        # What was taken out of the returns, over all: a turn and a shift.
        lever = np.concatenate(
            [-_hats(cloud.xyz), np.tile(np.eye(3), (len(cloud), 1, 1))], axis=2
        ).reshape(-1, 6)
        taken = np.linalg.lstsq(lever, (steady.xyz - cloud.xyz).reshape(-1), rcond=None)[0]
        off = (taken - motion.mean(axis=0))[:3]
        covariance = np.asarray(sway.covariance)[:3, :3]
        squares.append(float(off @ np.linalg.solve(covariance, off)))
    # χ² with three degrees of freedom: 3 in the mean, and 95 % below 7.8.
    assert 0.2 < np.median(squares) < 6.0
    assert np.count_nonzero(np.array(squares) < 7.8) >= runs - 1


def _hats(xyz: np.ndarray) -> np.ndarray:
    x, y, z = xyz.T
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return np.moveaxis(np.array(rows), 2, 0)


def test_a_vehicle_that_creeps_does_not_sway() -> None:
    motion = np.zeros((80, 6))
    motion[:, 4] = np.linspace(0.0, 0.04, 80)
    cloud = recorded(motion, np.random.default_rng(0))
    assert steadied(cloud) == Steadied(cloud)


def test_one_sweep_takes_what_is_stated() -> None:
    cloud = replace(recorded(np.zeros((8, 6)), np.random.default_rng(0)), frame=None)
    assert steadied(cloud).sway is None
    same, sway, _ = steadied(cloud, SIGMA)
    assert same is cloud
    assert sway is not None
    assert sway.frequency is None
    assert sway.left_rad == pytest.approx(SIGMA / np.sqrt(2))
    assert "does not show its position at rest" in sway.text


@pytest.mark.full
def test_sweeps_that_show_no_sway_narrow_what_is_stated() -> None:
    cloud = recorded(np.zeros((240, 6)), np.random.default_rng(0))
    _, sway, _ = steadied(cloud, SIGMA)
    assert sway is not None
    assert sway.left_rad < SIGMA / 10


@pytest.mark.skipif(not DATA.exists(), reason="no folder ../shared/data")
@pytest.mark.parametrize("name", ["pandar64", "pandargt"])
def test_a_real_vehicle_that_stands_does_not_sway(name: str) -> None:
    """Three sweeps of half a second, in which the vehicle creeps by some cm and does not turn."""
    clouds = [
        read_cloud(DATA / f"pandaset002_{number}_{name}.pcd") for number in ("00", "01", "05")
    ]
    frames = np.repeat([0, 1, 5], [len(cloud) for cloud in clouds])
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    assert steadied(remove_dynamic_points(PointCloud(xyz, frame=frames))).sway is None
