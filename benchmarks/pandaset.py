"""Refinement on real frames without poles: where it comes to from starts around the reference.

Beside it, where ICP of other kinds comes to from the reference itself, and how the surfaces that
both LiDARs see lie together under each pose; and how far three frames of the standing vehicle are
from each other, in units of what they state. Prints Markdown tables.

    python benchmarks/pandaset.py pandaset
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from retropole import se3
from retropole.datatypes import Array, PoseEstimate
from retropole.evaluation.metrics import evaluate
from retropole.io import read_cloud
from retropole.scene.refinement import Refinement, refine
from retropole.scene.registration import prepare, register
from retropole.sensors import find_sensor
from retropole.systematic import ErrorModel, Sizes, sizes_of

START_ROTATION, START_TRANSLATION = np.radians(3.0), 0.3
"""How far from the reference the refinement starts, rad and m."""

FRAMES = ("00", "01", "05")
"""Of one standing vehicle, 0.1 s and 0.5 s after the first."""

REFERENCE_SIGMA = np.r_[np.full(3, np.radians(0.1)), np.full(3, 0.03)]
"""1 σ of the reference, rad and m."""

MODEL = ErrorModel(sizes_of(find_sensor("Pandar64")), Sizes())


def distance(T: Array, other: Array, covariance: Array) -> float:
    """Mahalanobis distance of two poses."""
    step = se3.local(T, other)
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))


def compare_frames(folder: Path, reference: Array, wide: Array) -> None:
    """Refine each frame from the reference, and print how they agree."""
    found: dict[str, Refinement] = {}
    for frame in FRAMES:
        clouds = (
            read_cloud(folder / f"pandaset002_{frame}_{name}.pcd")
            for name in ("pandar64", "pandargt")
        )
        refined = refine(*clouds, PoseEstimate(reference, wide, 0.01), model=MODEL)
        assert refined is not None
        found[frame] = refined
    print("\n| frames | apart deg | cm | in units of what both state | of the random parts alone |")
    print("| --- | --- | --- | --- | --- |")
    pairs = [(a, b) for i, a in enumerate(FRAMES) for b in FRAMES[i + 1 :]]
    for a, b in pairs:
        one, two = found[a], found[b]
        T, other = one.pose.T_target_source, two.pose.T_target_source
        off = se3.local(T, other)
        print(
            f"| {a} and {b} | {np.degrees(np.linalg.norm(off[:3])):.2f} | "
            f"{100 * np.linalg.norm(off[3:]):.1f} | "
            f"{distance(T, other, one.uncertainty.covariance + two.uncertainty.covariance):.1f} | "
            f"{distance(T, other, one.uncertainty.random + two.uncertainty.random):.1f} |"
        )
    for frame, one in found.items():
        T = one.pose.T_target_source
        off = se3.local(T, reference)
        both = one.uncertainty.covariance + np.diag(REFERENCE_SIGMA**2)
        print(
            f"| {frame} and the reference | {np.degrees(np.linalg.norm(off[:3])):.2f} | "
            f"{100 * np.linalg.norm(off[3:]):.1f} | {distance(T, reference, both):.1f} | |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--starts", type=int, default=10)
    arguments = parser.parse_args()
    target, source = (
        read_cloud(arguments.folder / f"pandaset002_00_{name}.pcd")
        for name in ("pandar64", "pandargt")
    )
    document = json.loads((arguments.folder / "pandaset002_reference.json").read_text())
    reference = np.array(document["T_pandargt_to_pandar64"])
    poses: dict[str, Array] = {"reference of the vehicle": reference}
    wide = np.diag(np.r_[np.full(3, START_ROTATION), np.full(3, START_TRANSLATION)] ** 2 / 3)
    rng, ends = np.random.default_rng(0), []
    for _ in range(arguments.starts):
        axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        step = np.r_[START_ROTATION * axis, START_TRANSLATION * direction]
        start = se3.retract(reference, step)
        refined = refine(target, source, PoseEstimate(start, wide, 0.01), model=MODEL)
        assert refined is not None
        ends.append(refined.pose.T_target_source)
        stated = refined.pose.covariance
    poses["refinement, from 3° and 0.3 m off"] = ends[0]
    for method in ("GICP", "PLANE_ICP"):
        for voxel, distance in ((0.1, 0.3), (0.1, 1.0), (0.25, 1.0)):
            surfaces = prepare(target.xyz, voxel), prepare(source.xyz, voxel)
            end = register(
                *surfaces,
                reference,
                method=method,
                max_correspondence_distance=distance,
                max_iterations=100,
            )
            name = f"{method} from the reference, voxel {voxel} m, correspondences {distance} m"
            poses[name] = end.T_target_source
    print("| pose | from the reference deg | cm | plane residual mm | overlap | entropy's sum |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, T in poses.items():
        off = se3.local(T, reference)
        score = evaluate(target, source, T, rng=np.random.default_rng(0))
        assert score.plane_residual is not None
        print(
            f"| {name} | {np.degrees(np.linalg.norm(off[:3])):.2f} | "
            f"{100 * np.linalg.norm(off[3:]):.1f} | {1000 * score.plane_residual:.1f} | "
            f"{score.overlap:.3f} | {score.entropy.sum:.5f} |"
        )
    apart = np.array([se3.local(ends[0], T) for T in ends])
    most = np.linalg.norm(apart[:, :3], axis=1).max(), np.linalg.norm(apart[:, 3:], axis=1).max()
    print(
        f"\nThe refinements from {len(ends)} starts end within {np.degrees(most[0]):.3f}° and "
        f"{100 * most[1]:.2f} cm of each other."
    )
    assert stated is not None
    rotation = np.degrees(se3.local(reference, ends[0])[:3])
    sigma = np.degrees(np.sqrt(np.diag(stated)[:3]))
    words = ", ".join(f"{a:+.2f} ± {b:.2f}" for a, b in zip(rotation, sigma, strict=True))
    print(f"Rotation from the reference and stated 1 σ, about x, y, z of the target: {words} deg.")
    compare_frames(arguments.folder, reference, wide)


if __name__ == "__main__":
    main()
