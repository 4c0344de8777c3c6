"""Sweeps of packets."""

from __future__ import annotations

from collections.abc import Callable

from ...base.datatypes import Array
from ..fields import Columns

Sweep = tuple[float, Callable[[], Columns], Array]
"""Time of recording, s; function that gives its columns; origin (3,) of its beams."""
