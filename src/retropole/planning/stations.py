"""Poses of the LiDARs in the surroundings: rough poses, refined by all recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, Placement, PointCloud, Scan
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..hypotheses.evidence import count, grounds_of, under
from ..hypotheses.icp_refinement import registered
from ..hypotheses.one_pole import matches_from_above
from ..simulation.devices import TYPICAL
from ..simulation.raycast import Box, Surface
from ..simulation.recorded import recorded_beams
from ..simulation.scanning import scan
from ..simulation.scenes import ASPHALT, ground
from ..surfaces.consistency import OTHER_GROUND, SceneObjects, objects_in
from ..surfaces.registration import prepare, voxel_downsample
from ..surfaces.scans import find_poles
from ..surfaces.visibility import SCORING_VOXEL, tree_of
from .place import Station

ROUGH = se3.PoseDifference(float(np.radians(15.0)), 1.5)
"""A rough pose is accurate to 10° and 1 m; a result farther away than this is another pose."""

MOVERS = 30
"""This many voxels of the scene may conflict with a right pose, since people walk and plants
move between the recordings: at most 17 on bare ground (benchmarks/plan.py, seeds 0 to 3)."""


FEW = 0.1
"""Largest ratio of conflicting to agreeing parts for a clear pose. Of three LiDARs on a crane the
nearest converged 1.1 m off with 26 conflicting for 114 agreeing, the next to 2 cm with none."""


UPWARD = 0.1
"""Level part of an x axis, of length 1, below which it points up or down: z is ahead then."""

LEAST_RETURNS = 200
"""A LiDAR with fewer returns of the modelled ground does not see it: they give no normal."""


def bare_scan(cloud: PointCloud, sensor: Sensor | None) -> Scan:
    """Prepare a recording without poles as in a calibration: without moving objects."""
    scan = find_poles(cloud, sensor=sensor, threshold=None, radius=DEFAULT_RADIUS, search=False)
    if scan.refusal is not None:
        raise scan.refusal
    return scan


def place_lidars(
    names: Sequence[str], scans: Sequence[Scan], rough: Sequence[Array]
) -> list[Station]:
    """Place all LiDARs in the frame of the scene, on the ground below the first.

    Parameters
    ----------
    names, scans
        Of the LiDARs; the first is the reference.
    rough
        (4, 4) each, their poses in the frame of the first, good to 10° and 1 m.

    Raises
    ------
    Refusal
        ``pose_contradicted`` where the recordings conflict with a rough pose.
    """
    poses, is_refined = [np.eye(4)], [True]
    for i in range(1, len(scans)):
        others = sorted(range(i), key=lambda j: _distance(rough[j], rough[i]))
        # The nearest of those placed already has most in common with it.
        found, conflicts = Refined(rough[i]), []
        for j in others:
            T = se3.inverse(poses[j]) @ rough[i]
            try:
                refined = refine(names[j], names[i], scans[j], scans[i], T)
            except Refusal as conflict:
                conflicts.append(conflict)
                continue
            if j == others[0] or refined.lead > found.lead:
                found = refined._replace(T=poses[j] @ refined.T)
            if refined.is_clear:
                break
        # If another determines it, one with little in common is not used.
        if conflicts and not found.by_place:
            raise conflicts[0]
        is_refined.append(found.by_place)
        poses.append(found.T)
    level = place_frame(scans[0].cloud)
    return [
        replace(station(name, scan, level @ T), is_refined=known)
        for name, scan, T, known in zip(names, scans, poses, is_refined, strict=True)
    ]


def place_drawn_lidars(
    names: Sequence[str],
    sensors: Sequence[Sensor],
    poses: Sequence[Array],
    boxes: Sequence[Box] = (),
) -> list[Station]:
    """Place LiDARs that have recorded nothing yet over flat ground (z = 0) with boxes on it.

    Parameters
    ----------
    names, sensors, poses
        Of the LiDARs; (4, 4) poses in the frame that is drawn in.
    boxes
        Objects there, in the same frame.

    Raises
    ------
    Refusal
        ``no_ground`` if a LiDAR would record hardly any returns on the poles.
    """
    surfaces: list[Surface] = [ground(ASPHALT), *boxes]
    scans = []
    for k, (name, sensor, T) in enumerate(zip(names, sensors, poses, strict=True)):
        recorded = scan(
            surfaces, sensor, T, np.random.default_rng(k), TYPICAL, frames=sensor.sweeps
        )
        if len(recorded.cloud) < LEAST_RETURNS or T[2, 3] <= 0:
            raise Refusal(
                "no_ground",
                f"{name}, {T[2, 3]:g} m above the ground, would have {len(recorded.cloud)} "
                f"returns in all, {LEAST_RETURNS} are needed: set it up above the ground (z > 0) "
                "and rotate it so that it sees the ground",
                {"lidar": name, "height_m": float(T[2, 3]), "returns": len(recorded.cloud)},
            )
        scans.append(bare_scan(recorded.cloud, sensor))
    # The first LiDAR is the datum, and the ground below it the origin.
    level = place_frame(scans[0].cloud) @ se3.inverse(poses[0])
    return [
        station(name, each, level @ T) for name, each, T in zip(names, scans, poses, strict=True)
    ]


def station(name: str, scan: Scan, T: Array) -> Station:
    """Place a LiDAR at a pose (4, 4) in the frame of the scene, of its file's frame."""
    cloud = scan.cloud
    shift = se3.from_rt(np.eye(3), cloud.origin)
    cloud = cloud.transformed(se3.inverse(shift))
    beams = recorded_beams(cloud, scan.sensor)
    if beams.rings.max(initial=-1) >= 0:
        cloud = replace(cloud, ring=beams.rings[: len(cloud)])
    return Station(name, cloud, scan.sensor, beams, T @ shift, scan.cloud.origin)


def _distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def place_frame(cloud: PointCloud) -> Array:
    """(4, 4) to the frame on the ground below a LiDAR: z up, x where the LiDAR's x axis points."""
    up, height = _upwards(objects_in(cloud, np.random.default_rng(0)))
    ahead = np.eye(3)[0] - up[0] * up
    if np.linalg.norm(ahead) < UPWARD:
        ahead = np.eye(3)[2] - up[2] * up
    ahead /= np.linalg.norm(ahead)
    R = np.stack([ahead, np.cross(up, ahead), up])
    return se3.from_rt(R, -R @ (cloud.origin - height * up))


class Refined(NamedTuple):
    """A pose (4, 4), and how many parts of the scene agree and conflict with it where
    the surroundings gave it; none of either where only the ground did."""

    T: Array
    agreeing: int = 0
    contradicting: int = 0

    @property
    def by_place(self) -> bool:
        """Whether the pose is from the surroundings."""
        return self.agreeing > 0

    @property
    def lead(self) -> int:
        """Number of agreeing parts minus conflicting ones."""
        return self.agreeing - self.contradicting

    @property
    def is_clear(self) -> bool:
        """Whether the conflicts are too few to need another LiDAR."""
        return self.by_place and self.contradicting <= FEW * self.agreeing


def refine(first: str, second: str, target: Scan, source: Scan, rough: Array) -> Refined:
    """Refine a rough pose (4, 4), target from source, by both recordings.

    If they have too little in common, the ground is aligned with the ground.

    Raises
    ------
    Refusal
        ``pose_contradicted`` if the ground, or objects on it, conflict with the pose.
    """
    grounds = grounds_of(Placement(target, source), np.random.default_rng(0))
    check_grounds(first, second, grounds[0][0], grounds[1][0], rough)
    found = [
        match.T_target_source
        for match in matches_from_above(Placement(target, source), grounds)
        if match.exact
    ]
    near = [T for T in found if _is_near(T, rough)]
    if near:
        return _counted(grounds, near[0])
    T = _ground_on_ground(grounds[0][0], grounds[1][0], rough)
    counts = count([under(grounds, T)], T)
    if counts.contradicting > max(counts.agreeing, MOVERS):
        other = ""
        if found:
            gap = se3.difference(found[0], rough)
            other = (
                f"; the recordings fit each other {np.degrees(gap.rotation):.0f}° and "
                f"{gap.translation:.1f} m from it"
            )
        raise Refusal(
            "pose_contradicted",
            f"under the rough pose of {second} {counts.contradicting} parts of the scene are in "
            f"space that the other LiDAR saw to be empty, {counts.agreeing} agree with "
            f"{first}{other}: correct the pose, it must be accurate to 10° and 1 m",
            {"agreeing": counts.agreeing, "contradicting": counts.contradicting},
        )
    surface = prepare(target.cloud.xyz, SCORING_VOXEL)
    points = voxel_downsample(source.cloud.xyz, SCORING_VOXEL)
    refined = registered(surface, tree_of(surface.xyz), points, T, near=ROUGH)
    if refined is not None:
        by_place = _counted(grounds, refined)
        if by_place.agreeing > MOVERS:
            return by_place
    # On bare ground a registration is not constrained.
    return Refined(T)


def _counted(grounds: tuple[Sequence[SceneObjects], Sequence[SceneObjects]], T: Array) -> Refined:
    counts = count([under(grounds, T)], T)
    return Refined(T, counts.agreeing, counts.contradicting)


def _upwards(one: SceneObjects) -> tuple[Array, float]:
    """Normal (3,) of the ground towards the LiDAR, and the LiDAR's height above it, metres."""
    height = float((one.image.origin - one.ground) @ one.up)
    return (one.up, height) if height > 0 else (-one.up, -height)


def _ground_on_ground(target: SceneObjects, source: SceneObjects, rough: Array) -> Array:
    """Rotate and lift a rough pose (4, 4) so that the source's ground coincides with the
    target's."""
    up, _ = _upwards(target)
    own = rough[:3, :3] @ _upwards(source)[0]
    axis = np.cross(own, up)
    sine = float(np.linalg.norm(axis))
    turn = np.arctan2(sine, float(own @ up)) * axis / max(sine, 1e-12)
    T = rough.copy()
    T[:3, :3] = se3.exp_so3(turn) @ rough[:3, :3]
    T[:3, 3] += ((target.ground - se3.apply(T, source.ground[None])[0]) @ up) * up
    return T


def _is_near(T: Array, rough: Array) -> bool:
    gap = se3.difference(T, rough)
    return gap.rotation < ROUGH.rotation and gap.translation < ROUGH.translation


def check_grounds(
    first: str, second: str, target: SceneObjects, source: SceneObjects, rough: Array
) -> None:
    """Refuse a rough pose under which the grounds of the two LiDARs do not coincide.

    Raises
    ------
    Refusal
        ``pose_contradicted``.
    """
    ups = [_upwards(one)[0] for one in (target, source)]
    tilt = float(np.arccos(np.clip(ups[0] @ rough[:3, :3] @ ups[1], -1.0, 1.0)))
    if tilt > OTHER_GROUND + ROUGH.rotation:
        upside = "; is one LiDAR mounted upside down?" if tilt > np.radians(150) else ""
        raise Refusal(
            "pose_contradicted",
            f"under the rough pose the ground below {second} is tilted by "
            f"{np.degrees(tilt):.0f}° against that below {first}{upside}: correct the pose, it "
            "must be accurate to 10° and 1 m",
            {"tilt_rad": tilt},
        )
