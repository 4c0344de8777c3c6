"""Which poles are one, as the truth has it; and whose returns lie on which."""

import numpy as np
import pytest

from retropole.adjustment.shared import same_poles, shared_poles, sights_of
from retropole.base import se3
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full


def test_shared_poles_are_those_that_stood_there(simulated: SimulatedSite, steps: Steps) -> None:
    T = se3.inverse(simulated.T_world_lidar[0])
    matched = set()
    for pole in steps.poles:
        near = []
        for k, true in enumerate(simulated.poles[pole.placement]):
            centre, axis = se3.apply(T, true.centre[None])[0], T[:3, :3] @ true.axis
            beside = np.linalg.norm(np.cross(pole.point - centre, axis))
            if beside < 0.1 and abs(axis @ pole.direction) > np.cos(np.radians(3.0)):
                near.append(k)
                assert pole.length < true.length + 0.1
        assert len(near) == 1, pole.name(steps.site)
        matched.add((pole.placement, near[0]))
        for lidar in pole.seen:
            assert simulated.seen[pole.placement][lidar][near[0]]
    # No pole is two.
    assert len(matched) == len(steps.poles)
    detected = sum(len(scan.poles) for i in range(3) for scan in steps.scans.used(i))
    assert sum(len(pole.seen) for pole in steps.poles) == detected


def test_numbers_and_names_are_reported_by_placement(steps: Steps) -> None:
    names = [pole.name(steps.site) for pole in steps.poles]
    assert len(set(names)) == len(names)
    assert names[0] == "pole 1 of placement 1"


def test_the_order_of_the_lidars_makes_no_other_poles(steps: Steps) -> None:
    poses = steps.choices.best.poses
    turned = dict(reversed(poses.items()))
    again = shared_poles(steps.scans, turned, steps.site.radius)
    assert same_poles(again, steps.poles)
    assert same_poles(steps.poles, again)


def test_poles_are_joined_by_where_the_poses_lay_them(steps: Steps) -> None:
    """A pose that is a metre off leaves a LiDAR's poles alone; the adjusted ones join them."""
    rough = dict(steps.choices.best.poses)
    rough[2] = se3.from_rt(np.eye(3), np.array([1.0, 0.0, 0.0])) @ rough[2]
    apart = shared_poles(steps.scans, rough, steps.site.radius)
    assert not same_poles(apart, steps.poles)
    adjusted = dict(enumerate(steps.adjusted.end.T))
    assert same_poles(shared_poles(steps.scans, adjusted, steps.site.radius), steps.poles)


def test_poles_far_from_each_other_are_not_one(steps: Steps) -> None:
    """Under a wrong pose of one LiDAR, its poles are its own."""
    poses = dict(steps.choices.best.poses)
    poses[2] = se3.from_rt(np.eye(3), np.array([30.0, 0.0, 0.0])) @ poses[2]
    found = shared_poles(steps.scans, poses, steps.site.radius)
    assert all(pole.seen.keys() == {2} or 2 not in pole.seen for pole in found)
    assert any(pole.seen.keys() == {2} for pole in found)


def test_each_lidars_beams_are_at_its_own_poles(steps: Steps) -> None:
    sights = sights_of(steps.scans, steps.datum.poles)
    assert [sight.lidar for sight in sights] == [0, 1, 2]
    for sight in sights:
        seen = [k for k, pole in enumerate(steps.datum.poles) if sight.lidar in pole.seen]
        np.testing.assert_array_equal(sight.own, seen)
        for number, k in enumerate(seen):
            on = np.count_nonzero(sight.beams.pole == number)
            assert 0 < on <= len(steps.datum.poles[k].seen[sight.lidar].xyz)


@pytest.mark.parametrize("lidar", [0, 2])
def test_a_lidar_without_poles_has_no_sight(steps: Steps, lidar: int) -> None:
    scans = steps.scans.without({(lidar, 0), (lidar, 1)})
    poses = {i: T for i, T in steps.choices.best.poses.items() if i != lidar}
    sights = sights_of(scans, shared_poles(scans, poses, steps.site.radius))
    assert [sight.lidar for sight in sights] == [i for i in range(3) if i != lidar]
