"""Distances between the surfaces that two LiDARs see, under the poses of the answer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..base import se3
from ..base.datatypes import every_nth
from ..fusion.merging import LIDARS, Points, fused
from ..fusion.surfels import Distance, distances, moments_of, surface_distances, up_by_ground
from .listings import Listing, columns
from .page import EMPTY, Html, fill, listed
from .subject import Subject

MOST_POINTS = 300_000
"""Number of points of each recording that are used, evenly spread: it takes 0.1 s."""

FARTHEST = 300.0
"""Surfaces farther from their LiDAR are not used, metres: points are too sparse there."""

FEWEST_SURFELS = 20
"""Fewer give no information: each is off by some millimetres."""


def distances_of_surfaces(subject: Subject) -> Html:
    """List the distances between surfaces; empty if no two LiDARs see any, or none has a
    pose."""
    found = [each for each in measured_distances(subject) if each.surfels >= FEWEST_SURFELS]
    if not found:
        return EMPTY
    # The most surfels are the most informative; with many pairs the rest is folded away.
    found.sort(key=lambda each: -each.surfels)
    rows = [
        [
            "–".join(subject.site.lidars[k].name for k in each.lidars),
            *(each.kind, f"{1000 * each.median_m:.1f}", f"{1000 * each.median_signed_m:+.1f}"),
            *(each.surfels, f"{each.area_m2:.1f}"),
        ]
        for each in found
    ]
    header = columns("LiDARs; surface; apart, mm; signed, mm; surfels; area, m²")
    return fill(
        "surface-distances",
        table=listed(Listing("Distances between surfaces, medians", header, rows, (1,))),
    )


def measured_distances(subject: Subject) -> list[Distance]:
    """Compare the surfaces of all LiDARs of a subject in its frame."""
    if not subject.answered or not subject.scans or len(subject.scans) > LIDARS:
        return []
    poses = [np.array(each.T_site_lidar) for each in subject.site.lidars]

    def sweeps() -> Iterator[Points]:
        for k, (pose, scans) in enumerate(zip(poses, subject.scans, strict=True)):
            for scan in scans:
                if scan is not None:
                    rows = every_nth(np.arange(len(scan.cloud)), MOST_POINTS)
                    rows = rows[se3.lengths(scan.cloud.xyz[rows]) < FARTHEST]
                    yield fused(scan.cloud.select(rows), pose, k)

    up, origins = None, np.array([pose[:3, 3] for pose in poses])
    if subject.site.frame.surveyed:
        up = np.array([0.0, 0.0, 1.0])
    for k, scans in enumerate(subject.scans):
        for scan in scans:
            if scan is not None:
                origins[k] = se3.apply(poses[k], scan.cloud.origin[None])[0]
                up = up_by_ground(scan.cloud, poses[k]) if up is None else up
    if up is None:
        return []
    return distances(surface_distances(moments_of(sweeps()), origins, up))
