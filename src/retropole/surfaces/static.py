"""Many frames of a static scene: drop what moved; the LiDAR and the poles must not have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray, Placement, PointCloud, Pole
from ..base.errors import Refusal
from .copies import check_recordings
from .disambiguation import ICP_CORRESPONDENCE_DISTANCE, SCORING_VOXEL
from .ordering import numbered
from .registration import Registration, Surface, prepare, register, surface_of
from .visibility import cells_of, nearest_by_frame, range_margin

MIN_FRAMES = 3
"""With fewer frames nothing tells what moved: a majority needs three. Whether a LiDAR turned, the
first and the last third of the frames tell."""

MIN_RETURNS_PER_RUN = 5
"""Returns on a pole that a run of frames needs to tell where the pole is."""

RUNS = 6
"""Runs of frames that a recording is cut into to see whether a pole moved."""

DRIFT_SIGMAS = 5.0
"""A pole moved if it strays by the usual radius of a pole, and by so many times the noise."""

MAX_TURN = np.radians(0.3)
"""A LiDAR moved if it turned by more while it recorded. The first and the last frames of 72 LiDARs
that stood came to 0.11° at most, those of 24 that were bumped by 0.5 to 6° to 0.45° and more
(benchmarks/deception.py, "LiDAR bumped while recording", seeds 100 to 123)."""

SECTORS = 8
"""Parts of the surroundings, by azimuth, each with as many points: what the turn is without each
shows how certain it is."""

TURN_SIGMAS = 5.0
"""A turn must also exceed this multiple of its own σ. Single sweeps of a LiDAR that does not repeat
its pattern show other points of the same surfaces: of 96 still Mid-360 recordings the turn was up
to 0.48°, and 3.6 σ at most; of VLP-16 and XT32 that were turned by 0.35 and 0.5° it was 16 σ and
more (streets, harbors and corridors, seeds 0 to 3). With 8 sectors, 4.8 σ are exceeded by chance
once in a thousand times (Student's t)."""

MEDIAN_VARIANCE = np.pi / 2
"""Variance of the median of many normal values, as a multiple of that of their mean."""


def remove_dynamic_points(cloud: PointCloud) -> PointCloud:
    """Drop the returns on objects that moved while the frames were recorded.

    A static object is seen by the other frames in the same direction at the same range. Where most
    of the frames that have returns there saw farther, something was there for a while only.

    Parameters
    ----------
    cloud
        With `frame`; a cloud of less than `MIN_FRAMES` frames is returned as it is.
    """
    if cloud.frame is None:
        return cloud
    frames, frame = numbered(cloud.frame)
    if len(frames) < MIN_FRAMES:
        return cloud
    return cloud.select(_is_static(cloud, frame, len(frames)))


def _is_static(cloud: PointCloud, frame: IntArray, frames: int) -> BoolArray:
    """Whether half of the frames that saw anything in the direction of a return saw no farther.

    The frame (N,) of each return is given, counted from 0, and how many there are.
    """
    rays = cloud.xyz - cloud.origin
    ranges = se3.lengths(rays)
    cells = cells_of(rays)
    nearest = nearest_by_frame(cells, ranges, frame, frames)
    # What half of the frames saw there, the nearer half.
    nearest.sort(axis=0)
    half = np.maximum((np.isfinite(nearest).sum(axis=0) - 1) // 2, 0)
    usual = np.take_along_axis(nearest, half[None], axis=0)[0]
    return np.asarray(usual[cells] <= ranges + range_margin(ranges))


def check_still(name: str, cloud: PointCloud) -> None:
    """Refuse a LiDAR that turned while the frames were recorded.

    The last frames are registered to the first. Only the turn is judged: a scene such as a corridor
    leaves a shift open.

    Raises
    ------
    Refusal
        ``moving_lidar``.
    """
    turn = turned_by(cloud)
    if turn > MAX_TURN:
        raise Refusal(
            "moving_lidar",
            f"the {name} LiDAR turned by {np.degrees(turn):.1f}° while it recorded "
            f"({np.degrees(MAX_TURN):.1f}° is allowed): fasten it and record again, or read the "
            "frames while it stood still",
            {"lidar": name, "turned_rad": turn, "allowed_rad": float(MAX_TURN)},
        )


def turned_by(cloud: PointCloud) -> float:
    """How far a LiDAR turned from the first frames to the last, rad; 0 where that is not known.

    A turn of more than `MAX_TURN` is known where it is also more than `TURN_SIGMAS` of its noise.
    """
    if cloud.frame is None:
        return 0.0
    frames, _ = numbered(cloud.frame)
    part = max(len(frames) // MIN_FRAMES, 1)
    if len(frames) < 2:
        return 0.0
    ends = (
        cloud.xyz[cloud.frame <= frames[part - 1]],
        cloud.xyz[cloud.frame >= frames[-part]],
    )
    try:
        first, last = (prepare(xyz, SCORING_VOXEL) for xyz in ends)
        moved = _registered(first, last, np.eye(4))
        if not moved.converged:
            return 0.0
        turn = se3.rotation_angle(moved.T_target_source[:3, :3])
        if turn > MAX_TURN and turn < TURN_SIGMAS * _turn_sigma(first, last, cloud.origin, moved):
            return 0.0
    except Refusal:
        return 0.0
    return turn


def _registered(first: Surface, last: Surface, T_start: Array) -> Registration:
    return register(
        first,
        last,
        T_start,
        method="GICP",
        max_correspondence_distance=ICP_CORRESPONDENCE_DISTANCE,
    )


def _turn_sigma(first: Surface, last: Surface, origin: Array, moved: Registration) -> float:
    """1 σ of the turn of a registration in its least certain direction, rad.

    By the jackknife over sectors of the surroundings (Efron and Stein 1981). The inverse of the
    registration's information, scaled by its residuals, is 5 to 7 times too small for sparse
    clouds: neighbouring points share the errors of the surfaces that are estimated from them.
    """
    rays = last.xyz - origin
    order = np.argsort(np.arctan2(rays[:, 1], rays[:, 0]))
    steps = []
    for sector in np.array_split(order, SECTORS):
        rest = surface_of(np.delete(last.xyz, sector, axis=0))
        without = _registered(first, rest, moved.T_target_source)
        steps.append(se3.local(moved.T_target_source, without.T_target_source)[:3])
    apart = np.array(steps) - np.mean(steps, axis=0)
    covariance = (SECTORS - 1) / SECTORS * apart.T @ apart
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


class Drift(NamedTuple):
    """How far a pole strays across its axis between runs of frames, and the 1 σ of that, metres."""

    distance: float
    sigma: float


def pole_drift(pole: Pole, frame: IntArray) -> Drift:
    """Measure how far a pole strays across its axis between runs of frames.

    Parameters
    ----------
    pole
        Fitted to all frames.
    frame
        (N,) the frame of each of its returns.

    Returns
    -------
    Drift
        Of the run that lies farthest from the mean; zero and infinite where no two runs have
        `MIN_RETURNS_PER_RUN`.
    """
    offset = pole.xyz - pole.point
    across = offset - (offset @ pole.direction)[:, None] * pole.direction
    runs = np.array_split(np.unique(frame), min(RUNS, len(np.unique(frame))))
    means: list[Array] = []
    sizes: list[int] = []
    for run in runs:
        own = np.isin(frame, run)
        if np.count_nonzero(own) >= MIN_RETURNS_PER_RUN:
            means.append(np.median(across[own], axis=0))
            sizes.append(int(np.count_nonzero(own)))
    if len(means) < 2:
        return Drift(0.0, np.inf)
    apart = np.linalg.norm(np.array(means) - np.mean(means, axis=0), axis=1)
    worst = int(np.argmax(apart))
    sigma = np.sqrt(MEDIAN_VARIANCE / sizes[worst]) * pole.rms
    return Drift(float(apart[worst]), float(sigma))


def check_poles(placements: Sequence[Placement]) -> None:
    """Refuse a recording given twice, clouds that could not be searched, and what moved meanwhile.

    Raises
    ------
    Refusal
        ``same_recording``, ``no_intensity``, ``moving_lidar``, ``moving_pole`` and others.
    """
    check_recordings(placements)
    for placement in placements:
        for name, scan in (("target", placement.target), ("source", placement.source)):
            if scan.refusal is not None:
                raise scan.refusal
            check_still(name, scan.cloud)
            check_static(name, scan.cloud, scan.poles)


def check_static(name: str, cloud: PointCloud, poles: Sequence[Pole]) -> None:
    """Refuse poles that moved while the frames were recorded.

    Raises
    ------
    Refusal
        ``moving_pole``.
    """
    if cloud.frame is None:
        return
    for k, pole in enumerate(poles):
        distance, sigma = pole_drift(pole, cloud.frame[pole.index])
        if distance > DEFAULT_RADIUS and distance > DRIFT_SIGMAS * sigma:
            raise Refusal(
                "moving_pole",
                f"pole {name[0].upper()}{k} of the {name} strays by {100 * distance:.1f} cm "
                f"between frames, "
                f"{distance / sigma:.0f} times its noise: hold the poles still, or record again",
                {"lidar": name, "pole": k, "drift_m": distance, "sigma_m": sigma},
            )
