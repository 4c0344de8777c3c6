"""Whether the points of a cloud can be those of a LiDAR at the stated beam origin.

Clouds in the frame of a map are far from its origin. Where the LiDAR was, only the file or its
rings can say; a pose depends on it, and so does its covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..base.datatypes import Array, PointCloud, every_nth
from ..base.errors import Refusal
from ..base.se3 import FARTHEST, lengths
from ..io.beams import RING_SAMPLE, with_beam_origin, with_trusted_rings
from ..io.coordinates import oddity_of
from .lines import MIN_POLE_POINTS

FARTHEST_ORIGIN = 10_000.0
"""No pose is given about an origin that is farther from the points, metres. One that is known to
1 mm and 0.1 mrad has, 10 km away, a covariance whose least and largest eigenvalue differ by
a factor of 1e-14: doubles resolve no more. The LiDAR with the longest range measures 6 km (RIEGL
VZ-6000, data sheet)."""

THINNEST_POLE = 0.0004
"""No pole is seen where it is thinner, rad: 100 m away with a radius of 2 cm. The narrowest beam of
the table of sensors is four times as wide, the least step eight times."""


def check_coordinates(cloud: PointCloud) -> None:
    """Refuse coordinates that no frame has.

    Raises
    ------
    Refusal
        ``far_from_lidar`` where one is beyond `FARTHEST`, which no map reaches.
    """
    _check_within(
        cloud, FARTHEST, "the file is damaged, or the content of a field is not that of its name"
    )


def located(cloud: PointCloud, radius: float) -> PointCloud:
    """Give the cloud its valid rings and the beam origin by them, or refuse it as too far.

    Parameters
    ----------
    cloud
        In any frame.
    radius
        Of the poles that are looked for in it, metres.

    Raises
    ------
    Refusal
        ``far_from_lidar`` if hardly a point is near enough to the beam origin for a pole to be
        seen there, and where a coordinate is beyond `FARTHEST_ORIGIN`.
    """
    check_coordinates(cloud)
    within = 2 * radius / THINNEST_POLE
    cloud = with_trusted_rings(cloud)
    found = with_beam_origin(cloud)
    if not _is_near(found, within) and cloud.ring is not None:
        # Seen from far away all points of a ring have one elevation, from wherever they were seen.
        middle = replace(cloud, origin=np.median(cloud.xyz, axis=0))
        reported = with_beam_origin(middle)
        found = found if reported is middle else reported
    if not _is_near(found, within):
        near = _count_near(found, within)
        away = float(np.median(_ranges(cloud)))
        odd = oddity_of(cloud)
        if odd is not None and odd.is_map:
            rest = (
                f"; {odd.text}; give it in the LiDAR's frame, or subtract the LiDAR's position "
                "from all points"
            )
        else:
            rest = (
                f" of the assumed origin of the beams, half are beyond {away:.0f} m: a pole "
                "cannot be seen at that distance; give the cloud in the LiDAR's frame, or with "
                "rings or a PCD viewpoint, which show where the LiDAR was"
            )
        raise Refusal(
            "far_from_lidar",
            f"{near} of {len(cloud)} points are within {within:g} m{rest}",
            {"near": near, "points": len(cloud), "median_m": away},
        )
    x, y, z = np.round(found.origin, -3)
    _check_within(
        found,
        FARTHEST_ORIGIN,
        "a pose is not accurate with an origin that far away; give the clouds in metres and in "
        f"the LiDARs' frames, or subtract an offset such as ({x:.0f}, {y:.0f}, {z:.0f})",
    )
    return found


def _check_within(cloud: PointCloud, most: float, advice: str) -> None:
    largest = max(cloud.xyz.max(initial=0.0), -cloud.xyz.min(initial=0.0), *np.abs(cloud.origin))
    if largest <= most:
        return
    reach = np.maximum(np.abs(cloud.xyz).max(axis=1), np.abs(cloud.origin).max())
    far = int(np.count_nonzero(reach > most))
    if 2 * far < len(cloud):
        advice = "these few are damaged or not returns; remove them"
    if far:
        raise Refusal(
            "far_from_lidar",
            f"{far} of {len(cloud)} points have a coordinate beyond {most:g} m, up to "
            f"{reach.max():.3g}: {advice}",
            {"far": far, "points": len(cloud), "largest_m": float(reach.max())},
        )


def _is_near(cloud: PointCloud, within: float) -> bool:
    """Whether enough points are within a range, metres: of a large cloud a part mostly suffices."""
    some = PointCloud(every_nth(cloud.xyz, RING_SAMPLE), origin=cloud.origin)
    needed = min(MIN_POLE_POINTS, len(cloud))
    return any(_count_near(each, within) >= needed for each in (some, cloud))


def _count_near(cloud: PointCloud, within: float) -> int:
    return int(np.count_nonzero(_ranges(cloud) <= within))


def _ranges(cloud: PointCloud) -> Array:
    return lengths(cloud.xyz - cloud.origin)
