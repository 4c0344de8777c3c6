"""Every experiment run once, on one seed, and what its cells hold."""

from functools import cache

import numpy as np

from studies.paper import reproduce
from studies.paper.exhibit import Cell, Exhibit


@cache
def all_exhibits() -> dict[str, Exhibit]:
    """Run every experiment that needs no real recordings."""
    return {exhibit.name: exhibit for exhibit in reproduce(1, None)}


def number(cell: Cell) -> float:
    """Take a cell that must hold a number."""
    assert isinstance(cell, int | float)
    assert np.isfinite(cell)
    return float(cell)
