import numpy as np
import pytest

from retropole.base import se3
from retropole.base.sway import ENOUGH, LEVER, Sway, left_of, stated_sway


def test_what_is_left_averages_over_the_recordings() -> None:
    one = stated_sway(0.001)
    assert left_of([one]) == pytest.approx(np.asarray(one.covariance))
    assert left_of([one, one]) == pytest.approx(np.asarray(one.covariance) / 2)
    # One that stood has nothing left, and half of the say.
    assert left_of([one, None]) == pytest.approx(np.asarray(one.covariance) / 4)
    assert not left_of([None]).any()


def test_a_stated_sway_is_no_less_than_that_of_a_mast_whichever_way_is_up() -> None:
    covariance = np.asarray(stated_sway(0.001).covariance)
    rng = np.random.default_rng(0)
    for scale, block in ((1.0, covariance[:3, :3]), (LEVER, covariance[3:, 3:])):
        for _ in range(5):
            R = se3.random(rng)[:3, :3]
            # About level axes, half of the variance each.
            mast = R @ np.diag([0.5, 0.5, 0.0]) @ R.T * (0.001 * scale) ** 2
            share = np.linalg.eigvals(np.linalg.solve(block, mast)).real
            assert share.max() == pytest.approx(1)


def test_words_say_how_much_longer_to_record() -> None:
    covariance = np.diag([1e-8] * 3 + [1e-6] * 3)
    short = Sway(0.0007, 0.5, 1.0, covariance)
    assert short.periods == pytest.approx(0.5)
    assert short.seconds_more == pytest.approx(ENOUGH / 0.5 - 1.0)
    assert short.words == (
        "± 0.04° at 0.5 Hz, 0.5 periods; where it rests is known to ± 0.006°: record 3 s more"
    )
    assert "record" not in Sway(0.0007, 0.5, 10.0, covariance).words
    assert "as stated" in stated_sway(0.001).words
