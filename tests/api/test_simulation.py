"""`simulate` gives equal pairs for equal seeds."""

import numpy as np
import pytest

import retropole as rp
from retropole.api.simulation import simulate_site
from retropole.checking.metrics import e_rt
from tests.api.clouds import pair

pytestmark = pytest.mark.full


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
    with pytest.raises(rp.UsageError, match="no scene is named 'moon'"):
        rp.simulate("moon")


def test_the_place_before_its_poles_are_set_up() -> None:
    """Of one seed the same place, LiDARs and truth, without the poles."""
    bare = rp.simulate("harbor", 1, sensor_target="VLP-16", sensor_source="VLP-16", poles=0)
    np.testing.assert_array_equal(bare.T_target_source, pair().T_target_source)
    assert not bare.poles
    assert pair().poles
    assert len(bare.surroundings) == len(pair().surroundings)
    answer = rp.calibrate(bare.target, bare.source, poles=0)
    assert answer.T_target_source is not None
    assert e_rt(answer.T_target_source, bare.T_target_source) < 0.1
    with pytest.raises(rp.UsageError, match="only its poles"):
        rp.simulate("paper", poles=0)


def test_nuisances_that_there_are_not_are_reported() -> None:
    with pytest.raises(rp.UsageError, match="no nuisances 'rain'; there are field"):
        rp.simulate("bare", nuisances="rain")
    with pytest.raises(rp.UsageError, match="no nuisances 'rain'; there are field"):
        simulate_site("posts", nuisances="rain")
