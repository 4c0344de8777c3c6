import numpy as np
import pytest

from retropole.base.errors import Refusal
from retropole.planning.place import Area
from retropole.planning.planner import plan, worst_at
from tests.planning.places import AREAS, planned, stations


@pytest.mark.full
def test_swapped_lidars_are_planned_alike() -> None:
    """The place turns with its frame: the error is the same but for the grid that feet stand on."""
    swapped = plan(stations()[::-1], allowed=AREAS)
    error = worst_at(planned().predicted, 30.0)
    assert worst_at(swapped.predicted, 30.0) == pytest.approx(error, rel=0.2)


def test_one_more_is_never_worse() -> None:
    found = planned()
    now = worst_at(found.predicted, 30.0)
    assert {each.what for each in found.more} == {"pole", "placement"}
    for each in found.more:
        assert -0.02 <= each.gain < 1.0
        assert each.error < 1.2 * now


def test_too_little_ground_is_refused() -> None:
    corner = Area(np.array([4.0, -1.0]), np.array([4.3, -0.7]))
    with pytest.raises(Refusal) as refusal:
        plan(stations(), allowed=[corner])
    assert refusal.value.code in ("nowhere_seen", "no_ground")
