"""Pairs of LiDARs of a site that can be checked: those that shared poles, and how they are read."""

from __future__ import annotations

from ..result import RunConfig
from ..result.site import SiteDoc
from .site_file import LidarTable


def pair_config(stored: SiteDoc, target: LidarTable, source: LidarTable) -> RunConfig:
    """Take the options of a check of two LiDARs: of the poles from the result, else of the file."""
    return RunConfig(
        radius_m=stored.radius_m,
        radius_sigma_m=stored.radius_sigma_m,
        sensor_target=target.sensor,
        sensor_source=source.sensor,
        threshold_target=target.threshold,
        threshold_source=source.threshold,
        target_topic=target.topic,
        source_topic=source.topic,
        unit=target.unit,
        unit_source=source.unit,
    )


def shared_placements(target: LidarTable, source: LidarTable) -> list[int]:
    """Give the indices of the placements that both recorded."""
    both = zip(target.recordings, source.recordings, strict=False)
    return [n for n, recordings in enumerate(both) if all(recordings)]


def stored_pairs(document: SiteDoc) -> list[tuple[str, str]]:
    """Name the pairs that shared poles when the site was calibrated."""
    names = [lidar.name for lidar in document.lidars]
    return [
        (names[each.lidars[0]], names[each.lidars[1]])
        for each in document.pairs
        if each.shared_poles and each.refusal is None
    ]
