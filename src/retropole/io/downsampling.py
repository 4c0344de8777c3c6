"""Clouds with more points than there is memory for are downsampled: evenly, and the same every
time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..base.datatypes import IntArray, PointCloud
from ..base.quantities import step_of
from .recordings import Frame, Recording

MAX_POINTS = 1_500_000
"""Points of one cloud that are worked on unless more are asked for. Of four streets recorded with
30 sweeps of 100,000 points, thinned to so many, the refined pose came out as well as of all
(0.001° to 0.009° off instead of 0.002° to 0.005°), in less than half the time."""

LEAST_POINTS = 1000
"""No fewer are asked for: they show no pole."""

FEWEST_FRAMES = 20
"""Of more frames, every second is left out before any is downsampled: whole frames keep the pattern
of the beams, and so many tell what moved."""

BRIGHT_SHARE = 0.01
"""Part of the points that are left which the brightest may be: 15,000 of them. Returns on
poles are some thousands, and so small a part moves no threshold found from the cloud."""

GOLDEN = (5**0.5 - 1) / 2
"""Its multiples, modulo 1, keep no step with the number of rings, which neighbours differ by."""


def downsample(cloud: PointCloud, most: int) -> PointCloud:
    """Keep `most` points of a cloud: the brightest, since returns on poles are few, and the others
    evenly in their order.

    Parameters
    ----------
    cloud
        Any; itself where it has no more.
    most
        How many points to keep, 1 or more.

    Returns
    -------
    PointCloud
        With its points in their order; those left out are counted in `thinned`.
    """
    if len(cloud) <= most:
        return cloud
    kept = np.zeros(len(cloud), bool)
    brightest = int(BRIGHT_SHARE * most)
    if cloud.intensity is not None and brightest:
        # Where more are equally bright, as where all saturate, they are downsampled like the
        # others.
        kept = cloud.intensity > np.partition(cloud.intensity, -brightest - 1)[-brightest - 1]
    others = np.flatnonzero(~kept)
    count = most - (len(cloud) - len(others))
    # Steps are 0.6 to 1.6 times their mean, so that one of 2 or more takes no point twice.
    is_kept = 2 * count <= len(others)
    kept[others] = not is_kept
    kept[others[_evenly(len(others), count if is_kept else len(others) - count)]] = is_kept
    return replace(cloud.select(kept), thinned=cloud.thinned + len(cloud) - most)


def _evenly(number: int, count: int) -> IntArray:
    """Choose `count` of `number` places, of which there are twice as many or more."""
    k = np.arange(count)
    return ((k + (k * GOLDEN) % 1.0) * (number / max(count, 1))).astype(np.int64)


def read_within(
    recording: Recording,
    numbers: range,
    most: int,
    progress: Callable[[str], None] = lambda step: None,
) -> tuple[range, list[Frame]]:
    """Read frames with no more than `most` points together, and never hold many more.

    Of many frames, every second is left out as often as it takes; of few, each is downsampled to
    its share.

    Parameters
    ----------
    recording, numbers
        What to read, and which of its frames.
    most
        How many points.
    progress
        Called as each of several frames is about to be read, with which of how many it is.

    Returns
    -------
    tuple of range and list of Frame
        Which frames were read, and these; all of them where they have no more points.
    """
    kept: list[Frame] = []
    while True:
        while _points(kept) > most:
            if len(numbers) > FEWEST_FRAMES:
                numbers = numbers[::2]
                kept = [frame for frame in kept if frame.number in numbers]
            else:
                share = max(most // len(numbers), 1)
                kept = [replace(frame, cloud=downsample(frame.cloud, share)) for frame in kept]
        if len(kept) == len(numbers):
            return numbers, kept
        _tell(progress, recording, len(kept), len(numbers))
        for frame in recording.read(numbers[len(kept) :]):
            kept.append(frame)
            _tell(progress, recording, len(kept), len(numbers))
            if _points(kept) > most:
                break


def _tell(progress: Callable[[str], None], recording: Recording, done: int, count: int) -> None:
    if done < count > 1:
        progress(step_of(f"read {recording.path.name}: frame", done + 1, count))


def _points(frames: list[Frame]) -> int:
    return sum(len(frame.cloud) for frame in frames)
