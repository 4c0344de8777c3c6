import msgspec
import numpy as np
import pytest

from retropole.base import se3
from retropole.planning.comparison import against_plan
from retropole.planning.plan_text import plan_document
from retropole.result import PoleDoc
from retropole.result.pole_plan import PolePlanDoc
from tests.planning.places import planned

pytestmark = pytest.mark.full

PLAN = [("front.pcd", ""), ("rear.pcd", "")]


@pytest.fixture(scope="module")
def plan() -> PolePlanDoc:
    return plan_document(planned(), PLAN, None)


def as_seen(plan: PolePlanDoc, lidar: int, moved: np.ndarray | None = None) -> list[PoleDoc]:
    """The planned poles as a LiDAR finds them: another point of each, and another sign."""
    T = se3.inverse(plan.lidars[lidar].T_place_lidar)
    found = []
    for k, pole in enumerate(plan.placements[0].poles):
        by = np.zeros(3) if moved is None or k else moved
        point = pole.foot_m + by + (0.5 + 0.3 * k) * pole.direction
        direction = (-1) ** k * (T[:3, :3] @ pole.direction)
        found.append(PoleDoc(se3.apply(T, point[None])[0], direction, 1.0, 30, 10, 0.01))
    return found


@pytest.mark.parametrize("lidar", [0, 1])
def test_poles_that_stand_as_planned_are_good(plan: PolePlanDoc, lidar: int) -> None:
    poles = as_seen(plan, lidar)
    for order in (poles, poles[::-1]):
        stood = against_plan(plan, order)
        assert stood.lidar == plan.lidars[lidar].name
        assert stood.others == 0
        assert [each.is_as_planned for each in stood.deviations] == [True, True]
        offsets = np.array([each.offset for each in stood.deviations])
        np.testing.assert_allclose(offsets, 0.0, atol=1e-9)


def test_a_pole_that_was_put_elsewhere_is_named_with_the_way_back(plan: PolePlanDoc) -> None:
    foot = plan.placements[0].poles[0].foot_m
    out = np.r_[foot[:2] / np.linalg.norm(foot[:2]), 0.0]
    stood = against_plan(plan, as_seen(plan, 0, 0.8 * out), "front")
    first, second = stood.deviations
    assert not first.is_as_planned
    assert second.is_as_planned
    assert "move it 0.8 m nearer" in first.text
    left = np.array([-out[1], out[0], 0.0])
    first, _ = against_plan(plan, as_seen(plan, 0, 0.7 * left), "front").deviations
    assert "move it 0.7 m to the right" in first.text


def test_a_pole_that_is_missing_and_one_that_is_not_planned_are_reported(plan: PolePlanDoc) -> None:
    poles = as_seen(plan, 0)
    stood = against_plan(plan, poles[1:], "front")
    assert stood.deviations[0].offset is None
    assert "is not seen" in stood.deviations[0].text
    far = msgspec.structs.replace(poles[0], point_m=poles[0].point_m + np.array([0.0, 9.0, 0.0]))
    assert against_plan(plan, [*poles, far], "front").others == 1
