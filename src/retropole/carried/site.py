"""The answer of a walk as that of a site: poses and clocks of all LiDARs, in one frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from ..adjustment.agreement import MAX_MAHALANOBIS_SQ
from ..adjustment.answer import LidarPose, SiteCalibration
from ..adjustment.datum import of_lidar
from ..adjustment.descent import RefinementProblem, minimise, scene_pairs
from ..adjustment.site import Recorded
from ..adjustment.solved import parts_of
from ..alignment.certainty import (
    POLES,
    SIGNIFICANCE,
    Part,
    chi2_limit,
    floors,
    joint_covariance,
    part_of,
    root_of,
)
from ..alignment.network import gaussian_factor_of
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.carried import LidarWalk, SiteWalk
from ..base.datatypes import Array, IntArray, Placement
from ..base.description import Site
from ..base.errors import Reason, Refusal, refusing_of, warnings_and_notes
from ..base.quantities import error
from ..base.systematic import ErrorModel
from ..base.uncertainty.purpose import CONFIDENCE
from ..hypotheses.evidence import check_confirmation, count, is_in_conflict
from ..hypotheses.scans import SiteScans, patches_of, poses_in_clouds
from ..verdict import check_sensor, check_sway
from ..verdict.site import not_fit
from ..verdict.statement import lidar_poses
from .adjustment import Adjusted, in_recordings
from .statement import axes_in_target, figures_of, scene_beside
from .verdict import chosen
from .walk import Solved


def from_reference(site: Site) -> list[int]:
    """Indices of the LiDARs, that of the reference first: the order of a walk's solution."""
    others = (k for k in range(len(site.lidars)) if k != site.reference)
    return [site.reference, *others]


def state_walk_of_site(
    site: Site,
    scans: SiteScans,
    solved: Solved,
    seconds: Mapping[str, float],
    *,
    scene: bool = True,
) -> SiteCalibration:
    """State the answer of a walk: poses in the frames of the clouds, and clocks.

    Parameters
    ----------
    site, scans
        What was recorded, without what moved, about the beam origins.
    solved
        What fits the tracks, in the order of `from_reference`.
    seconds
        Time of each step.
    scene
        Whether the surfaces around may refine it.

    Raises
    ------
    Refusal
        As `verdict.chosen`, and where the surroundings conflict with the answer.
    """
    order, names = from_reference(site), [lidar.name for lidar in site.lidars]
    best = chosen(solved.solutions, [names[k] for k in order])
    frames = [track.T_recording_beams for track in solved.tracks]
    origins = scans.origins[order]
    about = [se3.from_rt(np.eye(3), -origin) for origin in origins]
    # Where beams start, as of the surfaces; but for the reference, whose frame is the site's.
    about[0] = np.eye(4)
    adjusted = in_recordings(best, *(own @ T for own, T in zip(about, frames, strict=True)))
    T, parts = _of_site(adjusted, origins[0], np.argsort(order))
    found: list[Reason] = []
    if scene:
        T, parts, found = _refined(site, scans, T, parts)
    _check_conflicts(names, scans, T, axes_in_target(adjusted)[0])
    # Roots of matrices leave the reference 1e-12: it is the frame.
    free = np.repeat(np.arange(len(T)) != site.reference, POSE)
    parts = [replace(part, root=part.root * free[:, None]) for part in parts]
    poses, covariance = poses_in_clouds(T, joint_covariance(parts), scans.origins)
    lidars = lidar_poses(site, parts, poses, covariance)
    reasons, notes = warnings_and_notes([*found, *_weaknesses(site, scans, lidars)])
    return SiteCalibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        site=site,
        scans=scans.in_clouds,
        seconds=seconds,
        datum=of_lidar(names[site.reference]),
        lidars=lidars,
        covariance=covariance,
        groups=(tuple(range(len(names))),),
        notes=notes,
        walk=_walk(adjusted, solved, order),
    )


def _of_site(adjusted: Adjusted, origin: Array, place: IntArray) -> tuple[Array, list[Part]]:
    """Give poses (L, 4, 4) about the beam origins and all parts, in the order of the site.

    Parameters
    ----------
    adjusted
        In the frame of the reference's clouds, of which (3,) `origin` is where its beams start.
    place
        (L,) of each LiDAR of the site, where it is in the solution.
    """
    T = adjusted.T.copy()
    T[0] = se3.from_rt(np.eye(3), origin)
    rows = (POSE * place[:, None] + np.arange(POSE)).ravel()
    scatter = root_of(adjusted.random)
    own = [
        *adjusted.parts,
        part_of(POLES, np.vstack([np.zeros((POSE, len(scatter))), scatter]), is_random=True),
        *floors(T, np.repeat(np.arange(len(T)) > 0, POSE)),
    ]
    order = np.argsort(place)
    parts = [
        replace(
            part,
            root=part.root[rows],
            lidar=None if part.lidar is None else int(order[part.lidar]),
        )
        for part in own
    ]
    return T[place], parts


def _refined(
    site: Site, scans: SiteScans, T: Array, parts: list[Part]
) -> tuple[Array, list[Part], list[Reason]]:
    """Refine the walk's poses by the surfaces, where both agree; else leave them as they are.

    Raises
    ------
    Refusal
        ``poles_scene_contradict``.
    """
    patches = patches_of(scans)
    recorded = Recorded(site, scans, patches, scene_pairs(patches, range(len(T))))
    free = np.repeat(np.arange(len(T)) != site.reference, POSE)
    covariance = joint_covariance(parts)[np.ix_(free, free)]
    none = np.zeros(0, dtype=np.int64)
    bands = [none if each is None else np.unique(each.bands) for each in patches]
    factor = gaussian_factor_of(T, covariance, free).with_bands(bands)
    factor = replace(factor, left=np.array(recorded.left))
    groups = factor.unknowns.groups()
    known = ErrorModel(recorded.sizes).sigmas(groups)
    problem = RefinementProblem(factor, tuple(recorded.scenes), groups, known)
    end = minimise(problem)
    if not end.scene or not end.converged:
        return T, parts, []
    steps = se3.local(T, end.T)
    step = steps.ravel()[free]
    chi2 = float(step @ np.linalg.solve(covariance, step))
    if chi2 <= chi2_limit(len(step), CONFIDENCE):
        return end.T, list(parts_of(problem, end, POLES)), []
    if chi2 <= chi2_limit(len(step), 1.0 - SIGNIFICANCE):
        return T, parts, []
    k = int(np.argmax(se3.lengths(steps[:, 3:])))
    radians, metres = (float(np.linalg.norm(part)) for part in np.split(steps[k], 2))
    times = np.sqrt(chi2 / len(step))
    message = (
        f"the scene has {site.lidars[k].name} {error(metres, 'm')} and {error(radians, 'rad')} "
        f"from where the pole has it, {times:.1f} times what its uncertainty allows: did a LiDAR "
        "move while the pole was carried?"
    )
    values = {"mahalanobis_sq": chi2, "moved_m": metres, "turned_rad": radians}
    if times**2 > MAX_MAHALANOBIS_SQ / POSE:
        raise Refusal("poles_scene_contradict", message, values)
    return T, parts, [Reason("poles_and_scene_disagree", message, values)]


def _check_conflicts(names: Sequence[str], scans: SiteScans, T: Array, way: Array) -> None:
    """Compare the surroundings of each two LiDARs under their poses.

    Raises
    ------
    Refusal
        ``scene_contradicts``.
    """
    for i, j in combinations(range(len(T)), 2):
        (target,), (source,) = scans.used(i), scans.used(j)
        ways = se3.apply(se3.inverse(T[i]), way), se3.apply(se3.inverse(T[j]), way)
        scene = scene_beside(Placement(target, source), ways)
        found = count([scene], se3.inverse(T[i]) @ T[j])
        if is_in_conflict(found):
            with refusing_of(f"{names[i]} and {names[j]}"):
                check_confirmation(found)


def _weaknesses(site: Site, scans: SiteScans, lidars: Sequence[LidarPose]) -> Iterator[Reason]:
    """Say what makes the answer weak."""
    for k, lidar in enumerate(site.lidars):
        for scan in scans.used(k):
            yield from check_sensor(lidar.name, scan)
            yield from check_sway(lidar.name, [scan])
    yield from not_fit(site, lidars, "a longer walk, with turns and the pole leant to all sides")


def _walk(adjusted: Adjusted, solved: Solved, order: Sequence[int]) -> SiteWalk:
    """State how the pole was carried, and what each LiDAR saw, in the order of the site."""
    points, directions = axes_in_target(adjusted)
    offsets = adjusted.clocks[:, 0] + solved.ahead
    sigmas = adjusted.clock_sigmas
    seen = [
        LidarWalk(
            clock_offset_s=-float(offsets[k]) + 0.0,
            clock_sigma_s=float(sigmas[k]),
            clock_drift=-float(adjusted.clocks[k, 1]) + 0.0,
            middle_s=float(adjusted.middles[k]),
            sweeps=track.sweeps,
            found=len(track.times),
            range_scale=float(adjusted.spread[k, 0]),
            edge_jitter_rad=float(adjusted.spread[k, 1]),
            clock_windows=(adjusted.clock_windows[k] * [1, -1, 1]).tolist(),
        )
        for k, track in enumerate(solved.tracks)
    ]
    lidars = [seen[k] for k in np.argsort(order)]
    figures = figures_of(adjusted, points, directions)
    return SiteWalk(begin_s=float(adjusted.times.min()), **figures, lidars=lidars)
