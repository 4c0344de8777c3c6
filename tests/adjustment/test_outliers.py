"""Returns beside their pole: an outlier to the likelihood is a blunder to the surveyor."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.blunders import significant, without_blunders
from retropole.adjustment.shared import SharedPole
from tests.adjustment.adjusting import Steps
from tests.tiers import first_of

pytestmark = pytest.mark.full


def pushed(pole: SharedPole, lidar: int, by: float) -> SharedPole:
    """The pole as it is, and for one LiDAR aside by so many metres."""
    own = pole.seen[lidar]
    across = np.cross(own.direction, own.point / np.linalg.norm(own.point))
    step = by * across / np.linalg.norm(across)
    moved = replace(own, xyz=own.xyz + step, point=own.point + step)
    return replace(pole, seen={**pole.seen, lidar: moved})


def of_pole(steps: Steps, k: int, lidar: int, by: float) -> Steps:
    """The same without the scene, which cannot be pushed with its poles."""
    poles = list(steps.datum.poles)
    poles[k] = pushed(poles[k], lidar, by)
    return replace(steps, datum=replace(steps.datum, poles=poles), scenes=[])


@pytest.mark.parametrize("by", first_of([0.1, 0.14, 0.4]))
def test_however_far_a_pole_is_pushed_it_is_named(steps: Steps, by: float) -> None:
    k = next(k for k, pole in enumerate(steps.datum.poles) if len(pole.seen) == 3)
    bumped = of_pole(steps, k, 1, by)
    first = bumped.again(bumped.datum)
    poor = significant(first.tests)
    assert poor
    assert max(poor, key=lambda test: test.w).pole == k
    left, reasons = without_blunders(bumped.recorded, first)
    assert [reason.code for reason in reasons] == ["pole_moved"]
    assert reasons[0].values["pole"] == steps.datum.poles[k].name(steps.site)
    assert not significant(left.tests)


def test_no_distance_makes_it_pass_for_noise(steps: Steps) -> None:
    k = next(k for k, pole in enumerate(steps.datum.poles) if len(pole.seen) == 3)
    found = []
    for by in (0.15, 0.25, 0.4):
        bumped = of_pole(steps, k, 1, by)
        found.append(max(test.w for test in bumped.again(bumped.datum).tests))
    assert min(found) > 8
