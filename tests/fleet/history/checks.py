"""Checks of a made-up site."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import numpy as np

from retropole.base.datatypes import Array
from retropole.fleet.history.store import CheckRow, flat
from retropole.fleet.history.watch import Observed

SIGMA = np.repeat([np.radians(0.01), 0.002], 3)
RANDOM = np.diag(SIGMA**2)
COMMON = 2.0 * RANDOM
MOVED = np.array([0.0, 0, 0, 0.03, 0, 0])
START = datetime(2026, 1, 5, 3, 0, tzinfo=UTC)


def checks(
    count: int, change: Callable[[int], Array | float] = lambda k: 0.0, *, seed: int = 0
) -> list[Observed]:
    """Make weekly checks that scatter as stated, about what the stored pose errs by."""
    rng = np.random.default_rng(seed)
    level = np.sqrt(2.0) * SIGMA * rng.normal(size=6)
    return [
        Observed(20000.0 + 7 * k, level + SIGMA * rng.normal(size=6) + change(k), RANDOM, COMMON)
        for k in range(count)
    ]


def row(k: int = 0, name: str = "lamp-1", **given: object) -> CheckRow:
    """Make the row of a check, in week k."""
    values: dict[str, object] = {
        "step": SIGMA * (k + 1.0),
        "covariance": RANDOM + COMMON,
        "random": RANDOM,
        "used": "poles",
        "stored_sha256": "a",
        "target_sha256": f"t{k}",
        "source_sha256": f"s{k}",
    }
    status = str(given.pop("status", "same"))
    columns = {key: flat(value) for key, value in (values | given).items()}
    return CheckRow(name, START + k * timedelta(days=7), status, **columns)
