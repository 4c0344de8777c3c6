"""What each placement does: as leaving it out really does, to first order."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.datum import without_poles
from retropole.adjustment.solved import without_placements
from retropole.alignment.survey import Surveyed, SurveyedEnd
from retropole.base import se3
from tests.adjustment.adjusting import Steps


@pytest.mark.full
def test_it_is_what_leaving_a_placement_out_does(steps: Steps) -> None:
    adjusted = steps.adjusted
    found = list(without_placements(adjusted.network, adjusted.end, 2))
    assert [one.placement for one in found] == [0, 1]
    sigma = np.sqrt(np.diag(adjusted.covariance)).reshape(-1, 6)[1:]
    for one in found:
        gone = {k for k, p in enumerate(steps.datum.poles) if p.placement == one.placement}
        left = steps.again(without_poles(steps.datum, gone))
        moved = [se3.local(a, b) for a, b in zip(adjusted.end.T, left.end.T, strict=True)]
        turned, shifted = (
            max(float(np.linalg.norm(step[part])) for step in moved)
            for part in (slice(3), slice(3, 6))
        )
        assert one.rotation is not None
        assert one.translation is not None
        # Noise and weights change too: by less than half of what poses are unsure of.
        assert abs(one.rotation - turned) < 0.5 * sigma[:, :3].max()
        assert abs(one.translation - shifted) < 0.5 * sigma[:, 3:].max()


@pytest.mark.full
def test_a_site_with_one_placement_has_none_to_leave_out(pair_steps: Steps) -> None:
    adjusted = pair_steps.adjusted
    assert not list(without_placements(adjusted.network, adjusted.end, 1))


@pytest.mark.full
def test_what_rests_on_one_placement_alone_is_told(steps: Steps) -> None:
    """Without it there is no pose: neither scenes nor other poles hold it."""
    poles = [k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1]
    alone = without_poles(steps.datum, set(poles))
    bare = replace(steps, scenes=[]).again(alone)
    first, second = without_placements(bare.network, bare.end, 2)
    assert first.rotation is None
    assert first.lidar is None
    assert second.translation == pytest.approx(0.0, abs=1e-4)


@pytest.mark.full
def test_one_surveyed_end_of_a_pole_that_no_return_is_left_of(steps: Steps) -> None:
    """A line of which one point alone is known keeps the equations solvable."""
    k = next(k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1)
    end = SurveyedEnd("foot", k, steps.datum.poles[k].extent[0], 0.05)
    known = replace(steps.datum, surveyed=Surveyed(ends=(end,)))
    adjusted = steps.again(known)
    first, second = without_placements(adjusted.network, adjusted.end, 2)
    assert first.placement == 0
    assert second.placement == 1
