"""What the view of a site draws: all clouds, each under its pose, and the poles, as JSON."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from ...base.datatypes import Array, Scan
from ...result.site import SiteDoc
from ...site.answer import SiteCalibration, SitePole
from ..points import MAX_SHOWN_RANGE, PackedCloud, pack_cloud
from ..view_data import LineView
from .names import placement_name, pole_labels
from .plan import Plan
from .svg import COLOURS

MAX_CLOUD_POINTS = 100_000
"""Points of each cloud in the page."""

MAX_PAGE_POINTS = 1_500_000
"""Points of all clouds together: 14 MB, so that the page stays under 20 MB."""

SHOWN_RADIUS = (4.0, 60.0)
"""Least and largest radius of what the camera starts by looking at, metres."""


class LidarView(msgspec.Struct, frozen=True):
    """A LiDAR: its name, the number of its colour, and its pose in the plan; null where refused."""

    name: str
    colour: int
    T: Array | None


class CloudView(msgspec.Struct, frozen=True):
    """One recording: whose, of which placement, its points, and its poles in the LiDAR's frame."""

    lidar: int
    placement: int
    points: PackedCloud
    poles: list[LineView]


class PoleView(msgspec.Struct, frozen=True):
    """A pole of the site: its placement, both ends (3,) in the plan, metres, and its name."""

    placement: int
    a: list[float]
    b: list[float]
    label: str


class SiteView(msgspec.Struct, frozen=True):
    """All that the page's own code is given; `centre` and `radius` are where the camera looks."""

    status: str
    lidars: list[LidarView]
    placements: list[str]
    clouds: list[CloudView]
    poles: list[PoleView]
    centre: list[float]
    radius: float
    shown: str


def site_view(document: SiteDoc, calibration: SiteCalibration, plan: Plan) -> SiteView | None:
    """Pack what the view shows; None where nothing was recorded.

    Parameters
    ----------
    document
        The result document.
    calibration
        What the clouds come from; its LiDARs and placements are those of the document.
    plan
        How the site is turned: the view's z axis points up.
    """
    recorded = _recorded(calibration)
    if not recorded:
        return None
    T_plan_site = np.eye(4)
    T_plan_site[:3, :3] = plan.R_plan_site
    budget = min(MAX_CLOUD_POINTS, MAX_PAGE_POINTS // len(recorded))
    clouds = [
        CloudView(k, j, pack_cloud(scan.cloud, scan.detection, max_points=budget), _lines(scan))
        for k, j, scan in recorded
    ]
    lidars = [
        LidarView(
            each.name,
            k % COLOURS,
            None if each.T_site_lidar is None else T_plan_site @ each.T_site_lidar,
        )
        for k, each in enumerate(document.lidars)
    ]
    poles = [
        PoleView(pole.placement, _end(plan, pole, -0.5), _end(plan, pole, 0.5), label)
        for pole, label in zip(document.poles, pole_labels(document), strict=True)
    ]
    places = [each.T[:3, 3] for each in lidars if each.T is not None]
    centre, radius = _look(places + [np.array(pole.a) for pole in poles])
    return SiteView(
        document.status,
        lidars,
        [placement_name(document.placements, j) for j in range(len(document.placements))],
        clouds,
        poles,
        centre.tolist(),
        radius,
        _shown([each.points for each in clouds]),
    )


def _recorded(calibration: SiteCalibration) -> list[tuple[int, int, Scan]]:
    """Every recording; a run that was refused early has clouds that nobody searched."""
    site = calibration.site
    scans: Sequence[Sequence[Scan | None]] = calibration.scans or [
        [None if cloud is None else Scan(cloud, lidar.sensor) for cloud in lidar.clouds]
        for lidar in site.lidars
    ]
    return [
        (k, j, scan)
        for k, of_lidar in enumerate(scans)
        for j, scan in enumerate(of_lidar)
        if scan is not None
    ]


def _lines(scan: Scan) -> list[LineView]:
    lines = []
    for i, pole in enumerate(scan.poles, 1):
        half = 0.5 * pole.length * pole.direction
        lines.append(
            LineView((pole.point - half).tolist(), (pole.point + half).tolist(), f"pole {i}")
        )
    return lines


def _end(plan: Plan, pole: SitePole, along: float) -> list[float]:
    end = pole.point + along * pole.length * pole.direction
    return [float(v) for v in plan.R_plan_site @ end]


def _look(points: Sequence[Array]) -> tuple[Array, float]:
    """Choose where the camera looks: the middle of all that stands there, and how far around."""
    if not points:
        return np.zeros(3), SHOWN_RADIUS[0]
    stacked = np.array(points)
    centre = (stacked.min(axis=0) + stacked.max(axis=0)) / 2
    reach = float(np.linalg.norm(stacked - centre, axis=1).max())
    return centre, float(np.clip(1.5 * reach, *SHOWN_RADIUS))


def _shown(clouds: Sequence[PackedCloud]) -> str:
    shown, total, far = (
        sum(getattr(each, name) for each in clouds) for name in ("shown", "total", "far")
    )
    text = f"{len(clouds)} clouds; the page holds {shown:,} of {total:,} points"
    return text + (f", {far:,} beyond {MAX_SHOWN_RANGE:g} m left out" if far else "")
