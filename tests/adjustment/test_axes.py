"""The axes of poles as one LiDAR alone has them."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.axes import LidarAxes, find_axes
from retropole.base import se3
from retropole.base.datatypes import Scan
from retropole.simulation import SimulatedPair
from tests.checking.certifying import RADIUS, found_in, four_poles

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return four_poles()


@pytest.fixture(scope="module")
def scan(pair: SimulatedPair) -> Scan:
    return found_in(pair).target


@pytest.fixture(scope="module")
def axes(scan: Scan) -> LidarAxes:
    seen = [(pole, scan.cloud) for pole in scan.poles]
    return find_axes(seen, sensor=scan.sensor, radius=RADIUS, radius_sigma=0.0)


def test_the_truth_lies_within_what_is_stated(pair: SimulatedPair, axes: LidarAxes) -> None:
    back = se3.inverse(pair.T_world_target)
    true = [(se3.apply(back, pole.centre), back[:3, :3] @ pole.axis) for pole in pair.poles]
    whole = axes.random + axes.systematic @ axes.systematic.T
    for k, (q, n) in enumerate(zip(axes.state.points, axes.state.directions, strict=True)):
        centre, axis = min(true, key=lambda t: float(np.linalg.norm(np.cross(t[0] - q, t[1]))))
        there = centre + axis * ((q - centre) @ n) / (axis @ n)
        across = axes.state.tangents[k].T
        off = np.r_[across @ (there - q), across @ (axis / (axis @ n) - n)]
        block = slice(4 * k, 4 * k + 4)
        # 99.9 % of χ² with 4 degrees of freedom.
        assert off @ np.linalg.solve(whole[block, block], off) < 18.5
        assert np.linalg.norm(off[:2]) < 0.02


def test_an_axis_lies_behind_the_line_of_its_returns(scan: Scan, axes: LidarAxes) -> None:
    for pole, q, n in zip(scan.poles, axes.state.points, axes.state.directions, strict=True):
        away = q - scan.cloud.origin
        away -= (away @ n) * n
        line = pole.point - q
        line -= (line @ n) * n
        assert -0.03 < line @ away / np.linalg.norm(away) < -0.005


def test_more_returns_leave_less_to_scatter_and_as_much_to_the_instrument(
    scan: Scan, axes: LidarAxes
) -> None:
    frame = scan.cloud.frame
    assert frame is not None
    one = scan.cloud.select(frame == 0)
    part = [replace(p, xyz=p.xyz[frame[p.index] == 0]) for p in scan.poles]
    alone = find_axes(
        [(pole, one) for pole in part], sensor=scan.sensor, radius=RADIUS, radius_sigma=0.0
    )
    assert np.trace(alone.random) > 1.5 * np.trace(axes.random)
    assert 0.5 < np.sum(alone.systematic**2) / np.sum(axes.systematic**2) < 2.0
