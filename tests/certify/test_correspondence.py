"""Which poles are the same, told by the poles alone."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Pole
from retropole.base.errors import Refusal
from retropole.certify.correspondence import correspond
from tests.conftest import PoleMaker

FEET = np.array([[0.0, 0, 0], [2, 0.3, 0], [0.4, 2.6, 0.2], [2.9, 2.1, 0.1]])
LEANS = np.array([[0.1, 0.1, 1], [-0.4, 0.1, 1], [0.2, -0.5, 1], [0.5, 0.3, 1]])
T = se3.from_rt(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([4.0, 1, 0.5]))


def seen(make: PoleMaker, feet: Array, order: list[int], T: Array | None = None) -> list[Pole]:
    return [make(feet[k], LEANS[k], T=T) for k in order]


def test_poles_are_paired_and_directed_alike(make_pole: PoleMaker) -> None:
    target = seen(make_pole, FEET, [0, 1, 2, 3])
    source = seen(make_pole, FEET, [2, 0, 3, 1], T)
    source[1] = make_pole(FEET[0], -LEANS[0], T=T)
    both = correspond(target, source)
    assert sorted(both.pairs) == [(0, 1), (1, 3), (2, 0), (3, 2)]
    turned = both.directions(0) @ T[:3, :3].T
    assert both.directions(1) == pytest.approx(turned, abs=1e-9)


def test_a_pole_that_moved_a_little_is_still_that_pole(make_pole: PoleMaker) -> None:
    moved = FEET + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, 0, 0]])
    both = correspond(seen(make_pole, FEET, [0, 1, 2, 3]), seen(make_pole, moved, [0, 1, 2, 3], T))
    assert sorted(both.pairs) == [(k, k) for k in range(4)]


def test_other_poles_are_refused(make_pole: PoleMaker) -> None:
    with pytest.raises(Refusal) as caught:
        correspond(seen(make_pole, FEET, [0, 1]), seen(make_pole, 3 * FEET + [0.0, 0, 0.5], [2, 3]))
    assert caught.value.code == "no_match"
