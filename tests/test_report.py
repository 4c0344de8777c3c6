"""The report is one file that opens offline, says all the result says, and runs nothing of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from retropole import se3
from retropole.datatypes import Detection, PointCloud, Pole, RejectedCluster

T_TRUE = se3.from_rt(
    Rotation.from_euler("xyz", [3.0, -2.0, 38.0], degrees=True).as_matrix(),
    np.array([-0.6, 1.9, 0.25]),
)
POLES = (  # foot on the ground and direction, target frame
    (np.array([4.2, 1.1, -1.4]), np.array([0.18, 0.10, 1.0])),
    (np.array([4.6, -1.5, -1.4]), np.array([-0.12, -0.22, 1.0])),
)


def scene(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ground, boxes and walls as one LiDAR 1.4 m up would crowd them, and their intensity."""
    n = count // 5
    r, a = 2.0 + 26 * rng.random(2 * n) ** 1.8, 2 * np.pi * rng.random(2 * n)
    ground = np.c_[r * np.cos(a), r * np.sin(a), -1.4 + 0.01 * rng.standard_normal(2 * n)]
    wall = np.c_[np.full(n, 11.0), rng.uniform(-9, 14, n), rng.uniform(-1.4, 2.2, n)]
    side = np.c_[rng.uniform(-7, 11, n), np.full(n, -9.0), rng.uniform(-1.4, 1.8, n)]
    box = rng.uniform(-1, 1, (count - 4 * n, 3)) * [1.1, 0.8, 0.7]
    face = rng.integers(0, 3, len(box))
    box[np.arange(len(box)), face] = (
        np.where(rng.random(len(box)) < 0.5, -1, 1) * np.array([1.1, 0.8, 0.7])[face]
    )
    box += np.where(rng.random(len(box))[:, None] < 0.5, [6.5, 5.0, -0.7], [1.0, -5.5, -0.7])
    xyz = np.r_[ground, wall, side, box]
    return xyz, np.r_[rng.uniform(5, 30, 2 * n), rng.uniform(20, 90, len(xyz) - 2 * n)]


def observed(T_target_lidar: np.ndarray, seed: int, count: int) -> tuple[PointCloud, Detection]:
    """One LiDAR's cloud of the scene, with two poles and a bright plate found in it."""
    rng = np.random.default_rng(seed)
    xyz, intensity = scene(rng, count)
    T_lidar_target = se3.inverse(T_target_lidar)
    parts = [xyz]
    poles, start = [], len(xyz)
    for foot, leaning in POLES:
        n = leaning / np.linalg.norm(leaning)
        s = np.sort(rng.uniform(0.1, 1.7, 60))
        points = foot + s[:, None] * n + 0.006 * rng.standard_normal((60, 3))
        parts.append(points)
        seen = se3.apply(T_lidar_target, points)
        index = np.arange(start, start + 60)
        start += 60
        direction = T_lidar_target[:3, :3] @ n
        poles.append(Pole(seen.mean(axis=0), direction, seen, 1.6, 0.0061, 9, index))
    plate = np.array([10.9, 3.0, 0.4]) + rng.uniform(-1, 1, (40, 3)) * [0.01, 0.4, 0.3]
    index = np.arange(start, start + 40)
    rejected = RejectedCluster(
        index,
        se3.apply(T_lidar_target, plate).mean(axis=0),
        "too_wide",
        "0.81 m wide, a pole of radius 0.02 m is at most 0.12 m",
    )
    xyz = se3.apply(T_lidar_target, np.r_[xyz, *parts[1:], plate])
    intensity = np.r_[intensity, np.full(len(xyz) - len(intensity), 250.0)]
    cloud = PointCloud(xyz, intensity)
    return cloud, Detection(tuple(poles), (rejected,), 200.0, "auto", 160)


def pole_document(pole: Pole) -> dict[str, Any]:
    return {
        "point_m": pole.point.tolist(),
        "direction": pole.direction.tolist(),
        "length_m": pole.length,
        "points": len(pole.xyz),
        "rings": pole.rings,
        "rms_m": pole.rms,
    }


def half_turns() -> list[np.ndarray]:
    """Identity and the half turns about the common perpendicular and the bisectors."""
    (p, a), (q, b) = ((f + 0.8 * n, n / np.linalg.norm(n)) for f, n in POLES)
    axes = [np.cross(a, b), a + b, a - b]
    turns = [np.eye(4)]
    for axis in axes:
        R = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
        middle = (p + q) / 2
        turns.append(se3.from_rt(R, middle - R @ middle))
    return turns


def made_up(
    status: str = "ok", count: int = 4000
) -> tuple[dict[str, Any], PointCloud, PointCloud, tuple[Detection, Detection]]:
    """A result document as a run writes it, and its clouds."""
    target, found_target = observed(np.eye(4), 1, count)
    source, found_source = observed(T_TRUE, 2, count)
    figures = [(0.81, 0.02, 0.79, 0.021, 0.031), (0.44, 0.16, 0.28, 0.61, 0.92)]
    figures += [(0.41, 0.22, 0.19, 1.32, 4.10), (0.28, 0.31, -0.03, 1.71, 7.45)]
    hypotheses = [
        {
            "pairs": [[0, 0], [1, 1]] if k in (0, 3) else [[0, 1], [1, 0]],
            "T_target_source": (turn @ T_TRUE).tolist(),
            "pole_rms_m": 0.0142 + 0.0001 * k,
            "exact": True,
            "icp_rotation_rad": e_r,
            "icp_translation_m": e_t,
            "overlap": overlap,
            "free_space": against,
            "score": score,
            "chosen": k == 0 and status != "refused",
        }
        for k, (turn, (overlap, against, score, e_r, e_t)) in enumerate(
            zip(half_turns(), figures, strict=True)
        )
    ]
    covariance = np.diag(np.square([6e-4, 5e-4, 4e-4, 2e-3, 3e-3, 6e-3]))
    reasons = {
        "ok": [],
        "warn": [
            {
                "code": "small_margin",
                "message": "the chosen hypothesis leads by 0.061 only (comfortable: 0.08)",
                "values": {"margin": 0.061},
            }
        ],
        "refused": [
            {
                "code": "ambiguous",
                "message": "the scene does not tell 2 hypotheses apart (scores 0.441 and 0.436, "
                "0.04 between them is needed)",
                "values": {"margin": 0.005},
            }
        ],
    }[status]
    answered = status != "refused"
    pose = {
        "T_target_source": T_TRUE.tolist(),
        "covariance": covariance.tolist(),
        "rms_m": 0.0142,
    }
    result = {
        "schema": "retropole/result/1",
        "status": status,
        "reasons": reasons,
        "T_target_source": T_TRUE.tolist() if answered else None,
        "covariance": covariance.tolist() if answered else None,
        "covariance_order": ["phi_x", "phi_y", "phi_z", "delta_x", "delta_y", "delta_z"],
        "covariance_frame": "target axes: R_true = Exp(phi) R, t_true = t + delta; rad and m",
        "predicted_error": [
            {"range_m": r, "sigma_m": float(np.hypot(0.007, 7e-4 * r))} for r in (1.0, 10, 30, 60)
        ]
        if answered
        else None,
        "stages": {
            "poles": pose if answered else None,
            "refined": {**pose, "rms_m": 0.0098} if status == "ok" else None,
        },
        "hypotheses": hypotheses,
        "margin": 0.51 if answered else 0.005,
        "poles": {
            "target": [pole_document(p) for p in found_target.poles],
            "source": [pole_document(p) for p in found_source.poles],
        },
        "inputs": [
            {
                "path": f"/data/yard/{name}.pcd",
                "sha256": 8 * f"{k}f3a9c1e",
                "points": len(cloud),
                "dropped": 17 * k,
                "sensor": "VLP-16" if k else "auto",
                "threshold": 200.0,
            }
            for k, (name, cloud) in enumerate((("front", target), ("rear", source)))
        ],
        "config": {"radius_m": 0.02, "poles": None, "refine": True, "seed": 0},
        "version": "0.1.0",
        "created": "2025-05-05T12:00:00+00:00",
        "seconds": {"read": 0.21, "extract": 0.09, "match": 0.004, "disambiguate": 0.44},
    }
    return result, target, source, (found_target, found_source)


def test_page_is_rendered() -> None:
    result, target, source, detections = made_up(count=500)
    assert "T_target_source" in render_report(result, target, source, detections)
