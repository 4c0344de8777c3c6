import os
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array, Pole
from tests.adjustment.fixtures import (  # noqa: F401
    found,
    pair_site,
    pair_steps,
    simulated,
    simulated_survey,
    steps,
    surveyed,
)
from tests.tiers import Tiers

# No test asserts a wall-clock time: a busy machine is no counterexample. Examples are the same in
# every run; `pytest --hypothesis-profile=search` draws others, and more of them.
settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=1000)
settings.load_profile("same")

# Every core runs tests of its own: threads of BLAS, which wait by spinning, only get in the way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
threadpool_limits(1, user_api="blas")

PoleMaker = Callable[..., Pole]


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Tiers(config), "tiers")


@pytest.fixture
def make_pole() -> PoleMaker:
    """Make the pole that a LiDAR would report of a given axis: centred, with its points."""

    def make(
        point: Array,
        direction: Array,
        *,
        length: float = 2.0,
        count: int = 30,
        sigma: float = 0.0,
        rng: np.random.Generator | None = None,
        T: Array | None = None,
    ) -> Pole:
        n = np.asarray(direction, float) / np.linalg.norm(direction)
        along = np.linspace(-length / 2, length / 2, count)[:, None]
        xyz = np.asarray(point, float) + along * n
        if sigma and rng is not None:
            xyz = xyz + sigma * rng.normal(size=xyz.shape)
        if T is not None:
            xyz, n = se3.apply(T, xyz), T[:3, :3] @ n
        centre = xyz.mean(axis=0)
        return Pole(centre, n, xyz, length, sigma, 10, np.arange(count))

    return make
