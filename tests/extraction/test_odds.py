"""What is beside a line and beyond its ends speaks against a pole; where the cloud is does not."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.extraction.lines import fit_line
from retropole.extraction.odds import log_odds, measures_of
from retropole.extraction.surroundings import surroundings_of
from tests.extraction.synthetic import BRIGHT, DIM, offset, on_pole, scene

RADIUS = 0.02
UP = np.linspace(-0.8, 0.8, 33)


def wall(behind: float) -> Array:
    """Points of a wall that passes the axis of the pole at a distance, metres, on both sides."""
    return np.concatenate([offset(behind, side, UP) for side in (-0.2, -0.13, 0.13, 0.2)])


def odds_of(*others: tuple[Array, float], pole: Array | None = None) -> float:
    cloud, line = scene(on_pole() if pole is None else pole, *others)
    assert cloud.intensity is not None
    around = surroundings_of(cloud, np.arange(len(cloud)), cloud.intensity >= BRIGHT, line)
    return log_odds(around, RADIUS)


def test_a_pole_in_free_air_is_probable_and_a_short_one_less() -> None:
    assert odds_of() > odds_of(pole=on_pole(0.4, 5)) > 0.0


@pytest.mark.parametrize(
    ("other", "is_against"),
    [
        ((offset(0.0, 0.14, UP), BRIGHT), True),
        ((offset(0.0, 0.12, UP), DIM), True),
        ((offset(0.0, 0.0, 0.9 + UP[UP >= 0.0]), DIM), True),
        ((offset(0.0, 0.5, UP), BRIGHT), False),
        ((wall(0.0), DIM), True),
        ((wall(0.15), DIM), False),
    ],
    ids=["bright beside", "dim close", "goes on", "bright far", "on a wall", "wall behind"],
)
def test_what_is_about_a_line_speaks_against_it(
    other: tuple[Array, float], is_against: bool
) -> None:
    assert (odds_of(other) < odds_of() - 1.0) is is_against


def test_a_line_that_goes_on_at_both_ends_is_none() -> None:
    beyond = offset(0.0, 0.0, np.r_[-UP[UP > 0.0], UP[UP > 0.0]] + np.repeat([-0.9, 0.9], 16))
    assert odds_of((beyond, DIM)) < 0.0


def test_no_motion_changes_the_measures() -> None:
    cloud, line = scene(on_pole(), (offset(0.0, 0.14, 0.9 * UP), BRIGHT), (wall(0.1), DIM))
    assert cloud.intensity is not None
    T = se3.random(np.random.default_rng(0), 20.0)
    moved = PointCloud(se3.apply(T, cloud.xyz), cloud.intensity)
    again = fit_line(
        moved, line.index, se3.apply(T, line.point), T[:3, :3] @ line.direction, RADIUS
    )
    here, there = (
        measures_of(
            surroundings_of(each, np.arange(len(each)), cloud.intensity >= BRIGHT, on), 0.02
        )
        for each, on in ((cloud, line), (moved, again))
    )
    np.testing.assert_allclose(there, here, atol=1e-9)
