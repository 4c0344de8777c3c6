"""`simulate` gives equal pairs for equal seeds."""

import numpy as np
import pytest

import retropole as rp
from tests.api.clouds import pair


def test_equal_seeds_give_equal_pairs() -> None:
    again = rp.simulate("harbor", seed=1, sensor_target="VLP-16", sensor_source="VLP-16")
    np.testing.assert_array_equal(again.target.xyz, pair().target.xyz)
    np.testing.assert_array_equal(again.T_target_source, pair().T_target_source)
    other = rp.simulate("harbor", seed=2, sensor_target="VLP-16", sensor_source="VLP-16")
    assert not np.array_equal(other.T_target_source, pair().T_target_source)


def test_options_are_taken() -> None:
    made = rp.simulate("bare", 3, poles=3, radius=0.03, frames=2, sensor_source="VLP-16")
    assert [pole.radius for pole in made.poles] == [0.03] * 3
    assert made.sensors[1].name == "VLP-16"
    assert made.target.frame is not None
    assert set(np.unique(made.target.frame)) == {0, 1}
    with pytest.raises(rp.UsageError, match="no scene is called 'moon'"):
        rp.simulate("moon")
