"""One pole that both LiDARs see: the surroundings give the angle about it and the shift along it.

A line aligned with a line leaves a rotation about it, a slide along it, and which end is up. The
objects above the ground in each cloud are sorted into cells about the pole, by distance, angle and
height, and all rotations and slides are compared at once: the cross-correlation over angle and
height, summed over the distances (by FFT). The best few converge on the scene.

Without any pole, the objects above the ground, seen from above, give the pose. The ground that both
LiDARs see leaves a rotation about its normal and a shift along it. The objects above it in each
cloud are sorted into cells by place and height, and all rotations and shifts are compared at once:
the cross-correlation over the ground, summed over the heights. The best few converge on the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..base import se3
from ..base.datatypes import Array, Match, Placement, PointCloud, Pole, Scan, kept
from ..base.uncertainty import SIGMAS
from ..extraction.acceptance_shape import MAX_LENGTH
from ..surfaces.averaging import averaged
from ..surfaces.consistency import (
    HALF_SIDE,
    SceneObjects,
    is_ground_on_ground,
)
from ..surfaces.registration import voxel_downsample
from ..surfaces.visibility import SCORING_VOXEL
from .candidate_confirmation import FACING_SIDES
from .correspondence import EXTENSION_RMS, extended, same_pose
from .icp_refinement import prepared, registered
from .prior import PosePrior

CELL = 0.5
"""Side of a cell, metres. Points up to `HALF_SIDE` from a pole, or from their LiDAR, are used."""

ANGLES = 360
"""Cells about the pole: 0.5 m wide at 30 m."""

RINGS = int(HALF_SIDE / CELL)
"""Cells away from the pole, and along it, of which `SLIDE` at either end stay empty."""

SLIDE = int(MAX_LENGTH / CELL)
"""Slides that are tried, in cells. The distance between the middles of what two LiDARs see of one
pole is at most its length."""

DISTINCT_POSES = np.radians(8.0), 1.2
"""Peaks nearer to each other than this are one, rad and m."""

MOST_POLES, MOST_SETTLED = 4, 6
"""Number of poles of each LiDAR that are aligned with the other's, the best supported first; and
number of the peaks with either end up, the highest first, that are used. Of 121 poles
(benchmarks/hard_scenes.py, seeds 0 to 59) the right pose is the highest with its end up for 120,
and of 67 in view of LiDARs on masts of 4 to 8 m (benchmarks/masts.py, seed 5) for 63; with the
ground among the points for 61, since the ground coincides at many angles. With three peaks, the
counterpart of the right pose on a quay that is symmetric under a half turn was missed."""

LOW = 0.6
"""A peak below this part of the highest with the same end up is not refined, but used for
comparison only. Each refinement takes three registrations."""

SETTLES = se3.PoseDifference(float(np.radians(5.0)), 1.0)
"""Scenes that coincide converge within this about the pole, rad and m. The poses of 17
recordings with one pole only that gave a result (benchmarks/deception.py, "one pole, nothing
wrong",
seeds 100 to 131) moved by at most 1.3° and 0.26 m, most of the others by 10° or 2 m and more."""

LAID_RMS = 0.1
"""Largest residual of the poles if the scenes coincide, metres, in addition to the distance
between the sides of a pole: registrations of sparse clouds are off by this amount. The more
precise information of the poles is used later."""

NO_INFORMATION = np.zeros((6, 6))
"""Information that such a match gives about its pose."""


@dataclass(frozen=True, eq=False)
class Peak:
    """A pose (4, 4) about a pair of poles, which end is up, and the amount of the surroundings that
    coincides."""

    pair: tuple[int, int]
    is_flipped: bool
    T: Array
    height: float


def matches_about(
    placement: Placement, standing: tuple[SceneObjects, SceneObjects], radius: float
) -> list[Match]:
    """Find the poses under which one pole and the surroundings coincide.

    Parameters
    ----------
    placement
        With the poles of both LiDARs, the best supported first.
    standing
        Objects above the ground there, in either cloud.
    radius
        Of the poles, metres: the lines that two LiDARs see of one differ by up to π r/2.

    Returns
    -------
    list of Match
        Sorted by the amount of the surroundings that coincides: if the scenes coincide and the
        poles still do, `exact`; as the poles were matched, and not `exact`, if they no longer do.
    """
    target, source = placement.scans
    every = sorted(_peaks(target, source, standing), key=lambda peak: -peak.height)
    ways = [[peak for peak in every if peak.is_flipped is flipped] for flipped in (False, True)]
    peaks = sorted((p for way in ways for p in way[:MOST_SETTLED]), key=lambda peak: -peak.height)
    if not peaks:
        return []
    least = {way[0].is_flipped: LOW * way[0].height for way in ways if way}
    settled = _settling(placement)
    at = np.array([pole.point for pole in source.poles])
    apart = FACING_SIDES * radius
    found: list[Match] = []
    for peak in peaks:
        is_low = peak.height < least[peak.is_flipped]
        pole = at[peak.pair[1]]
        T = None if is_low else settled(peak.T, pole)
        match = None if T is None else match_under(target.poles, source.poles, T, apart)
        if match is None or peak.pair not in match.pairs or not match.exact:
            match = Match((peak.pair,), peak.T, 0.0, False, True, NO_INFORMATION, by_place=True)
        if not any(same_pose(match, other, at) for other in found):
            found.append(match)
    return found


@kept
def _ends(_: PointCloud) -> WeakKeyDictionary[PointCloud, dict[bytes, Array | None]]:
    """Where registrations of each source with a target ended, by where they started."""
    return WeakKeyDictionary()


def _settling(placement: Placement) -> Callable[[Array, Array], Array | None]:
    """Return a function that registers the scenes from a pose (4, 4), within `SETTLES` of a point
    (3,).

    Searches with other poles start at much the same poses, and each registers once.
    """
    target, source = (scan.cloud for scan in placement.scans)
    surface, tree = prepared(averaged(target))
    points = voxel_downsample(averaged(source).xyz, SCORING_VOXEL)
    ends = _ends(target).setdefault(source, {})

    def settled(T: Array, at: Array) -> Array | None:
        start = T.tobytes() + at.tobytes()
        if start not in ends:
            ends[start] = registered(surface, tree, points, T, near=SETTLES, at=at)
        return ends[start]

    return settled


def match_under(
    target: Sequence[Pole], source: Sequence[Pole], T: Array, apart: float
) -> Match | None:
    """Express a pose as a match of every pole that coincides with one under it; None without any.

    Parameters
    ----------
    target, source, T
        Poles of both LiDARs, and (4, 4) the pose.
    apart
        Largest distance of the lines of one pole, metres, before any error.
    """
    pairs = extended(target, source, T, EXTENSION_RMS + apart)
    if not pairs:
        return None
    squares = np.concatenate([_off_line(target[i], source[j], T) for i, j in pairs]) ** 2
    rms = float(np.sqrt(squares.mean()))
    return Match(
        pairs,
        T,
        rms,
        rms <= LAID_RMS + apart,
        True,
        NO_INFORMATION,
        icp_refined=True,
        by_place=True,
    )


def _off_line(target: Pole, source: Pole, T: Array) -> Array:
    """(N,) distances of the returns on a pole of the source from the target's line, metres."""
    away = se3.apply(T, source.xyz) - target.point
    return se3.lengths(np.cross(away, target.direction))


def _peaks(
    target: Scan, source: Scan, standing: tuple[SceneObjects, SceneObjects]
) -> Iterator[Peak]:
    frames, spectra = [], []
    for scan, seen in zip((target, source), standing, strict=True):
        frames.append([frame_about(p.point, p.direction) for p in scan.poles[:MOST_POLES]])
        spectra.append([_spectrum(se3.apply(frame, seen.points)) for frame in frames[-1]])
    for i, near in enumerate(spread(each, (ANGLES, RINGS)) for each in spectra[0]):
        for j, is_flipped in product(range(len(spectra[1])), (False, True)):
            # Upside down, angle and height run in the opposite direction.
            other = spectra[1][j] if is_flipped else np.conj(spectra[1][j])
            total = fft.irfft2(np.einsum("rak,rak->ak", near, other), s=(ANGLES, RINGS))
            for turn, slide, height in _highest(total[:, np.r_[-SLIDE : SLIDE + 1]]):
                T = se3.inverse(frames[0][i]) @ _screw(turn, slide, is_flipped) @ frames[1][j]
                yield Peak((i, j), is_flipped, T, height)


def frame_about(point: Array, z: Array) -> Array:
    """(4, 4) to a frame at a point (3,) with the given z axis (3,), from that of the LiDAR."""
    x = np.linalg.svd(z[None])[2][1]
    R = np.stack([x, np.cross(z, x), z])
    return se3.from_rt(R, -R @ point)


def _screw(turn: float, slide: float, is_flipped: bool) -> Array:
    """(4, 4) turn about the pole, rad, and slide along it, metres, of what may be upside down."""
    T = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, turn])), np.array([0.0, 0.0, slide]))
    return T @ np.diag([1.0, -1.0, -1.0, 1.0]) if is_flipped else T


def _spectrum(points: Array) -> NDArray[np.complex64]:
    """Sort points (N, 3) about a pole into cells, and transform them over angle and height."""
    away = np.hypot(points[:, 0], points[:, 1])
    ring = (away / CELL).astype(np.intp)
    angle = np.round(np.arctan2(points[:, 1], points[:, 0]) * (ANGLES / (2 * np.pi)))
    layer = np.round(points[:, 2] / CELL).astype(np.intp)
    kept = (ring > 0) & (ring < RINGS) & (np.abs(layer) < RINGS // 2 - SLIDE)
    grid = np.zeros((RINGS, ANGLES, RINGS), dtype=np.float32)
    grid[ring[kept], angle[kept].astype(np.intp) % ANGLES, layer[kept] % RINGS] = 1.0
    # Near the pole cells are narrow, and one object fills many.
    width = (np.arange(RINGS) + 0.5) * CELL * (2 * np.pi / ANGLES)
    grid *= np.sqrt(np.minimum(width / SCORING_VOXEL, 1.0, dtype=np.float32))[:, None, None]
    return np.asarray(fft.rfft2(grid))


def spread(spectrum: NDArray[np.complex64], sizes: tuple[int, int]) -> NDArray[np.complex64]:
    """Add half of every cell to its neighbours: surfaces are sampled at other points.

    Parameters
    ----------
    spectrum
        (L, A, B) of layers of cells, each transformed by a real FFT.
    sizes
        Of a layer, in cells.
    """
    over = [
        1 + np.cos(2 * np.pi * np.arange(n) / size)
        for n, size in zip(spectrum.shape[1:], sizes, strict=True)
    ]
    wider = spectrum * np.outer(*over).astype(np.float32)
    wider[1:] += wider[:-1] / 2
    return wider


def _highest(total: NDArray[np.float32]) -> Iterator[tuple[float, float, float]]:
    """The turns, rad, and slides, metres, at which most cells coincide, and the number that
    does."""
    for _ in range(MOST_SETTLED):
        k, m = np.unravel_index(int(np.argmax(total)), total.shape)
        height = float(total[k, m])
        if height <= 0:
            return
        yield 2 * np.pi * float(k) / ANGLES, CELL * float(m - SLIDE), height
        about, along = int(DISTINCT_POSES[0] / (2 * np.pi) * ANGLES), int(DISTINCT_POSES[1] / CELL)
        turns = np.arange(k - about, k + about + 1) % ANGLES
        total[turns, max(m - along, 0) : m + along + 1] = 0.0


TURNS = 240
"""Rotations that are tried: in steps of 1.5°, 0.8 m at `HALF_SIDE`."""

CELLS = RINGS * 4
"""Cells along a side. LiDARs at up to ``CELLS * CELL - 2 * HALF_SIDE`` have no points that are
near each other only because FFTs wrap."""

HEIGHTS = np.array([0.3, 1.0, 1.75, 2.5, 3.5, 5.0, 8.0])
"""Limits of the layers, metres above the ground: thin where cars, fences and people are."""

PER_TURN = 3
"""Number of shifts that are used for each rotation, those at which most cells coincide."""


@dataclass(frozen=True, eq=False)
class GroundPeak:
    """A pose (4, 4), and the amount of the surroundings that coincides."""

    T: Array
    height: float


def matches_from_above(
    placement: Placement,
    grounds: tuple[Sequence[SceneObjects], Sequence[SceneObjects]],
    radius: float | None = None,
    prior: PosePrior | None = None,
) -> list[Match]:
    """Find the poses under which the grounds and the surroundings coincide.

    Parameters
    ----------
    placement
        With both clouds.
    grounds
        Objects above each plane that may be the ground, in either cloud.
    radius
        Of the poles, metres, of which at least one pair must coincide, too; None requires none.
    prior
        Only poses that it allows are searched for.

    Returns
    -------
    list of Match
        Sorted by the amount of the surroundings that coincides: if the scenes and the poles
        coincide, `exact`; without any pair, and not `exact`, if they do not.
    """
    poles = placement.target.poles, placement.source.poles
    settled, origin = _settling(placement), np.zeros(3)
    found: list[tuple[float, Match]] = []
    for standing in product(*grounds):
        peaks = _ground_peaks(*standing, prior or PosePrior())
        for peak in peaks:
            is_low = peak.height < LOW * peaks[0].height
            T = None if is_low else settled(peak.T, origin)
            match = _laid(peak.T)
            if T is not None and is_ground_on_ground(*standing, T):
                # If no poles coincide, the pose is used for comparison as it converged.
                match = replace(_laid(T), exact=radius is None, icp_refined=True)
                on_poles = None if radius is None else match_under(*poles, T, FACING_SIDES * radius)
                match = on_poles if on_poles is not None and on_poles.exact else match
            if not any(same_pose(match, other, np.zeros((1, 3))) for _, other in found):
                found.append((peak.height, match))
    found.sort(key=lambda each: (not each[1].exact, -each[0]))
    return [match for _, match in found]


def _laid(T: Array) -> Match:
    """Express a pose (4, 4) as a match of no poles, which need not be `exact`."""
    return Match((), T, 0.0, False, True, NO_INFORMATION, by_place=True)


def _ground_peaks(target: SceneObjects, source: SceneObjects, prior: PosePrior) -> list[GroundPeak]:
    """Find the rotations and shifts at which most cells coincide, the best first."""
    levels = _level(target), _level(source)
    above = [se3.apply(L, each.points) for L, each in zip(levels, (target, source), strict=True)]
    quarters = [_about_z(k * np.pi / 2) for k in range(4)]
    # A quarter turn maps cells onto cells: the target is turned back instead of turning the source.
    half = [
        spread(fft.rfft2(_cells(above[0] @ quarter[:3, :3])), (CELLS, CELLS))
        for quarter in quarters[:2]
    ]
    over = [*half, *np.conj(half)]
    # Shifts of more than half of the cells are those in the opposite direction.
    shifts = CELL * ((np.arange(CELLS) + CELLS // 2) % CELLS - CELLS // 2)
    reach = SIGMAS * prior.distance_sigma + DISTINCT_POSES[1]
    near = np.flatnonzero(np.hypot(shifts[:, None], shifts) <= reach)
    turned = PosePrior(prior.rotation, prior.sigma + DISTINCT_POSES[0] / SIGMAS)
    found = []
    for turn in 2 * np.pi * np.arange(TURNS // 4) / TURNS:
        R = _about_z(turn)
        cells = np.conj(fft.rfft2(_cells(above[1] @ R[:3, :3].T)))
        for quarter, other in zip(quarters, over, strict=True):
            total = fft.irfft2((other * cells).sum(axis=0), s=(CELLS, CELLS))
            heights = total.reshape(-1)[near]
            for k in np.argpartition(heights, -PER_TURN)[-PER_TURN:]:
                i, j = np.unravel_index(near[k], total.shape)
                step = se3.from_rt(np.eye(3), np.r_[shifts[i], shifts[j], 0.0])
                T = se3.inverse(levels[0]) @ quarter @ step @ R @ levels[1]
                if turned.allows(T):
                    found.append(GroundPeak(T, float(heights[k])))
    found.sort(key=lambda peak: -peak.height)
    return list(_separate_peaks(found))


def _about_z(turn: float) -> Array:
    return se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, turn])), np.zeros(3))


def _separate_peaks(peaks: Sequence[GroundPeak]) -> Iterator[GroundPeak]:
    """Leave out peaks that are lower and near another."""
    kept: list[GroundPeak] = []
    for peak in peaks:
        gaps = [se3.difference(peak.T, other.T) for other in kept]
        if any(
            gap.rotation < DISTINCT_POSES[0] and gap.translation < DISTINCT_POSES[1] for gap in gaps
        ):
            continue
        kept.append(peak)
        yield peak
        if len(kept) == MOST_SETTLED:
            return


def _level(standing: SceneObjects) -> Array:
    """(4, 4) to a frame on the ground below the LiDAR, z up, from the LiDAR's."""
    origin = standing.image.origin
    height = float((origin - standing.ground) @ standing.up)
    z = standing.up if height > 0 else -standing.up
    return frame_about(origin - abs(height) * z, z)


def _cells(points: Array) -> NDArray[np.float32]:
    """Sort points (N, 3) above the ground into cells (H, `CELLS`, `CELLS`), about (0, 0)."""
    layer = np.searchsorted(HEIGHTS, points[:, 2]) - 1
    kept = (np.hypot(points[:, 0], points[:, 1]) < HALF_SIDE) & (layer >= 0)
    kept &= layer < len(HEIGHTS) - 1
    x, y = np.round(points[kept, :2].T / CELL).astype(np.intp)
    cells = np.zeros((len(HEIGHTS) - 1, CELLS, CELLS), dtype=np.float32)
    cells[layer[kept], x, y] = 1.0
    return cells
