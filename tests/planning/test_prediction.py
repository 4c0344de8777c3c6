import numpy as np
import pytest

from retropole.alignment.network import factor_of
from retropole.base.datatypes import Array, IntArray
from retropole.base.uncertainty import predicted_error
from retropole.planning.choice import errors_of
from retropole.planning.planner import worst_at
from retropole.planning.prediction import network_of, roots_of
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


BEFORE = 1e-6
"""Precision beforehand of next to nothing: all that a pole says counts."""

BANDS = (np.zeros(0, dtype=np.int64),) * 2


def whole(size: int, place: IntArray, root: Array) -> Array:
    information = np.zeros((size, size))
    information[np.ix_(place, place)] = root @ root.T
    return information


def test_informations_of_poles_add_up_to_that_of_all() -> None:
    """Axes are eliminated one by one or together, by the code that states a covariance."""
    found = planned()
    some = np.array([0, len(found.candidates) // 2, len(found.candidates) - 1])
    poles, seen = found.candidates.select(some), found.seen[some]
    network = network_of(found.stations, poles, seen, np.arange(3), BANDS)
    factor = factor_of(network, ridge=1e-9)
    size = len(factor.information)
    parts = [whole(size, *each) for each in roots_of(network, 3, BEFORE * np.ones(size))]
    scale = np.sqrt(np.diag(factor.information))
    scale[scale == 0] = 1.0
    difference = (sum(parts) - factor.information) / np.outer(scale, scale)
    # The single poles have a prior of their axes that says next to nothing.
    assert np.abs(difference).max() < 0.02


def test_a_pole_says_nothing_of_a_common_motion_of_both_lidars() -> None:
    found = planned()
    network = network_of(
        found.stations,
        found.candidates.select(np.array([0])),
        found.seen[[0]],
        np.array([0]),
        BANDS,
    )
    (place, root), *_ = roots_of(network, 1, BEFORE * np.ones(network.unknowns.kept))
    information = whole(network.unknowns.kept, place, root)
    own = np.asarray(information[6:12, 6:12])
    # A turn about the pole and a slide along it are free of one pole, but for its ends and width.
    size = np.linalg.eigvalsh(own / np.sqrt(np.outer(np.diag(own), np.diag(own))))
    assert size[0] < 1e-3 * size[-1]
