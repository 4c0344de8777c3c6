"""Where the LiDARs stand in the place: rough poses, settled on what all recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, Placement, PointCloud, Scan
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..scene.confirmation import count, grounds_of, under
from ..scene.consistency import OTHER_GROUND, Standing, standing_in
from ..scene.disambiguation import SCORING_VOXEL
from ..scene.from_above import matches_from_above
from ..scene.icp_refinement import registered
from ..scene.registration import prepare, voxel_downsample
from ..scene.scans import find_poles
from ..scene.visibility import tree_of
from ..simulation.recorded import recorded_beams
from .place import Station

ROUGH = se3.PoseDifference(float(np.radians(15.0)), 1.5)
"""A rough pose is good to 10° and 1 m; what settles farther away than this is another."""

CONTRADICTED = 1.0
"""Voxels of the scene that conflict with a pose, for each that agrees, from which it is wrong."""


def bare_scan(cloud: PointCloud, sensor: Sensor | None) -> Scan:
    """Take a recording without poles as a calibration takes one: without what moved."""
    scan = find_poles(cloud, sensor=sensor, threshold=None, radius=DEFAULT_RADIUS, search=False)
    if scan.refusal is not None:
        raise scan.refusal
    return scan


def stand(names: Sequence[str], scans: Sequence[Scan], rough: Sequence[Array]) -> list[Station]:
    """Stand all LiDARs in the frame of the place, on the ground below the first.

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
    poses = [np.eye(4)]
    for i in range(1, len(scans)):
        others = sorted(range(i), key=lambda j: _apart(rough[j], rough[i]))
        # The nearest of those that stand already shares most with it.
        found = None
        for j in others:
            T = se3.inverse(poses[j]) @ rough[i]
            settled = settle(names[j], names[i], scans[j], scans[i], T)
            if settled is not None:
                found = poses[j] @ settled
                break
        poses.append(rough[i] if found is None else found)
    level = place_frame(scans[0].cloud)
    return [
        station(name, scan, level @ T) for name, scan, T in zip(names, scans, poses, strict=True)
    ]


def station(name: str, scan: Scan, T: Array) -> Station:
    """Stand a LiDAR at a pose (4, 4) in the frame of the place, of its file's frame."""
    cloud = scan.cloud
    shift = se3.from_rt(np.eye(3), cloud.origin)
    cloud = cloud.transformed(se3.inverse(shift))
    beams = recorded_beams(cloud, scan.sensor)
    if beams.rings.max(initial=-1) >= 0:
        cloud = replace(cloud, ring=beams.rings[: len(cloud)])
    return Station(name, cloud, scan.sensor, beams, T @ shift)


def _apart(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def place_frame(cloud: PointCloud) -> Array:
    """(4, 4) to the frame on the ground below a LiDAR: z up, x where the LiDAR's x axis points."""
    standing = standing_in(cloud, np.random.default_rng(0))
    height = float((cloud.origin - standing.ground) @ standing.up)
    up = standing.up if height > 0 else -standing.up
    ahead = np.eye(3)[0] - up[0] * up
    if np.linalg.norm(ahead) < 0.1:
        ahead = np.eye(3)[2] - up[2] * up
    ahead /= np.linalg.norm(ahead)
    R = np.stack([ahead, np.cross(up, ahead), up])
    return se3.from_rt(R, -R @ (cloud.origin - abs(height) * up))


def settle(first: str, second: str, target: Scan, source: Scan, rough: Array) -> Array | None:
    """Settle a rough pose (4, 4), target from source, on what both recorded.

    Returns
    -------
    Array or None
        (4, 4); None where they share too little to say anything.

    Raises
    ------
    Refusal
        ``pose_contradicted`` where the ground, or what stands on it, conflicts with the pose.
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
        return near[0]
    surface = prepare(target.cloud.xyz, SCORING_VOXEL)
    points = voxel_downsample(source.cloud.xyz, SCORING_VOXEL)
    T = registered(surface, tree_of(surface.xyz), points, rough, near=ROUGH)
    said = count([under(grounds, rough)], rough if T is None else T)
    if said.contradicting > CONTRADICTED * said.agreeing and said.contradicting >= 10:
        other = ""
        if found:
            gap = se3.difference(found[0], rough)
            other = (
                f"; the recordings fit each other {np.degrees(gap.rotation):.0f}° and "
                f"{gap.translation:.1f} m from it"
            )
        raise Refusal(
            "pose_contradicted",
            f"under the rough pose of {second} {said.contradicting} parts of the scene stand where "
            f"the other LiDAR looked through, {said.agreeing} agree with {first}{other}: correct "
            "the pose, it must be good to 10° and 1 m",
            {"agreeing": said.agreeing, "contradicting": said.contradicting},
        )
    return T


def _is_near(T: Array, rough: Array) -> bool:
    gap = se3.difference(T, rough)
    return gap.rotation < ROUGH.rotation and gap.translation < ROUGH.translation


def check_grounds(
    first: str, second: str, target: Standing, source: Standing, rough: Array
) -> None:
    """Refuse a rough pose under which one LiDAR's ground is no ground for the other.

    Raises
    ------
    Refusal
        ``pose_contradicted``.
    """
    ups = []
    for one in (target, source):
        height = float((one.image.origin - one.ground) @ one.up)
        ups.append(one.up if height > 0 else -one.up)
    tilt = float(np.arccos(np.clip(ups[0] @ rough[:3, :3] @ ups[1], -1.0, 1.0)))
    if tilt > OTHER_GROUND + ROUGH.rotation:
        upside = "; is one LiDAR mounted upside down?" if tilt > np.radians(150) else ""
        raise Refusal(
            "pose_contradicted",
            f"under the rough pose the ground below {second} is tilted by {np.degrees(tilt):.0f}° "
            f"against that below {first}{upside}: correct the pose, it must be good to 10° and 1 m",
            {"tilt_rad": tilt},
        )
