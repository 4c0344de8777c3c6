"""Some of many, evenly."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Rows = TypeVar("Rows", bound=np.ndarray)


def every_nth(rows: Rows, most: int) -> Rows:
    """Take every n-th row of an array, so that no more than a number of them are left."""
    return rows[:: 1 + max(len(rows) - 1, 0) // most]  # type: ignore[return-value]
