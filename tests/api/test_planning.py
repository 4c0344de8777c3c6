"""`plan` and what holds its plan against a calibration, as Python has them."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import retropole as rp
from retropole.api.plan_checking import cost_of
from retropole.api.planning import PolePlan
from retropole.base import se3
from tests.api.clouds import pair, tables

ALLOWED = ((4.0, -3.0, 4.6, -2.4), (4.0, 1.0, 4.6, 1.6), (6.0, -1.0, 6.6, -0.4))


@cache
def made() -> PolePlan:
    """A plan over the harbour, whose poles do not matter."""
    both, T = tables(), pair().T_target_source
    rough = T @ se3.from_rt(se3.exp_so3(np.array([0.0, 0.02, 0.05])), np.array([0.3, -0.2, 0.1]))
    return rp.plan(
        both.target,
        both.source,
        rough=rough,
        allowed=ALLOWED,
        radius=0.03,
        sensor_target="VLP-16",
        sensor_source="VLP-16",
    )


@pytest.mark.full
def test_arrays_are_planned() -> None:
    document = made().document
    assert [each.name for each in document.lidars] == ["target", "source"]
    first, second = (np.array(each.T_place_lidar) for each in document.lidars)
    apart = se3.difference(se3.inverse(first) @ second, pair().T_target_source)
    assert apart.rotation < np.radians(0.5)
    assert apart.translation < 0.05
    (placement,) = document.placements
    for pole in placement.poles:
        x, y = pole.foot_m[:2]
        assert any(a <= x <= c and b <= y <= d for a, b, c, d in ALLOWED)
    assert "PolePlan:" in repr(made())


def test_slips_are_reported() -> None:
    both = tables()
    with pytest.raises(rp.UsageError, match="at is the distance"):
        rp.plan(both.target, both.source, rough=np.eye(4), at=30.0)
    for name, value in (
        ("poles", 1),
        ("poles", 7),
        ("poles", 2.5),
        ("placements", 0),
        ("length", 0.1),
        ("length", "2"),
        ("allowed", [(0, 0, 1)]),
        ("forbidden", [(0, 0, 1, np.nan)]),
    ):
        options: dict[str, Any] = {name: value}
        with pytest.raises(rp.UsageError, match="expected"):
            rp.plan(both.target, both.source, **options)


@pytest.mark.full
def test_every_placement_is_held_against_the_plan() -> None:
    result = rp.calibrate(tables().target, tables().source)
    assert result.placements is not None
    twice = replace(result, placements=result.placements * 2)
    plan = made().document
    once, both = cost_of(plan, result), cost_of(plan, twice)
    poles = sum(len(each.seen) for placement in plan.placements for each in placement.poles)
    assert len([line for line in once if ": pole " in line]) == poles
    assert len([line for line in both if ": pole " in line]) == 2 * poles
    assert "2 placements recorded, 1 planned" in both
    assert not any("recorded, " in line for line in once)
    assert once[-1].startswith("error at 30 m: ")
