"""A run that was never run: what a calibration of two made-up clouds would have written."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import (
    Array,
    Detection,
    IntArray,
    Placement,
    PointCloud,
    Pole,
    PoseEstimate,
    RejectedCluster,
    Scan,
)
from retropole.base.errors import visible
from retropole.base.uncertainty import (
    BudgetEntry,
    RadiusEstimate,
    Uncertainty,
    WeakDirection,
    predicted_error,
)
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.result import (
    HypothesisDoc,
    InputDoc,
    PolesDoc,
    ReasonDoc,
    ResultDoc,
    RunConfig,
    StagesDoc,
    pole_documents,
)

HOSTILE = "</script><script>window.injected=1</script>\u2028<!--'\"&"
"""Text that would run, were it not escaped."""

AS_SHOWN = visible(HOSTILE)
"""How a page shows it."""

T_TRUE = se3.from_rt(
    Rotation.from_euler("xyz", [3.0, -2.0, 38.0], degrees=True).as_matrix(),
    np.array([-0.6, 1.9, 0.25]),
)

FEET_AND_DIRECTIONS = (  # on the ground, target frame
    (np.array([4.2, 1.1, -1.4]), np.array([0.18, 0.10, 1.0])),
    (np.array([4.6, -1.5, -1.4]), np.array([-0.12, -0.22, 1.0])),
)

REASONS = {
    "ok": [],
    "warn": [
        ReasonDoc("small_margin", "the chosen hypothesis leads by 0.061 only", {"margin": 0.061})
    ],
    "refused": [
        ReasonDoc("ambiguous", "the scene does not tell 2 hypotheses apart", {"margin": 0.005})
    ],
}

RANDOM = np.diag(np.square([1e-4, 1e-4, 8e-5, 7e-4, 9e-4, 1.1e-3]))
SYSTEMATIC = np.diag(np.square([2e-4, 1.5e-4, 1e-4, 2e-3, 3e-3, 4e-3]))
"""(6, 6) each, over ``[φ, δ]``, rad and m."""

BUDGET = (
    BudgetEntry("range offset", "source", 0.01, "m", -0.0123, 0.58),
    BudgetEntry("elevation of the beams", "source", 5e-4, "rad", None, 0.14),
    BudgetEntry("scatter of the surfaces", None, 0.0031, "m", None, 0.11),
    BudgetEntry("eccentricity of the encoder", "target", 3e-4, "rad", 1.2e-4, 0.08),
    BudgetEntry("unmodelled errors", None, 0.0025, "m", None, 0.06),
    BudgetEntry("scale of ranges", "target", 2e-4, "1", -3e-5, 0.027),
    BudgetEntry("radius of the poles", None, 4.2e-4, "m", 3.1e-4, 0.003),
)


class Run(NamedTuple):
    """A result document, and the placements that it is of."""

    result: ResultDoc
    placements: tuple[Placement, ...]


class Surfaces(NamedTuple):
    """Points (N, 3), metres, and their intensity (N,)."""

    xyz: Array
    intensity: Array


def surroundings(rng: np.random.Generator, count: int) -> Surfaces:
    """Ground, boxes and walls as one LiDAR 1.4 m up would crowd them."""
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
    return Surfaces(xyz, np.r_[rng.uniform(5, 30, 2 * n), rng.uniform(20, 90, len(xyz) - 2 * n)])


def observed(T_target_lidar: Array, seed: int, count: int) -> Scan:
    """What one LiDAR sees: the surroundings, two poles, and a bright plate."""
    rng = np.random.default_rng(seed)
    xyz, intensity = surroundings(rng, count)
    T_lidar_target = se3.inverse(T_target_lidar)
    parts, poles, start = [xyz], [], len(xyz)
    for foot, leaning in FEET_AND_DIRECTIONS:
        n = leaning / np.linalg.norm(leaning)
        s = np.sort(rng.uniform(0.1, 1.7, 60))
        points = foot + s[:, None] * n + 0.006 * rng.standard_normal((60, 3))
        parts.append(points)
        seen = se3.apply(T_lidar_target, points)
        index: IntArray = np.arange(start, start + 60)
        start += 60
        direction = T_lidar_target[:3, :3] @ n
        poles.append(Pole(seen.mean(axis=0), direction, seen, 1.6, 0.0061, 9, index))
    plate = np.array([10.9, 3.0, 0.4]) + rng.uniform(-1, 1, (40, 3)) * [0.01, 0.4, 0.3]
    rejected = RejectedCluster(
        np.arange(start, start + 40),
        se3.apply(T_lidar_target, plate).mean(axis=0),
        "too_wide",
        "0.81 m wide, a pole of radius 0.02 m is at most 0.12 m",
    )
    xyz = se3.apply(T_lidar_target, np.concatenate([*parts, plate]))
    intensity = np.r_[intensity, np.full(len(xyz) - len(intensity), 250.0)]
    detection = Detection(tuple(poles), (rejected,), 200.0, "auto", 160)
    return Scan(PointCloud(xyz, intensity), None, detection)


def half_turns() -> list[Array]:
    """Identity and the half turns about the common perpendicular and the bisectors."""
    (p, a), (q, b) = ((f + 0.8 * n, n / np.linalg.norm(n)) for f, n in FEET_AND_DIRECTIONS)
    poses = [np.eye(4)]
    for axis in (np.cross(a, b), a + b, a - b):
        R = se3.exp_so3(np.pi * axis / np.linalg.norm(axis))
        middle = (p + q) / 2
        poses.append(se3.from_rt(R, middle - R @ middle))
    return poses


def made_up_hypotheses(answered: bool) -> list[HypothesisDoc]:
    """Four, the chosen one first where there is an answer."""
    figures = [(0.81, 0.02, 0.79, 0.021, 0.031), (0.44, 0.16, 0.28, 0.61, 0.92)]
    figures += [(0.41, 0.22, 0.19, 1.32, 4.10), (0.28, 0.31, -0.03, 1.71, 7.45)]
    return [
        HypothesisDoc(
            pairs=[(0, 0), (1, 1)] if k in (0, 3) else [(0, 1), (1, 0)],
            T_target_source=pose @ T_TRUE,
            pole_rms_m=0.0142 + 0.0001 * k,
            exact=True,
            icp_rotation_rad=e_r,
            icp_translation_m=e_t,
            overlap=overlap,
            free_space_violation=violation,
            score=score,
            chosen=k == 0 and answered,
        )
        for k, (pose, (overlap, violation, score, e_r, e_t)) in enumerate(
            zip(half_turns(), figures, strict=True)
        )
    ]


HEIGHT = "height along the poles: 6.0 mm"


def made_up(status: Status = "ok", count: int = 4000) -> Run:
    """Make up a run of one placement."""
    placement = Placement(observed(np.eye(4), 1, count), observed(T_TRUE, 2, count))
    answered = status != "refused"
    T, covariance = T_TRUE, RANDOM + SYSTEMATIC
    from_poles = PoseEstimate(T, covariance, 0.0142)
    result = ResultDoc(
        status=status,
        reasons=REASONS[status],
        T_target_source=T if answered else None,
        covariance=covariance if answered else None,
        uncertainty=Uncertainty(RANDOM, SYSTEMATIC) if answered else None,
        budget=list(BUDGET) if answered else None,
        predicted_error=list(predicted_error(covariance)) if answered else None,
        weakest=WeakDirection(np.array([0.0, 0.0, 1.0]), 0.006, HEIGHT, 11.0) if answered else None,
        radius=RadiusEstimate(0.02, 0.0005, 0.02031, 0.00042) if answered else None,
        confirmation=Confirmation(agreeing=412, contradicting=3) if answered else None,
        stages=StagesDoc(
            from_poles if answered else None,
            replace(from_poles, rms=0.0098) if status == "ok" else None,
        ),
        hypotheses=made_up_hypotheses(answered),
        margin=0.51 if answered else 0.005,
        poles=PolesDoc(
            pole_documents(placement.target.poles), pole_documents(placement.source.poles)
        ),
        inputs=[
            InputDoc("/data/yard/front.pcd", 8 * "0f3a9c1e", count + 160, 0, "auto", 200.0),
            InputDoc("/data/yard/rear.pcd", 8 * "1f3a9c1e", count + 160, 17, "VLP-16", 200.0),
        ],
        config=RunConfig(),
        version="0.1.0",
        created="2025-05-05T12:00:00+00:00",
        seconds={"read": 0.21, "extract": 0.09, "match": 0.004, "disambiguate": 0.44},
    )
    return Run(result, (placement,))


def placement_of(cloud: PointCloud) -> Placement:
    """Make of a cloud a placement that both LiDARs saw so, and nobody searched for poles."""
    return Placement(Scan(cloud), Scan(cloud))


class Page(HTMLParser):
    """Tags with their attributes, and the text outside of scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.data = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, "every element is closed where it was opened"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script" and self.tags[-1][1].get("id") == "data":
            self.data += data
        elif not {"script", "style"} & set(self.open):
            self.text += data
