"""LiDARs on one mast: they sway together, and the transform between them does not move.

A short recording does not determine well where a mast rests, and two LiDARs need not agree on it.
LiDARs that sway as one need not know it: at every moment ``ξ_i = A_i ξ``, ξ the motion of the first
of them and A_i the adjoint of the pose between them, so that one motion explains the returns of
all. The evidence shows whether it does: that of one motion over that of one for each. Both are as
probable beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.special import expit

from ..alignment.adjustment import BeamAlignment
from ..alignment.origins import moved
from ..base import se3
from ..base.datatypes import Array, Placement, Scan
from ..hypotheses.placements import PairedPlacement, align
from ..hypotheses.scans import SiteScans
from ..surfaces.sway import (
    COUNTED,
    SIZES,
    Likelihood,
    angle_of,
    ask,
    axes_along,
    drawn,
    hypotheses,
    infer,
    judged,
    main_angles,
    ways_of,
)
from ..surfaces.sweeps import observe, timed, without


@dataclass(frozen=True, eq=False)
class CommonMotion:
    """One motion of all LiDARs.

    Attributes
    ----------
    odds
        Logarithm of how much more probable it is than a motion of each.
    from_rest
        For each, (6,) turn and shift between where it rests by the motion estimated for it alone
        and by this one.
    """

    odds: float
    from_rest: tuple[Array, ...]


def align_on_one_mast(
    paired: Sequence[PairedPlacement],
    aligned: BeamAlignment,
    *,
    radius: float,
    radius_sigma: float,
) -> tuple[Sequence[PairedPlacement], BeamAlignment]:
    """Bring LiDARs that sway as one to rest as one, and align their poles again.

    Parameters
    ----------
    paired, aligned
        The poles of all placements, paired; and aligned. Returned as they are where no placement
        shows that they do.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    """
    T = aligned.pose.T_target_source
    alone = [each.placement for each in paired]
    placements = on_one_mast(alone, T)
    if placements is alone:
        return paired, aligned
    paired = [replace(each, placement=own) for each, own in zip(paired, placements, strict=True)]
    return paired, align(paired, T, radius=radius, radius_sigma=radius_sigma)


def on_one_mast(placements: Sequence[Placement], T: Array) -> Sequence[Placement]:
    """Bring two LiDARs that sway as one to rest as one, in all placements.

    Parameters
    ----------
    placements
        Returned as they are where none shows that they do.
    T
        (4, 4) the pose, T_target_source, to a few degrees.
    """
    rows = [each.scans for each in placements]
    shared = as_one(rows, (np.eye(4), T))
    if shared is rows:
        return placements
    return [
        replace(each, target=target, source=source)
        for each, (target, source) in zip(placements, shared, strict=True)
        if target is not None and source is not None
    ]


Row = Sequence[Scan | None]
"""What the LiDARs recorded of one placement; None if nothing, or nothing that can be used."""


def as_one(rows: Sequence[Row], poses: Sequence[Array]) -> Sequence[Row]:
    """Bring LiDARs that sway as one to rest as one.

    Parameters
    ----------
    rows
        One for each placement, with the scan of each LiDAR.
    poses
        (4, 4) of each LiDAR, into a frame that all share.

    Returns
    -------
    sequence
        The same if no placement shows that they sway as one, or if all are at that rest already.
    """
    moving = [[scan for scan in row if scan is not None and _is_swaying(scan)] for row in rows]
    found = [common_motion(row, poses) if len(row) == len(poses) else None for row in moving]
    odds = sum(each.odds for each in found if each is not None)
    if odds <= 0:
        return rows
    separate = float(expit(-odds))
    return [
        row if each is None else list(map(_moved, own, each.from_rest, [separate] * len(own)))
        for row, own, each in zip(rows, moving, found, strict=True)
    ]


def _is_swaying(scan: Scan) -> bool:
    """Whether a scan sways, and was not brought to the rest of others yet."""
    return scan.motion is not None and scan.sway is not None and not scan.sway.is_shared


def common_motion(scans: Sequence[Scan], poses: Sequence[Array]) -> CommonMotion:
    """Ask whether one motion explains the returns of all LiDARs, recorded at the same time.

    Parameters
    ----------
    scans, poses
        Of one placement, each with its `motion`; as of `as_one`.
    """
    motions = [scan.motion for scan in scans if scan.motion is not None]
    times, observed = [], []
    for scan, motion, begin in zip(scans, motions, _begins(scans), strict=True):
        cloud, when = scan.cloud, timed(scan.cloud)
        xyz = without(cloud.xyz[when.index], cloud.origin, -motion, when.part)
        observed.append(observe(xyz, cloud.origin, when, motion))
        times.append(when.times + begin)
    cuts = np.cumsum([len(each) for each in times])[:-1]
    A = [_adjoint(scans[0], scan, poses[0], T) for scan, T in zip(scans, poses, strict=True)]
    tried = list(hypotheses(np.concatenate(times)))
    separate, common = 0.0, []
    for k, (one, motion) in enumerate(zip(observed, motions, strict=True)):
        own = [(f, share, np.split(features, cuts)[k]) for f, share, features in tried]
        likelihoods = list(ask(one, own))
        alone, noise = judged(one, likelihoods, SIZES, motion)
        separate += alone.total
        common.append([_by_common(each, A[k], noise) for each in likelihoods])
    summed = [
        [sum(parts) for parts in zip(*each, strict=True)] for each in zip(*common, strict=True)
    ]
    both = [Likelihood(*each, *every) for each, every in zip(tried, summed, strict=True)]
    ways = ways_of(motions[0])
    found = infer(both, axes_along(both, ways), SIZES, ways)
    shared = [own @ A[k].T for k, own in enumerate(np.split(found.motion, cuts))]
    return CommonMotion(
        COUNTED * (found.total - separate),
        tuple((own - one).mean(axis=0) for own, one in zip(motions, shared, strict=True)),
    )


def _by_common(own: Likelihood, A: Array, noise: float) -> tuple[Array, Array]:
    """Information of the returns of one LiDAR about the coefficients of the common motion."""
    of_own = np.kron(np.eye(own.features.shape[1]), A)
    return of_own.T @ own.left @ of_own / noise, of_own.T @ own.pull / noise


def _begins(scans: Sequence[Scan]) -> Array:
    """(L,) when each recording began, s: by the recorder's clock where it has the times of all."""
    recorded = [scan.cloud.recorded for scan in scans]
    first = np.array([np.nan if each is None else each[0] for each in recorded])
    last = np.array([np.nan if each is None else each[1] for each in recorded])
    # There is no other evidence; recordings that were made at other times do not sway as one.
    return first - first[0] if np.max(first) <= np.min(last) else np.zeros(len(scans))


def _adjoint(first: Scan, own: Scan, T_first: Array, T_own: Array) -> Array:
    """(6, 6) motion of a LiDAR by that of the first of one rigid mast, each about its origin."""
    T = se3.inverse(T_own) @ T_first
    arm = own.cloud.origin - se3.apply(T, first.cloud.origin[None])[0]
    A = np.kron(np.eye(2), T[:3, :3])
    A[3:, :3] = -se3.hat(arm) @ T[:3, :3]
    return np.asarray(A)


def _moved(scan: Scan, from_rest: Array, apart: float) -> Scan:
    """Bring a scan to the common rest; `apart` is how probable it is that there is none."""
    assert scan.sway is not None
    assert scan.motion is not None
    origin = scan.cloud.origin

    def turned(directions: Array) -> Array:
        changed = directions - np.cross(from_rest[:3], directions)
        return np.asarray(changed / se3.lengths(changed)[:, None])

    def rested(xyz: Array) -> Array:
        return without(xyz, origin, -from_rest[None], np.zeros(len(xyz), dtype=np.int64))

    at_rest = moved(scan, rested, turned)
    motion = scan.motion - from_rest
    sway = msgspec.structs.replace(
        scan.sway,
        angle_rad=angle_of(motion),
        covariance=apart * (np.asarray(scan.sway.covariance) + np.outer(from_rest, from_rest)),
        angles_rad=drawn(main_angles(motion)),
        is_shared=True,
    )
    # Beams start where the LiDAR rests, wherever that is.
    cloud = replace(at_rest.cloud, origin=origin)
    return replace(at_rest, cloud=cloud, sway=sway, motion=motion)


def with_masts(scans: SiteScans, poses: Mapping[int, Array]) -> SiteScans:
    """Bring LiDARs that sway as one to rest as one.

    Parameters
    ----------
    scans
        Of all LiDARs.
    poses
        (4, 4) of those that are linked, to a few degrees.
    """
    by_lidar = list(scans.by_lidar)

    def shared_by(*lidars: int) -> Sequence[Row] | None:
        """Rows of some LiDARs, brought to one rest; None if they do not sway as one."""
        rows = list(zip(*(by_lidar[k] for k in lidars), strict=True))
        shared = as_one(rows, [poses[k] for k in lidars])
        return None if shared is rows else shared

    left = [
        k
        for k in poses
        if any(scan is not None and scan.motion is not None for scan in by_lidar[k])
    ]
    while left:
        first, *others = left
        pairs = {k: rows for k in others if (rows := shared_by(first, k)) is not None}
        rows = shared_by(first, *pairs) if len(pairs) > 1 else next(iter(pairs.values()), None)
        if rows is not None:
            for k, row in zip((first, *pairs), zip(*rows, strict=True), strict=True):
                by_lidar[k] = row
        left = [k for k in others if k not in pairs]
    return replace(scans, by_lidar=tuple(by_lidar))
