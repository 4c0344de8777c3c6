"""The beams of a recorded cloud, about the axis that it has."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import EXACT, simulate_pair
from retropole.simulation.recorded import recorded_beams


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, -0.2, -1.0]])
@pytest.mark.parametrize("knows_sensor", [True, False])
def test_beams_are_put_back_about_the_axis_of_the_cloud(
    axis: list[float], knows_sensor: bool
) -> None:
    pair = simulate_pair("bare", np.random.default_rng(0), sensor_source="VLP-16", noise=EXACT)
    # Around the poles, so that the gaps are between returns.
    cloud = pair.source.select(np.abs(np.arange(len(pair.source)) % 50 - 25) > 2)
    sensor = pair.sensors[1] if knows_sensor else None
    new = np.array(axis) / np.linalg.norm(axis)
    turn = np.cross([0.0, 0.0, 1.0], new)
    angle = np.arctan2(np.linalg.norm(turn), new[2])
    R = se3.exp_so3(angle * turn / np.linalg.norm(turn))
    upright = recorded_beams(cloud, sensor)
    turned = recorded_beams(
        replace(cloud, xyz=cloud.xyz @ R.T, origin=R @ cloud.origin, axis=new), sensor
    )
    assert np.isinf(upright.ranges).any()
    if knows_sensor:  # the beams without a return start at an azimuth of their own
        assert np.array_equal(np.unique(turned.rings), np.unique(upright.rings))
        sines = np.sort(turned.directions @ new)
        difference = len(turned.ranges) - len(upright.ranges)
        assert abs(difference) < 0.01 * len(upright.ranges)
        assert sines[-1] == pytest.approx((upright.directions[:, 2]).max(), abs=1e-9)
        return
    assert len(turned.ranges) == len(upright.ranges)
    ours, theirs = turned.directions, upright.directions @ R.T
    order = [np.lexsort((d @ R).round(6).T) for d in (ours, theirs)]
    np.testing.assert_allclose(ours[order[0]], theirs[order[1]], atol=1e-5)
