"""The recordings of each LiDAR of a site, searched for poles, relative to its beam origin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..alignment.origins import shifted
from ..base import se3
from ..base.datatypes import Array, PointCloud, Pole, Scan
from ..base.description import Site, SiteLidar
from ..base.errors import Refusal
from ..surfaces.averaging import averaged
from ..surfaces.patches import Patches, surface_patches
from ..surfaces.scans import find_poles
from ..surfaces.static import check_static, check_still
from ..surfaces.visibility import View, scoring_view
from .placements import merge_clouds

Recording = tuple[int, int]
"""Index of a LiDAR and of a placement."""


@dataclass(frozen=True, eq=False)
class SiteScans:
    """Scans of all LiDARs in all placements, each relative to its LiDAR's beam origin.

    Attributes
    ----------
    by_lidar
        For each LiDAR and placement; None if nothing was recorded or it cannot be used.
    origins
        (L, 3) where the beams of each LiDAR start in the frame of its clouds.
    faults
        Why a recording cannot be used.
    recorded
        The clouds of all recordings, including those that cannot be used: they show which place
        they are of.
    """

    by_lidar: tuple[tuple[Scan | None, ...], ...]
    origins: Array
    faults: tuple[tuple[Recording, Refusal], ...] = ()
    recorded: tuple[tuple[PointCloud | None, ...], ...] = ()

    @property
    def in_clouds(self) -> tuple[tuple[Scan | None, ...], ...]:
        """The same scans in the frames of the clouds, in which poses are stated."""
        return tuple(
            tuple(None if scan is None else shifted(scan, origin) for scan in row)
            for row, origin in zip(self.by_lidar, self.origins, strict=True)
        )

    def poles(self, lidar: int, placement: int) -> tuple[Pole, ...]:
        """Poles that a LiDAR sees in a placement."""
        scan = self.by_lidar[lidar][placement]
        return () if scan is None else scan.poles

    def used(self, lidar: int) -> list[Scan]:
        """Scans of a LiDAR that can be used."""
        return [scan for scan in self.by_lidar[lidar] if scan is not None]

    def scene(self, lidar: int) -> PointCloud | None:
        """The scans of a LiDAR in all placements; None without any."""
        used = self.used(lidar)
        return merge_clouds([averaged(scan.cloud) for scan in used]) if used else None

    @property
    def exchanged(self) -> SiteScans:
        """The same for two LiDARs in the other order."""
        return SiteScans(
            self.by_lidar[::-1],
            self.origins[::-1],
            tuple(((1 - i, p), fault) for (i, p), fault in self.faults),
            self.recorded[::-1],
        )

    def without(self, recordings: set[Recording]) -> SiteScans:
        """Give the same without some recordings."""
        kept = tuple(
            tuple(None if (i, p) in recordings else scan for p, scan in enumerate(row))
            for i, row in enumerate(self.by_lidar)
        )
        return replace(self, by_lidar=kept)


def find_scans(site: Site) -> SiteScans:
    """Search every recording of a site for poles; if one was carried, leave out moving objects.

    A recording that cannot be used is left out and reported in `SiteScans.faults`: others may be
    sufficient.
    """
    rows, faults, recorded = [], [], []
    origins = np.zeros((len(site.lidars), 3))
    for i, lidar in enumerate(site.lidars):
        first = next((cloud for cloud in lidar.clouds if cloud is not None), None)
        if first is not None:
            origins[i] = first.origin
        row: list[Scan | None] = []
        clouds: list[PointCloud | None] = []
        for p, cloud in enumerate(lidar.clouds):
            scan = None if cloud is None else _scan(site, lidar, cloud, origins[i])
            clouds.append(None if scan is None else scan.cloud)
            try:
                row.append(_checked(lidar.name, scan))
            except Refusal as refusal:
                faults.append(((i, p), refusal))
                row.append(None)
        rows.append(tuple(row))
        recorded.append(tuple(clouds))
    return SiteScans(tuple(rows), origins, tuple(faults), tuple(recorded))


def _scan(site: Site, lidar: SiteLidar, cloud: PointCloud, origin: Array) -> Scan:
    about = replace(cloud, xyz=cloud.xyz - origin, origin=cloud.origin - origin)
    return find_poles(
        about,
        sensor=lidar.sensor,
        threshold=lidar.threshold,
        radius=site.radius,
        search=not site.carried,
        mast_sway=lidar.mast_sway,
    )


def _checked(name: str, scan: Scan | None) -> Scan | None:
    if scan is None:
        return None
    if scan.refusal is not None:
        raise scan.refusal
    check_still(name, scan.cloud)
    check_static(name, scan.cloud, scan.poles)
    return scan


@dataclass(frozen=True, eq=False)
class Views:
    """The view of each LiDAR, downsampled, to compare one with another; None if it saw nothing.

    `every` has one view for each placement, `first` that of the first which was recorded.
    """

    every: tuple[tuple[View | None, ...], ...]

    def first(self, lidar: int) -> View | None:
        """View of the first placement that a LiDAR recorded."""
        return next((view for view in self.every[lidar] if view is not None), None)


def views_of(scans: SiteScans) -> Views:
    """Downsample every recording."""
    return Views(
        tuple(
            tuple(None if cloud is None else scoring_view(cloud) for cloud in row)
            for row in scans.recorded
        )
    )


def poses_in_clouds(T: Array, covariance: Array, origins: Array) -> tuple[Array, Array]:
    """Convert poses relative to the LiDARs' beam origins, and their covariance, to the clouds'
    frames.

    Parameters
    ----------
    T, covariance
        (L, 4, 4) site from LiDAR, relative to the beam origin, and (6 L, 6 L) of all poses.
    origins
        (L, 3) beam origins in the LiDARs' frames.

    Returns
    -------
    poses, covariance
        Of the same shapes.
    """
    back = np.eye(len(covariance))
    poses = []
    for i, (pose, origin) in enumerate(zip(T, origins, strict=True)):
        arm = pose[:3, :3] @ origin
        back[6 * i + 3 : 6 * i + 6, 6 * i : 6 * i + 3] = se3.hat(arm)
        poses.append(se3.from_rt(pose[:3, :3], pose[:3, 3] - arm))
    moved = back @ covariance @ back.T
    return np.stack(poses), np.asarray((moved + moved.T) / 2)


def patches_of(scans: SiteScans) -> list[Patches | None]:
    """Fit surface patches to the recordings of each LiDAR; None if it recorded nothing."""
    scenes = (scans.scene(lidar) for lidar in range(len(scans.by_lidar)))
    return [None if scene is None else surface_patches(scene) for scene in scenes]
