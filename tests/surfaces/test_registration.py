from typing import Literal

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.surfaces.registration import prepare, register, voxel_downsample


def room(rng: np.random.Generator, count: int = 6000) -> Array:
    """Points on three walls and the floor of a room that fits itself in one pose only."""
    u, v = rng.uniform(0, 1, (2, count))
    kind = rng.integers(0, 4, count)
    walls = np.stack(
        [
            np.stack([6 * u, 4 * v, 0 * u], axis=1),
            np.stack([6 * u, 0 * u, 2.5 * v], axis=1),
            np.stack([0 * u, 4 * u, 2.5 * v], axis=1),
            np.stack([2 + u, 4 - u, 1.5 * v], axis=1),
        ]
    )
    return np.asarray(walls[kind, np.arange(count)])


@pytest.mark.parametrize("method", ["GICP", "PLANE_ICP"])
def test_returns_to_the_truth_from_nearby(method: Literal["GICP", "PLANE_ICP"]) -> None:
    rng = np.random.default_rng(0)
    T_true = se3.random(rng, 5.0)
    target = prepare(room(rng), 0.1)
    source = prepare(se3.apply(se3.inverse(T_true), room(rng)), 0.1)
    start = se3.retract(T_true, np.array([0.03, -0.02, 0.04, 0.1, -0.05, 0.08]))
    # The start's rotation acts about the target's origin, metres away: ICP must bridge that.
    result = register(target, source, start, method=method, max_correspondence_distance=1.0)
    step = se3.local(T_true, result.T_target_source)
    assert result.converged
    assert np.linalg.norm(step[:3]) < np.radians(0.2)
    assert np.linalg.norm(step[3:]) < 0.02


def test_empty_and_tiny_clouds_are_refused_not_answered() -> None:
    assert voxel_downsample(np.zeros((0, 3)), 0.1).shape == (0, 3)
    for xyz in (np.zeros((0, 3)), np.random.default_rng(0).normal(size=(20, 3))):
        with pytest.raises(Refusal) as refusal:
            prepare(xyz, 0.1)
        assert refusal.value.code == "too_few_points"


def test_thinning_keeps_one_point_per_cube() -> None:
    xyz = np.random.default_rng(1).uniform(0.01, 0.99, (500, 3))
    assert len(voxel_downsample(xyz, 1.0)) == 1
    np.testing.assert_allclose(voxel_downsample(xyz, 1.0)[0], xyz.mean(axis=0))


def test_what_lies_beyond_all_cubes_is_left_out_without_a_word(
    capfd: pytest.CaptureFixture[str],
) -> None:
    near = room(np.random.default_rng(2), 200)
    far = np.array([[1e8, 0.0, 0.0], [0.0, 0.0, -1e8]])
    found = voxel_downsample(np.concatenate([far, near]), 0.1)
    np.testing.assert_array_equal(found, voxel_downsample(near, 0.1))
    assert capfd.readouterr() == ("", "")
