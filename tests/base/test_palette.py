"""Colours of LiDARs are told apart."""

from itertools import combinations

import numpy as np

from retropole.base.palette import COLORS, GREEN


def test_no_two_lidars_have_colours_that_are_alike() -> None:
    rgb = {name: np.array([int(name[k : k + 2], 16) for k in (1, 3, 5)]) for name in COLORS}
    assert GREEN not in COLORS
    for a, b in combinations(rgb.values(), 2):
        assert np.abs(a - b).max() >= 40
