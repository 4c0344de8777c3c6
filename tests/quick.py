"""Which cases of a test run with every run, and which with those that take minutes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_of(cases: Iterable[Any], count: int = 1) -> list[Any]:
    """Let the first of all cases run always, the others with `pytest -m slow`.

    For cases that take long, of which one shows most of what all do. A tuple is one case of several
    arguments.
    """
    several = [case if isinstance(case, tuple) else (case,) for case in cases]
    slow = [pytest.param(*case, marks=pytest.mark.slow) for case in several[count:]]
    return [*(pytest.param(*case) for case in several[:count]), *slow]
