"""Many frames of a standing scene: drop what moved, and check that the poles did not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..datatypes import Array, IntArray, PointCloud, Pole
from ..errors import Refusal

CELL = np.radians(1.0)
"""Side of a cell of direction in which the frames are compared."""

SEEN_THROUGH = 0.5
"""A return is seen through by a frame whose returns around its direction all lie so much farther,
metres, and a tenth of its range."""

MIN_FRAMES = 3
"""With fewer frames nothing tells what moved."""

MIN_RETURNS_PER_RUN = 5
"""Returns on a pole that a frame, or a run of frames, needs to say where the pole is."""

RUNS = 6
"""Runs of frames that a recording is cut into to see whether a pole moved."""

MAX_DRIFT, SIGMAS = 0.02, 5.0
"""A pole moved if it strays by the first, metres, and by so many times the noise."""


def remove_dynamic_points(cloud: PointCloud) -> PointCloud:
    """Drop the returns on things that moved while the frames were recorded.

    A thing that stands is seen by the other frames in the same direction at the same range. Where
    most of the frames that have returns there saw farther, something was there for a while only.

    Parameters
    ----------
    cloud
        With `frame`; a cloud of less than `MIN_FRAMES` frames is given back as it is.
    """
    if cloud.frame is None:
        return cloud
    frames, frame = np.unique(cloud.frame, return_inverse=True)
    if len(frames) < MIN_FRAMES:
        return cloud
    frame = frame.reshape(-1)
    ray = cloud.xyz - cloud.origin
    ranges = np.linalg.norm(ray, axis=1)
    rows, columns = int(np.pi / CELL), int(2 * np.pi / CELL)
    azimuth = np.arctan2(ray[:, 1], ray[:, 0])
    row = np.clip((np.arccos(ray[:, 2] / ranges) / CELL).astype(np.intp), 0, rows - 1)
    column = ((azimuth + np.pi) / CELL).astype(np.intp) % columns
    margin = np.maximum(SEEN_THROUGH, 0.1 * ranges)
    through, there = np.zeros(len(cloud), dtype=np.int64), np.zeros(len(cloud), dtype=np.int64)
    for k in range(len(frames)):
        own = frame == k
        image = np.full((rows + 2, columns), np.inf)
        np.minimum.at(image, (row[own] + 1, column[own]), ranges[own])
        # The nearest around: an edge may fall into the next cell from one frame to the other.
        nearest = np.minimum(np.minimum(image[:-2], image[1:-1]), image[2:])
        nearest = np.minimum(np.minimum(np.roll(nearest, 1, 1), nearest), np.roll(nearest, -1, 1))
        seen = nearest[row, column]
        through += np.isfinite(seen) & (seen > ranges + margin)
        there += seen <= ranges + margin
    return cloud.select(through <= there)


def drift(pole: Pole, frame: IntArray) -> tuple[float, float]:
    """How far a pole strays across its axis between runs of frames, and the 1 σ of that, metres.

    Parameters
    ----------
    pole
        Fitted to all frames.
    frame
        (N,) the frame of each of its returns.

    Returns
    -------
    distance, sigma
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
        return 0.0, np.inf
    apart = np.linalg.norm(np.array(means) - np.mean(means, axis=0), axis=1)
    worst = int(np.argmax(apart))
    # The median of n has π/2 times the variance of their mean.
    return float(apart[worst]), float(np.sqrt(np.pi / 2) * pole.rms / np.sqrt(sizes[worst]))


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
        distance, sigma = drift(pole, cloud.frame[pole.index])
        if distance > MAX_DRIFT and distance > SIGMAS * sigma:
            raise Refusal(
                "moving_pole",
                f"pole {k} of the {name} strays by {100 * distance:.1f} cm between frames, "
                f"{distance / sigma:.0f} times its noise: hold the poles still, or record anew",
                {"lidar": name, "pole": k, "drift_m": distance, "sigma_m": sigma},
            )
