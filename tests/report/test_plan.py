"""A site is laid level whatever its frame, and the page says what it took for up."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole.report.plan import plan_of
from retropole.result.site import SiteDoc
from tests.report.site.made_up import document_of, made_up_site


def document(surveyed: bool = False) -> SiteDoc:
    return document_of(made_up_site(lidars=3, placements=2, count=10, surveyed=surveyed))


def without_sensor(of: SiteDoc) -> SiteDoc:
    lidars = [msgspec.structs.replace(lidar, up=None) for lidar in of.lidars]
    return msgspec.structs.replace(of, lidars=lidars)


def turned(of: SiteDoc, R: np.ndarray) -> SiteDoc:
    """The same site in a frame with other axes."""
    T = np.eye(4)
    T[:3, :3] = R
    return msgspec.structs.replace(
        of,
        lidars=[
            msgspec.structs.replace(each, T_site_lidar=T @ np.asarray(each.T_site_lidar))
            for each in of.lidars
        ],
        poles=[
            msgspec.structs.replace(each, point=R @ each.point, direction=R @ each.direction)
            for each in of.poles
        ],
    )


def test_a_surveyed_frame_is_level_and_knows_north() -> None:
    plan = plan_of(document(surveyed=True))
    assert np.array_equal(plan.R_plan_site, np.eye(3))
    assert plan.north == "north"
    frame = msgspec.structs.replace(document(surveyed=True).frame, epsg=25832)
    assert plan_of(msgspec.structs.replace(document(), frame=frame)).north == "grid north"


@pytest.mark.parametrize("angles", [(0, 0, 0), (80, 10, 20), (175, 3, 0), (180, 0, 0)])
def test_poles_stand_up_whatever_the_frame(angles: tuple[int, int, int]) -> None:
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    tilted = turned(without_sensor(document()), R)
    plan = plan_of(tilted)
    assert "poles" in plan.up
    assert plan.north is None
    assert np.allclose(plan.R_plan_site @ plan.R_plan_site.T, np.eye(3))
    assert np.linalg.det(plan.R_plan_site) == pytest.approx(1)
    for pole in tilted.poles:
        assert abs((plan.R_plan_site @ pole.direction)[2]) > np.cos(np.radians(30))
    # Most LiDARs stand upright.
    assert sum((plan.R_plan_site @ np.array(e.T_site_lidar)[:3, 2])[2] for e in tilted.lidars) > 2


def test_an_inertial_sensor_says_what_is_up() -> None:
    plan = plan_of(document())
    assert "mast-a" in plan.up
    assert np.allclose(plan.R_plan_site, np.eye(3))


def test_a_site_without_poles_keeps_its_frame() -> None:
    bare = msgspec.structs.replace(without_sensor(document()), poles=[])
    assert np.array_equal(plan_of(bare).R_plan_site, np.eye(3))
