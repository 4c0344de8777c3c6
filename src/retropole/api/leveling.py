"""Roll, pitch and height over the ground of the LiDARs of a stored result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import UsageError
from ..base.files import path_in_text
from ..base.sensors import sensor_or_auto
from ..base.systematic import sizes_of
from ..ground.level import Leveled, LidarLevel, level
from ..ground.surface import Viewer, viewer_of
from ..result import ResultDoc
from ..result.level import LevelDoc, level_document
from ..result.site import SiteDoc, as_site
from ..surfaces.scans import find_poles
from .inputs import SILENT, Listener, input_documents, read_input
from .stored import find_recordings, with_poses, with_sensors_from


class BaseLink(NamedTuple):
    """Where a LiDAR is on the vehicle, along the ground.

    Attributes
    ----------
    x, y, yaw
        Of the LiDAR in ``base_footprint``, metres, and the heading of its x axis there, rad.
    sigma, sigma_yaw
        1 σ of x and of y, metres, and of the yaw, rad.
    """

    x: float
    y: float
    yaw: float
    sigma: float = 0.01
    sigma_yaw: float = float(np.radians(0.5))


def level_result(
    result: str | Path,
    given: Sequence[Path] = (),
    *,
    base: BaseLink | None = None,
    lidar: str | None = None,
    radius: float | None = None,
    listener: Listener = SILENT,
) -> tuple[LevelDoc, Leveled]:
    """Find roll, pitch and height over the ground of the LiDARs of a result.

    Parameters
    ----------
    result
        A result of a pair or of a site, or its folder.
    given
        Where its recordings are now, as `stored.find_recordings` takes them.
    base, lidar
        If that LiDAR, or the target or the first of a site, is on the vehicle.
    radius
        Of the disc that the plane is for, metres; None as `ground.level.level`.
    listener
        Receives each step, and each cloud that is read.

    Raises
    ------
    Refusal
        ``too_little_ground``, ``two_grounds``; or that of the result, which has no poses.
    UsageError
        If there is no LiDAR of that name.
    ReadError, MissingExtraError
        If the result or a recording cannot be read; as `stored.find_recordings`.
    """
    file, document = with_poses(result)
    site = with_sensors_from(as_site(document), file.parent)
    is_pair = isinstance(document, ResultDoc)
    names = [each.name for each in site.lidars]
    if lidar is not None and lidar not in names:
        raise UsageError(f"no LiDAR is named {lidar!r}; there are {', '.join(names)}")
    viewers, inputs, used = list[Viewer](), [], list[int]()
    for item, path, _ in find_recordings(document, file.parent, given):
        if path is None or item.lidar in used:
            continue
        read = read_input(path, item.reading(site.config.max_points), listener)
        cloud = find_poles(
            read.cloud, sensor=read.sensor, threshold=None, radius=site.radius_m, search=False
        ).cloud
        about = site.lidars[item.lidar]
        assert about.T_site_lidar is not None
        # A document may name a sensor that only its LiDAR, not its recording, has.
        sizes = sizes_of(read.sensor or sensor_or_auto(about.sensor))
        viewers.append(viewer_of(about.name, cloud, np.asarray(about.T_site_lidar), sizes))
        used.append(item.lidar)
        inputs.append(read)
    if not viewers:
        raise UsageError(f"{file}: none of its recordings was found; give them after RESULT")
    listener.progress("level")
    # The matrices are small: threads of BLAS only wait for each other.
    with threadpool_limits(1):
        leveled = level(viewers, _joint(document, used), radius)
    bases = {}
    if base is not None:
        first = next(each for each in leveled.lidars if each.name == (lidar or viewers[0].name))
        bases = _on_vehicle(leveled.lidars, first, base)
    return (
        level_document(
            leveled,
            result=path_in_text(str(file)),
            frame="target" if is_pair else "site",
            inputs=input_documents(inputs),
            bases=bases,
        ),
        leveled,
    )


def _joint(document: ResultDoc | SiteDoc, used: Sequence[int]) -> Array:
    """(6 L, 6 L) covariance of the poses of LiDARs in the frame of a result."""
    if isinstance(document, ResultDoc):
        joint = np.zeros((12, 12))
        joint[6:, 6:] = np.asarray(document.covariance)
    else:
        assert document.joint_covariance is not None
        joint = document.joint_covariance
    rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in used])
    return np.asarray(joint[np.ix_(rows, rows)])


def _on_vehicle(
    lidars: Sequence[LidarLevel], first: LidarLevel, base: BaseLink
) -> dict[str, tuple[Array, Array]]:
    """Pose (4, 4) in ``base_footprint`` and covariance (6, 6) of each LiDAR, by its name.

    ``base_footprint`` is moved along the ground and turned about its normal, so that the LiDAR
    `first` is where it was measured.
    """
    own = first.T_ground_lidar
    turn = base.yaw - se3.rpy_from_rotation(own[:3, :3])[2]
    R = se3.rotation_from_rpy(np.array([0.0, 0.0, turn]))
    at = np.array([base.x, base.y, 0.0]) - R @ np.r_[own[:2, 3], 0.0]
    T_base_ground, found = se3.from_rt(R, at), {}
    for lidar in lidars:
        T = T_base_ground @ lidar.T_ground_lidar
        both = np.kron(np.eye(2), R)
        # The yaw turns the vehicle's axes about the measured LiDAR.
        by_yaw = np.r_[0.0, 0.0, 1.0, np.cross([0, 0, 1], T[:3, 3] - [base.x, base.y, 0])]
        covariance = both @ lidar.covariance @ both.T
        covariance += base.sigma_yaw**2 * np.outer(by_yaw, by_yaw)
        covariance += base.sigma**2 * np.diag([0, 0, 0, 1, 1, 0])
        found[lidar.name] = T, (covariance + covariance.T) / 2
    return found
