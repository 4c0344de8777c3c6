import numpy as np
import pytest

from retropole.base.uncertainty import predicted_error
from retropole.planning.choice import errors_of
from retropole.planning.planner import worst_at
from tests.planning.places import planned

pytestmark = pytest.mark.full


def test_the_choice_compares_what_is_predicted() -> None:
    """The search adds informations up; what is stated comes of the code of a calibration."""
    found = planned()
    together, alone = (float(each.max()) for each in errors_of(found.design, found.chosen))
    assert worst_at(found.predicted, 30.0) == pytest.approx(together, rel=0.35)
    # The search draws offsets on tape to a part of their size, the statement counts them whole.
    assert alone < worst_at(found.alone, 30.0) < 4 * alone


def test_surfaces_only_help() -> None:
    found = planned()
    for together, alone in zip(found.predicted.covariance, found.alone.covariance, strict=True):
        assert np.linalg.eigvalsh(together)[0] > 0
        for one, other in zip(predicted_error(together), predicted_error(alone), strict=True):
            assert one.sigma_m < 1.05 * other.sigma_m
    assert sum(each.share_at_30m for each in found.predicted.budget[0]) == pytest.approx(1.0)
