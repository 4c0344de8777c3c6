"""A design in its small form predicts as the design does."""

import numpy as np
import pytest

from retropole.planning.choice import Design
from retropole.planning.compressed import compress
from tests.planning.places import planned
from tests.planning.test_choice import drawn

pytestmark = pytest.mark.full

CLOSE = 0.1


def made(kind: str) -> Design:
    return planned().design if kind == "yard" else drawn(int(kind), 12)


@pytest.mark.parametrize("kind", ["0", "1", "yard"])
def test_any_set_is_predicted_as_by_the_design(kind: str) -> None:
    design, rng = made(kind), np.random.default_rng(0)
    both = compress(design)
    for count in (1, 2, 3, 4) * 6:
        chosen = rng.choice(len(design.roots), count, replace=False).tolist()
        for small, alone in zip(both, (False, True), strict=True):
            expected = np.sqrt(design.squares(design.inverse(chosen, alone=alone)))
            assert np.sqrt(small.squares(chosen)) == pytest.approx(expected, rel=CLOSE)


def test_it_is_small() -> None:
    design = planned().design
    whole = sum(root.size for _, root in design.roots)
    for small in compress(design):
        assert sum(root.size for root in small.roots) < whole / 2
        assert small.rows.shape[2] <= 54
