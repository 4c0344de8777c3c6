"""A site that was never calibrated: what a run over made-up clouds of many LiDARs would answer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from retropole.adjustment.answer import (
    LidarPose,
    LoopClosure,
    PairCheck,
    SiteCalibration,
    SitePole,
    WithoutPlacement,
)
from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import (
    Array,
    Detection,
    IntArray,
    PointCloud,
    Pole,
    RejectedCluster,
    Scan,
    Test,
)
from retropole.base.description import (
    ControlPoint,
    Frame,
    Geodetic,
    Sighting,
    Site,
    SiteLidar,
    SurveyedPole,
    Up,
)
from retropole.base.errors import Reason, Refusal
from retropole.base.sensors import SENSORS
from retropole.base.uncertainty import BudgetEntry, predicted_error
from retropole.base.uncertainty.purpose import Fitness, Need
from retropole.result import InputDoc
from retropole.result.site import SiteConfig, SiteDoc, recording_document, site_document

NAMES = ("mast-a", "mast-b", "gate", "crane-low", "crane-high", "quay-n", "quay-s", "shed")

PLACES = (
    *((0.0, 0.0, 3.2, 0.0), (14.0, 1.5, 3.0, 170.0), (7.0, -6.5, 1.8, 92.0)),
    *((3.5, 8.0, 2.2, -80.0), (3.9, 8.4, 6.5, -75.0), (16.0, 9.0, 2.5, -130.0)),
    *((17.0, -5.0, 2.4, 140.0), (-4.0, 6.0, 2.0, -30.0)),
)
"""x, y, z, metres, and yaw, degrees, of each LiDAR in the frame of the site."""

PLACEMENTS = ("morning", "noon", "after lunch", "evening")

POLE_FEET = (
    *(((4.2, 1.1), (6.6, 3.5)), ((9.8, 2.8), (7.2, -1.6))),
    *(((5.1, 4.9), (10.5, -0.4)), ((8.0, 5.5), (3.0, -2.5))),
)
"""x, y of the two poles of each placement, metres."""

SEEN_UP_TO = 13.0
"""A LiDAR sees poles up to here, metres: not every pair shares one."""


def pose_of(k: int) -> Array:
    """T_site_lidar of the k-th LiDAR, the first being the frame of the site."""
    return se3.inverse(_in_yard(0)) @ _in_yard(k)


def _in_yard(k: int) -> Array:
    x, y, z, yaw = PLACES[k]
    R = Rotation.from_euler("zyx", [yaw, 4.0 - k, 0.5 * k], degrees=True).as_matrix()
    return se3.from_rt(R, np.array([x, y, z]))


def yard(rng: np.random.Generator, count: int) -> Array:
    """(count, 3) points of the ground, of walls around it and of boxes, frame of the yard."""
    n = count // 4
    ground = np.c_[rng.uniform(-12, 28, n), rng.uniform(-16, 20, n), np.zeros(n)]
    wall = np.c_[rng.uniform(-12, 28, n), np.full(n, 20.0), rng.uniform(0, 6, n)]
    side = np.c_[np.full(n, 28.0), rng.uniform(-16, 20, n), rng.uniform(0, 4, n)]
    boxes = rng.uniform(-1, 1, (count - 3 * n, 3)) * [3.0, 1.2, 1.3]
    face = rng.integers(0, 3, len(boxes))
    boxes[np.arange(len(boxes)), face] = (
        np.where(rng.random(len(boxes)) < 0.5, -1, 1) * np.array([3.0, 1.2, 1.3])[face]
    )
    corners = np.array([[20.0, 3.0, 1.3], [11.0, 13.0, 1.3], [-6.0, -5.0, 1.3]])
    boxes += corners[rng.integers(0, 3, len(boxes))]
    return np.concatenate([ground, wall, side, boxes])


def poles_of(placement: int) -> list[tuple[Array, Array]]:
    """Foot (3,) and unit direction (3,) of each pole of a placement, frame of the yard."""
    leans = ((0.18, 0.10, 1.0), (-0.12, -0.22, 1.0))
    return [
        (np.array([*foot, 0.1]), np.array(lean) / np.linalg.norm(lean))
        for foot, lean in zip(POLE_FEET[placement], leans, strict=True)
    ]


def seen_poles(k: int, placement: int) -> list[int]:
    """Indices of the poles of a placement that the k-th LiDAR sees."""
    here = _in_yard(k)[:3, 3]
    poles = poles_of(placement)
    return [i for i, (foot, _) in enumerate(poles) if np.linalg.norm(foot - here) < SEEN_UP_TO]


def scan_of(k: int, placement: int, count: int) -> Scan:
    """What the k-th LiDAR records of a placement: the yard, the poles near it, a bright plate."""
    rng = np.random.default_rng([k, placement])
    T = se3.inverse(_in_yard(k))
    xyz = se3.apply(T, yard(rng, count) + 0.01 * rng.standard_normal((count, 3)))
    parts, poles, start = [xyz], [], count
    for i in seen_poles(k, placement):
        foot, n = poles_of(placement)[i]
        points = foot + np.sort(rng.uniform(0.0, 1.7, 40))[:, None] * n
        seen = se3.apply(T, points + 0.006 * rng.standard_normal(points.shape))
        index: IntArray = np.arange(start, start + 40)
        start += 40
        poles.append(Pole(seen.mean(axis=0), T[:3, :3] @ n, seen, 1.65, 0.0061, 8, index))
        parts.append(seen)
    plate = se3.apply(T, np.array([27.9, 3.0, 2.0]) + rng.uniform(-0.4, 0.4, (30, 3)))
    rejected = RejectedCluster(
        np.arange(start, start + 30), plate.mean(axis=0), "too_wide", "0.8 m wide, at most 0.12 m"
    )
    points = np.concatenate([*parts, plate])
    intensity = np.r_[rng.uniform(5, 90, count), np.full(len(points) - count, 250.0)]
    detection = Detection(tuple(poles), (rejected,), 200.0, "auto", len(points) - count)
    refusal = (
        None
        if len(poles) > 1
        else Refusal("too_few_poles", f"poles found: {len(poles)}, two are needed", {"poles": 1})
    )
    return Scan(PointCloud(points, intensity), None, detection, refusal)


def made_up_site(
    status: Status = "ok",
    lidars: int = 8,
    placements: int = 4,
    count: int = 300,
    surveyed: bool = False,
) -> SiteCalibration:
    """Make up the answer of a site, or a refusal."""
    scans = tuple(
        tuple(
            # One LiDAR was off in the second placement.
            None if (k, j) == (2, 1) else scan_of(k, j, count)
            for j in range(placements)
        )
        for k in range(lidars)
    )
    site = Site(
        name="Quay 7 <north>",
        lidars=tuple(
            SiteLidar(
                NAMES[k],
                tuple(None if scan is None else scan.cloud for scan in scans[k]),
                SENSORS["VLP-16"] if k % 3 else None,
                serial=f"SN-{k:04d}" if k % 2 else "",
                up=Up(np.array([0.0, 0.0, 1.0]), 0.01) if k == 0 else None,
            )
            for k in range(lidars)
        ),
        placements=PLACEMENTS[:placements],
        radius_sigma=0.0005,
        frame=Frame("ENU at 52.10000, 4.20000", True, geodetic=Geodetic(0.9093, 0.0733, 12.0))
        if surveyed
        else Frame("LiDAR mast-a"),
        poles=_survey() if surveyed else (),
        points=(
            ControlPoint("P1", np.array([9.0, 9.0, 0.5]), 0.005, (Sighting(0, np.ones(3), 0.01),)),
        )
        if surveyed
        else (),
        need=Need(0.02, 30.0),
    )
    refused = SiteCalibration(
        status="refused",
        reasons=(Reason("ambiguous", "the loop of mast-a, mast-b and gate leaves two ways", {}),),
        site=site,
        datum="none",
        scans=scans,
        lidars=(),
        covariance=None,
        groups=(tuple(range(lidars - 1)), (lidars - 1,)),
        poles=(),
        pairs=_pairs(lidars, placements, refused=True),
        loops=(),
        tests=(),
        without=(),
        seconds={"extract": 0.4, "pairs": 1.2},
    )
    if status == "refused":
        return refused
    covariance = joint(lidars, surveyed)
    reasons = (
        Reason("small_margin", "pole 2 of noon as gate sees it stands out: w = 6.3", {"w": 6.3}),
    )
    return replace(
        refused,
        status=status,
        reasons=reasons if status == "warn" else (),
        datum="surveyed poles and control points" if surveyed else "LiDAR mast-a stands still",
        lidars=tuple(_pose(k, covariance) for k in range(lidars)),
        covariance=covariance,
        groups=(tuple(range(lidars)),),
        poles=_poles(lidars, placements),
        pairs=_pairs(lidars, placements, refused=False),
        loops=_loops(lidars),
        tests=_tests(lidars, placements, status),
        without=tuple(
            WithoutPlacement(j, 2e-4 * (j + 1), 1.5e-3 * (j + 1), (j + 1) % lidars)
            if j < 3
            else WithoutPlacement(j, None, None, None)
            for j in range(placements if placements > 1 else 0)
        ),
    )


@cache
def joint(lidars: int, surveyed: bool) -> Array:
    """Joint covariance (6 L, 6 L); the first LiDAR has none where it is the frame."""
    rng = np.random.default_rng(5)
    half = rng.standard_normal((6 * lidars, 6 * lidars + 4))
    covariance = half @ half.T / half.shape[1]
    sigma = np.concatenate(
        [
            np.array([2e-4, 2e-4, 4e-4, 4e-3, 3e-3, 5e-3]) * (surveyed or k > 0) * (1 + 0.3 * k)
            for k in range(lidars)
        ]
    )
    return np.asarray(covariance * np.outer(sigma, sigma))


def _survey() -> tuple[SurveyedPole, ...]:
    T = se3.inverse(_in_yard(0))
    foot, n = poles_of(0)[0]
    ends = se3.apply(T, np.array([foot, foot + 1.7 * n]))
    return (SurveyedPole("S1", 0, ends[0], ends[1], 0.005),)


def _pose(k: int, covariance: Array) -> LidarPose:
    own = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
    if not own.any():
        return LidarPose(k, pose_of(k), own, (), ())
    parts = (
        (f"range offset of {NAMES[k]}", 0.01, "m", -0.0123, 0.52),
        ("range offset of mast-a", 0.01, "m", 0.004, 0.21),
        (f"elevation of the beams of {NAMES[k]}", 5e-4, "rad", None, 0.14),
        ("scatter of the surfaces", 0.0031, "m", None, 0.11),
        ("radius of the poles", 4.2e-4, "m", 3.1e-4, 0.02),
    )
    budget: tuple[Any, ...] = tuple(BudgetEntry(n, None, s, u, e, p) for n, s, u, e, p in parts)  # type: ignore[arg-type]
    need = "within 2 cm at 30 m"
    fitness = (
        Fitness(0.02, 30.0, "yes", 0.97, 0.018 + 0.002 * k, f"{need}: yes, 97 % sure")
        if k < 4
        else Fitness(0.02, 30.0, "not shown", 0.6, None, f"{need}: not shown, 60 % sure")
    )
    return LidarPose(k, pose_of(k), own, budget, predicted_error(own), fitness)


def _poles(lidars: int, placements: int) -> tuple[SitePole, ...]:
    T = se3.inverse(_in_yard(0))
    poles = []
    for j in range(placements):
        for i, (foot, n) in enumerate(poles_of(j)):
            seen = tuple(k for k in range(lidars) if (k, j) != (2, 1) and i in seen_poles(k, j))
            middle = se3.apply(T, (foot + 0.85 * n)[None])[0]
            name = f"pole {i + 1} of {PLACEMENTS[j]}"
            poles.append(SitePole(name, j, middle, T[:3, :3] @ n, 1.7, seen))
    return tuple(poles)


def _pairs(lidars: int, placements: int, refused: bool) -> tuple[PairCheck, ...]:
    pairs = []
    for a, b in combinations(range(lidars), 2):
        shared = sum(
            len(set(seen_poles(a, j)) & set(seen_poles(b, j)))
            for j in range(placements)
            if (2, j) not in ((a, 1), (b, 1))
        )
        standing = 0 if shared < 2 else 2 if (a + b) % 5 == 0 else 1
        w = None if standing == 0 or refused else round(0.4 + 0.83 * ((3 * a + 5 * b) % 7), 2)
        refusal = Reason("too_few_poles", "no two poles in common", {}) if shared < 2 else None
        pairs.append(PairCheck((a, b), shared, standing, 20 * standing, w, refusal))
    return tuple(pairs)


def _loops(lidars: int) -> tuple[LoopClosure, ...]:
    return tuple(
        LoopClosure((0, k, k + 1), 3e-4 * k, 0.002 * k, 3.1 * k, 6, max(0.9 - 0.14 * k, 1e-5))
        for k in range(1, lidars - 1)
    )


def _tests(lidars: int, placements: int, status: Status) -> tuple[Test, ...]:
    rng = np.random.default_rng(3)
    tests = []
    for j in range(placements):
        for i in range(2):
            for k in range(lidars):
                if (k, j) == (2, 1) or i not in seen_poles(k, j):
                    continue
                w = abs(float(rng.standard_normal()))
                if status == "warn" and (i, j, k) == (1, 0, 1):
                    w = 6.3
                share = float(rng.uniform(0.2, 0.8))
                least = 4.13 * 0.004 / share
                name = f"pole {i + 1} of {PLACEMENTS[j]} as {NAMES[k]} sees it"
                tests.append(
                    Test("pole", name, k, j, 2 * j + i, w**2, 1, w, share, least, 3 * least, 5.0)
                )
    tests.append(
        Test("lidar", f"{NAMES[0]} as a whole", 0, None, None, 3.0, 6, 0.4, 0.0, None, None, 5.0)
    )
    return tuple(tests)


def document_of(calibration: SiteCalibration) -> SiteDoc:
    """Write the document of a made-up answer."""
    inputs = [
        recording_document(
            InputDoc(f"/data/quay/{NAMES[k]}-{j + 1}.pcd", 8 * "0f3a9c1e", 340, 3, "auto", None),
            k,
            j,
        )
        for k, scans in enumerate(calibration.scans)
        for j, scan in enumerate(scans)
        if scan is not None
    ]
    return site_document(
        calibration,
        inputs=inputs,
        config=SiteConfig(site_file="quay.toml", site_sha256=8 * "9b3a9c1e"),
        seconds={"read": 1.2, **calibration.seconds},
    )
