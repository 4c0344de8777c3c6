"""No pole: what stands off the ground, seen from above, gives the pose.

The ground that both LiDARs see leaves a rotation about its normal and a shift along it. What stands
off it in each cloud is sorted into cells by place and height, and all rotations and shifts are
compared at once: the cross-correlation over the ground, summed over the heights (by FFT, as in
`one_pole`). The best few settle on the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..base import se3
from ..base.datatypes import Array, Match, Placement
from ..surfaces.averaging import averaged
from ..surfaces.consistency import Standing, is_ground_on_ground
from ..surfaces.disambiguation import SCORING_VOXEL
from ..surfaces.registration import prepare, voxel_downsample
from ..surfaces.visibility import tree_of
from .candidate_confirmation import FACING_SIDES
from .distinct import same_pose
from .icp_refinement import registered
from .one_pole import LOW, MOST_SETTLED, NOTHING_SAID, SETTLES, frame_about, match_under, spread

CELL, TURNS = 0.5, 240
"""Side of a cell, metres, and rotations that are tried: 1.5° apart, 0.8 m at `REACH`."""

CELLS, REACH = 256, 32.0
"""Cells along a side, and how far from its LiDAR a point counts, metres. LiDARs up to
``CELLS * CELL - 2 * REACH`` apart see no point beside one that lies there only since FFTs wrap."""

HEIGHTS = np.array([0.3, 1.0, 1.75, 2.5, 3.5, 5.0, 8.0])
"""Limits of the layers, metres above the ground: thin where cars, fences and people are."""

PER_TURN = 3
"""Shifts that are looked at for each rotation, where most cells coincide."""

POSES_APART = np.radians(8.0), 1.2
"""Peaks nearer to each other than this are one, rad and m."""


@dataclass(frozen=True, eq=False)
class GroundPeak:
    """A pose (4, 4), and how much of the place coincides."""

    T: Array
    height: float


def matches_from_above(
    placement: Placement,
    grounds: tuple[Sequence[Standing], Sequence[Standing]],
    radius: float | None = None,
) -> list[Match]:
    """Find the poses that lay the ground on the ground and the place on the place.

    Parameters
    ----------
    placement
        With both clouds.
    grounds
        What stands off each plane that may be the ground, in either cloud.
    radius
        Of the poles, metres, of which one at least must lie on one, too; None asks for none.

    Returns
    -------
    list of Match
        In the order of how much of the place coincides: where the scenes and the poles lie on each
        other, `exact`; without any pair, and not `exact`, where they do not.
    """
    target, source = (averaged(scan.cloud) for scan in placement.scans)
    poles = placement.target.poles, placement.source.poles
    surface = prepare(target.xyz, SCORING_VOXEL)
    tree, points = tree_of(surface.xyz), voxel_downsample(source.xyz, SCORING_VOXEL)
    found: list[tuple[float, Match]] = []
    for standing in product(*grounds):
        peaks = _ground_peaks(*standing)
        for peak in peaks:
            is_low = peak.height < LOW * peaks[0].height
            T = None if is_low else registered(surface, tree, points, peak.T, near=SETTLES)
            match = _laid(peak.T)
            if T is not None and is_ground_on_ground(*standing, T):
                # Where no pole lies on one it is compared with as it settled, at its best.
                match = replace(_laid(T), exact=radius is None, icp_refined=True)
                on_poles = None if radius is None else match_under(*poles, T, FACING_SIDES * radius)
                match = on_poles if on_poles is not None and on_poles.exact else match
            if not any(same_pose(match, other, np.zeros((1, 3))) for _, other in found):
                found.append((peak.height, match))
    found.sort(key=lambda each: (not each[1].exact, -each[0]))
    return [match for _, match in found]


def _laid(T: Array) -> Match:
    """State a pose (4, 4) as a match of no poles, which need not be `exact`."""
    return Match((), T, 0.0, False, True, NOTHING_SAID, by_place=True)


def _ground_peaks(target: Standing, source: Standing) -> list[GroundPeak]:
    """Find the rotations and shifts at which most cells coincide, the best first."""
    levels = _level(target), _level(source)
    above = [se3.apply(L, each.points) for L, each in zip(levels, (target, source), strict=True)]
    over = spread(fft.rfft2(_cells(above[0])), (CELLS, CELLS))
    found = []
    for turn in 2 * np.pi * np.arange(TURNS) / TURNS:
        R = se3.exp_so3(np.array([0.0, 0.0, turn]))
        cells = np.conj(fft.rfft2(_cells(above[1] @ R.T)))
        total = fft.irfft2(np.einsum("hij,hij->ij", over, cells), s=(CELLS, CELLS))
        for k in np.argpartition(total, -PER_TURN, axis=None)[-PER_TURN:]:
            # Shifts of more than half of the cells are those the other way.
            shift = (np.array(np.unravel_index(k, total.shape)) + CELLS // 2) % CELLS - CELLS // 2
            T = se3.from_rt(R, np.r_[CELL * shift, 0.0])
            found.append(GroundPeak(se3.inverse(levels[0]) @ T @ levels[1], float(total.flat[k])))
    found.sort(key=lambda peak: -peak.height)
    return list(_apart(found))


def _apart(peaks: Sequence[GroundPeak]) -> Iterator[GroundPeak]:
    """Leave out what is lower and near another."""
    kept: list[GroundPeak] = []
    for peak in peaks:
        gaps = [se3.difference(peak.T, other.T) for other in kept]
        if any(gap.rotation < POSES_APART[0] and gap.translation < POSES_APART[1] for gap in gaps):
            continue
        kept.append(peak)
        yield peak
        if len(kept) == MOST_SETTLED:
            return


def _level(standing: Standing) -> Array:
    """(4, 4) to a frame on the ground below the LiDAR, z up, from the LiDAR's."""
    origin = standing.image.origin
    height = float((origin - standing.ground) @ standing.up)
    z = standing.up if height > 0 else -standing.up
    return frame_about(origin - abs(height) * z, z)


def _cells(points: Array) -> NDArray[np.float32]:
    """Sort points (N, 3) above the ground into cells (H, `CELLS`, `CELLS`), about (0, 0)."""
    layer = np.searchsorted(HEIGHTS, points[:, 2]) - 1
    kept = (np.hypot(points[:, 0], points[:, 1]) < REACH) & (layer >= 0)
    kept &= layer < len(HEIGHTS) - 1
    x, y = np.round(points[kept, :2].T / CELL).astype(np.intp)
    cells = np.zeros((len(HEIGHTS) - 1, CELLS, CELLS), dtype=np.float32)
    cells[layer[kept], x, y] = 1.0
    return cells
