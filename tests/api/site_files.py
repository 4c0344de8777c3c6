"""Site files with recordings beside them, and what a calibration of them might answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import PointCloud, Scan
from retropole.base.description import Site
from retropole.io import write_pcd
from tests.report.site.made_up import made_up_site

NAMES = ("mast-a", "mast-b", "gate")


def recorded(seed: int) -> PointCloud:
    """Some points between 2 and 30 m, with an intensity."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return PointCloud(rng.uniform(2, 30, 200)[:, None] * directions, rng.uniform(1, 90, 200))


def write_recordings(folder: Path, form: str = "{lidar}/{placement}.pcd") -> list[Path]:
    """Write recordings of three LiDARs and two placements; the last has one."""
    paths = []
    for k, lidar in enumerate(NAMES):
        for n in range(2 - (k == 2)):
            path = folder / form.format(lidar=lidar, placement=n + 1)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_pcd(path, recorded(10 * k + n))
            paths.append(path)
    return paths


def write_site(folder: Path, more: str = "") -> Path:
    """Write a site file and its recordings."""
    write_recordings(folder)
    lidars = "".join(
        f'[[lidar]]\nname = "{lidar}"\n'
        f'recordings = ["{lidar}/1.pcd", "{f"{lidar}/2.pcd" if k < 2 else ""}"]\n'
        for k, lidar in enumerate(NAMES)
    )
    path = folder / "site.toml"
    path.write_text(f'name = "Quay"\nplacements = ["1", "2"]\n{lidars}{more}')
    return path


def answer_to(site: Site, status: Status = "ok") -> SiteCalibration:
    """Make up the answer for a site: sound in form, and about nothing."""
    count = len(site.lidars)
    made_up = made_up_site(status, lidars=count, placements=len(site.placements), count=40)
    scans = tuple(
        tuple(None if cloud is None else Scan(cloud, lidar.sensor) for cloud in lidar.clouds)
        for lidar in site.lidars
    )
    poses = tuple(
        replace(pose, T_site_lidar=se3.random(np.random.default_rng(k)))
        for k, pose in enumerate(made_up.lidars)
    )
    return replace(made_up, site=site, scans=scans, lidars=poses)
