"""Many frames of a static scene: drop what moved; the LiDAR and the poles must not have.

Two LiDARs that record at different times may see different scenes, so the times are compared too.
And two measurements never agree to the last digit: what is there twice was measured once: counted
twice it would make an answer more certain than it is, and as both clouds a perfect one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from ..base import quantities, se3
from ..base.datatypes import (
    DEFAULT_RADIUS,
    Array,
    BoolArray,
    IntArray,
    Placement,
    PointCloud,
    Pole,
    kept,
)
from ..base.errors import Reason, Refusal
from ..extraction.lines import MIN_POLE_POINTS
from ..io.recordings import time_of_recording
from .registration import SAMPLE, Registration, Surface, prepare, register, surface_of
from .sweeps import numbered, order_of
from .visibility import (
    ICP_CORRESPONDENCE_DISTANCE,
    SCORING_VOXEL,
    cells_of,
    nearest_by_frame,
    range_margin,
)

MAX_APART = 60.0
"""Recordings whose times differ by more than this were made at other times, seconds. Clocks that
are set differ by less: GPS and atomic time by 18 and 37 s from that of computers."""


def recorded_together(placements: Sequence[Placement]) -> bool:
    """Whether both LiDARs recorded every placement at the same time, as far as their clocks say.

    Nobody carries poles between recordings that overlap.
    """
    return all(apart is not None and apart < 0.0 for apart in (_apart(each) for each in placements))


def _apart(placement: Placement) -> float | None:
    """Seconds from the end of one recording to the start of the other; None if not known."""
    target, source = (time_of_recording(scan.cloud) for scan in placement.scans)
    if target is None or source is None:
        return None
    return max(target[0] - source[1], source[0] - target[1])


def other_times(placements: Sequence[Placement]) -> Iterator[Reason]:
    """Report placements that the two LiDARs recorded at other times, as far as their clocks show.

    What was moved in between looks the same as another pose.
    """
    for k, placement in enumerate(placements, 1):
        apart = _apart(placement)
        if apart is not None and apart > MAX_APART:
            of = "" if len(placements) == 1 else f" of placement {k}"
            yield Reason(
                "other_times",
                f"by their timestamps the two recordings{of} differ by "
                f"{quantities.duration(apart)} ({quantities.duration(MAX_APART)} are allowed): the "
                "answer is right only if the poles and the LiDARs were still in between",
                {"placement": k, "apart_s": apart, "allowed_s": MAX_APART},
            )


MIX = np.uint64(0x9E3779B97F4A7C15)
"""Multiplier of the hash: 2⁶⁴ over the golden ratio, odd (Knuth 1998, TAOCP 3, 6.4)."""

MAX_SHARED = 0.5
"""Largest share of the points that may be the same number for number. Two sweeps of one LiDAR
at rest share what its steps of range leave equal: 9 % with a noise of three steps, 28 % with one
(1 / (2 √π) over the noise in steps)."""

Keys = np.ndarray[tuple[int], np.dtype[np.uint64]]


def without_copies(cloud: PointCloud) -> PointCloud:
    """Keep the first of points that are equal number for number within a sweep, and of sweeps that
    are equal as a whole.

    A LiDAR that is set to report the strongest and the last return gives most points twice. One
    never gives a sweep twice: who repeats it has recorded no more.

    Parameters
    ----------
    cloud
        Returned as it is where no point is there twice.
    """
    keys = keys_of(cloud.xyz)
    if cloud.frame is not None:
        repeated = _repeated(keys, cloud.frame)
        if repeated.any():
            cloud, keys = cloud.select(~repeated), keys[~repeated]
        assert cloud.frame is not None
        keys = keys ^ (cloud.frame.astype(np.uint64) * MIX)
    ordered = np.sort(keys)
    if not (ordered[1:] == ordered[:-1]).any():
        return cloud
    order = order_of(keys)
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    return cloud.select(np.sort(np.minimum.reduceat(order, starts)))


def _repeated(keys: Keys, frame: IntArray) -> BoolArray:
    """Find the points (N,) of sweeps whose points are those of a sweep before, in any order."""
    frames, own = numbered(frame)
    sums = np.zeros(len(frames), np.uint64)
    np.add.at(sums, own, keys * MIX)
    both = np.stack([np.bincount(own).astype(np.uint64), sums], axis=1)
    first = np.unique(both, axis=0, return_index=True)[1]
    return ~np.isin(own, first)


def check_recordings(placements: Sequence[Placement]) -> None:
    """Refuse a recording, or a part of it in whatever order, that is given twice.

    It may be both target and source, or be in two placements.

    Raises
    ------
    Refusal
        ``same_recording``.
    """
    scans = [
        (k, lidar, scan.cloud.xyz)
        for k, placement in enumerate(placements, 1)
        for lidar, scan in (("target", placement.target), ("source", placement.source))
        if len(scan.cloud)
    ]
    # Equal points have equal hashes: a sample by the hash is one of the same points of all clouds.
    fewest = min((len(xyz) for _, _, xyz in scans), default=0)
    most = np.uint64(np.iinfo(np.uint64).max // max(fewest // SAMPLE, 1))
    each = [(k, lidar, _sampled(keys_of(xyz), most)) for k, lidar, xyz in scans]
    for (k, first, of_first), (n, second, of_second) in combinations(each, 2):
        shared = max(_shared(of_first, of_second), _shared(of_second, of_first))
        if shared <= MAX_SHARED:
            continue
        several = len(placements) > 1
        names = (
            f"the {first}{f' of placement {k}' if several else ''}",
            f"the {second}{f' of placement {n}' if several else ''}",
        )
        raise Refusal(
            "same_recording",
            f"{names[0]} and {names[1]} are one recording: {shared:.0%} of the points of one are, "
            f"number for number, in the other, too; {what_to_give(k, n)}",
            {"shared": shared},
        )


def what_to_give(first: int, second: int) -> str:
    """Advise what to give instead if recordings of two placements, or of one, are the same."""
    if first == second:
        return "give the recording of one LiDAR as TARGET and that of the other as SOURCE"
    return "give each placement separate recordings, made after the poles were moved"


def _sampled(keys: Keys, most: np.uint64) -> Keys:
    """Those that are no larger, sorted; all where that is none."""
    kept = keys[keys <= most]
    return np.sort(kept if len(kept) else keys)


def _shared(part: Keys, whole: Keys) -> float:
    """Share of the first keys that are among the second, both sorted."""
    place = np.minimum(np.searchsorted(whole, part), len(whole) - 1)
    return float(np.mean(whole[place] == part))


def keys_of(xyz: Array) -> Keys:
    """(N,) one number for each row, by its bits: unequal ones hardly ever have the same."""
    key = np.zeros(len(xyz), dtype=np.uint64)
    for column in xyz.T:
        # No zero is negative then.
        key ^= (column + 0.0).view(np.uint64)
        key *= MIX
        key ^= key >> np.uint64(32)
    return key


MIN_FRAMES = 3
"""With fewer frames what moved is unknown: a majority needs three. Whether a LiDAR turned follows
from the first and the last third of the frames."""

RUNS = 6
"""Runs of frames that a recording is cut into to see whether a pole moved."""

MAX_TURN = np.radians(0.3)
"""A LiDAR moved if it turned by more while it recorded. The first and the last frames of 72 LiDARs
that were still came to at most 0.11°, those of 24 that were bumped by 0.5 to 6° to 0.45° and more
(benchmarks/deception.py, "LiDAR bumped while recording", seeds 100 to 123)."""

SECTORS = 8
"""Parts of the surroundings, by azimuth, each with as many points: what the turn is without each
shows how certain it is."""

MISMATCH = 0.5
"""Turns between runs of frames add up within this part of the turn from first to last, and none is
larger by more. Of Mid-360 that were bumped by 0.5° they do within 0.1, of HAP and Mid-360 on open
ground that were not they are 3 to 12 times as large in all (`sweeps.py --pairs`, seeds to 5)."""

MOVED_SIGMAS = 5.0
"""A turn must also exceed this multiple of its σ, and a pole stray by as much. Single sweeps of
a LiDAR that does not repeat its pattern show other points of the same surfaces: of 96 still Mid-360
recordings the turn was up to 0.48°, or 3.6 σ; of VLP-16 and XT32 that were turned by 0.35
and 0.5° it was 16 σ and more (streets, harbors and corridors, seeds 0 to 3). With 8 sectors, 4.8 σ
are exceeded by chance once in a thousand times (Student's t)."""

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
    usual = usual_ranges(nearest_by_frame(cells, ranges, frame, frames))
    return np.asarray(usual[cells] <= ranges + range_margin(ranges))


def usual_ranges(nearest: Array) -> Array:
    """What half of the frames saw in each cell, the nearer half, (E, A) metres.

    Parameters
    ----------
    nearest
        (frames, E, A) least range of each frame; infinite where it saw nothing. It is sorted.
    """
    nearest.sort(axis=0)
    half = np.maximum((np.isfinite(nearest).sum(axis=0) - 1) // 2, 0)
    return np.asarray(np.take_along_axis(nearest, half[None], axis=0)[0])


def check_still(name: str, cloud: PointCloud) -> None:
    """Refuse a LiDAR that turned while the frames were recorded.

    The last frames are registered to the first. Only the turn is judged: a scene such as a corridor
    leaves a shift undetermined.

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
            "frames while it was still",
            {"lidar": name, "turned_rad": turn, "allowed_rad": float(MAX_TURN)},
        )


@kept
def turned_by(cloud: PointCloud) -> float:
    """How far a LiDAR turned from the first frames to the last, rad; 0 if that is not known.

    A turn of more than `MAX_TURN` is known where it is also more than `MOVED_SIGMAS` of its noise.
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
        if turn > MAX_TURN and turn < MOVED_SIGMAS * _turn_sigma(first, last, cloud.origin, moved):
            return 0.0
        if turn > MAX_TURN and cloud.ring is None and not _adds_up(moved, cloud, frames, part):
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


def _adds_up(moved: Registration, cloud: PointCloud, frames: IntArray, part: int) -> bool:
    """Whether the turns from each run of frames to the next add up to that from first to last.

    They do where the LiDAR turned. Sweeps of a LiDAR that does not repeat its pattern show other
    points of rough and far surfaces each time: on open ground a registration is drawn to where the
    points of one lie among those of the other, by as much in every step as from first to last.
    """
    assert cloud.frame is not None
    runs = np.array_split(frames, max(len(frames) // part, 1))
    made = [prepare(cloud.xyz[np.isin(cloud.frame, run)], SCORING_VOXEL) for run in runs]
    steps = np.array(
        [
            se3.log_so3(_registered(before, after, np.eye(4)).T_target_source[:3, :3])
            for before, after in pairwise(made)
        ]
    )
    turn = se3.log_so3(moved.T_target_source[:3, :3])
    size = float(np.linalg.norm(turn))
    off = float(np.linalg.norm(steps.sum(axis=0) - turn))
    return max(off, float(se3.lengths(steps).max()) - size) <= MISMATCH * size


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
        `MIN_POLE_POINTS`.
    """
    offset = pole.xyz - pole.point
    across = offset - (offset @ pole.direction)[:, None] * pole.direction
    runs = np.array_split(np.unique(frame), min(RUNS, len(np.unique(frame))))
    means: list[Array] = []
    sizes: list[int] = []
    for run in runs:
        own = np.isin(frame, run)
        if np.count_nonzero(own) >= MIN_POLE_POINTS:
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
        if distance > DEFAULT_RADIUS and distance > MOVED_SIGMAS * sigma:
            raise Refusal(
                "moving_pole",
                f"pole {name[0].upper()}{k} of the {name} strays by {100 * distance:.1f} cm "
                f"between frames, "
                f"{distance / sigma:.0f} times its noise: hold the poles still, or record again",
                {"lidar": name, "pole": k, "drift_m": distance, "sigma_m": sigma},
            )
