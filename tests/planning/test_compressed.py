"""A design in its small form predicts as the design does."""

import numpy as np
import pytest

from retropole.planning.choice import Design
from retropole.planning.compressed import compress, pairs_of
from tests.planning.places import planned
from tests.planning.test_choice import drawn

CLOSE = 0.02


def made(kind: str) -> Design:
    return planned().design if kind == "yard" else drawn(int(kind), 12)


@pytest.mark.parametrize("kind", ["0", "1", "yard"])
def test_any_set_is_predicted_as_by_the_design(kind: str) -> None:
    design, rng = made(kind), np.random.default_rng(0)
    both = compress(design)
    for count in (1, 2, 3, 4) * 6:
        chosen = rng.choice(len(design.roots), count, replace=False).tolist()
        for small, inverse in zip(both, design.inverses(chosen), strict=True):
            expected = np.sqrt(design.squares(inverse))
            assert np.sqrt(small.squares(chosen)) == pytest.approx(expected, rel=CLOSE)


def test_it_is_small() -> None:
    design = planned().design
    whole = sum(root.size for _, root in design.roots)
    for small in compress(design):
        assert sum(root.size for root in small.roots) < whole / 4
        assert small.rows.shape[2] <= 54


def test_pairs_are_those_that_may_stand_with_others() -> None:
    design, planned_pairs = planned().design, planned().chosen
    pairs = pairs_of(design)
    assert (pairs == pairs.T).all()
    assert not pairs.diagonal().any()
    for own in planned_pairs:
        assert pairs[own[0], own[1]]
    for k in range(0, len(pairs), 7):
        for other in range(0, len(pairs), 5):
            # Two that stand alone must also lean differently.
            assert pairs[k, other] or not design.may_stand(k, [other])
