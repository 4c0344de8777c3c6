"""What the steps hand to each other: frozen data classes over arrays.

Frames: every cloud, pole and ray is in the frame of its own LiDAR unless a name says otherwise.
Units: metres, radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import se3

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one LiDAR in its own frame.

    Attributes
    ----------
    xyz
        (N, 3) float64, metres. Finite, and none at zero range: readers drop and count those.
    intensity
        (N,) float64 on the sensor's own scale, or None where the file has none.
    ring
        (N,) int64 beam index, or None.
    time
        (N,) float64 seconds, or None.
    frame
        (N,) int64 index of the sweep that the point came from, or None for a single sweep.
    origin
        (3,) where the beams start, in the same frame as `xyz`.
    dropped
        How many points the reader dropped (not finite, or at zero range).
    source, fields
        The file or folder it came from, and what that calls its values, with their types.
    """

    xyz: Array
    intensity: Array | None = None
    ring: IntArray | None = None
    time: Array | None = None
    frame: IntArray | None = None
    origin: Array = field(default_factory=lambda: np.zeros(3))
    dropped: int = 0
    source: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all arrays are as long as `xyz`."""
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise ValueError(f"xyz must be (N, 3), is {self.xyz.shape}")
        for name in ("intensity", "ring", "time", "frame"):
            value = getattr(self, name)
            if value is not None and value.shape != (len(self.xyz),):
                raise ValueError(f"{name} must be ({len(self.xyz)},), is {value.shape}")

    def __len__(self) -> int:
        """Count the points."""
        return len(self.xyz)

    def select(self, index: BoolArray | IntArray) -> PointCloud:
        """Keep the points of a mask or index array (points, not `dropped`, are re-counted)."""
        return replace(
            self,
            xyz=self.xyz[index],
            intensity=None if self.intensity is None else self.intensity[index],
            ring=None if self.ring is None else self.ring[index],
            time=None if self.time is None else self.time[index],
            frame=None if self.frame is None else self.frame[index],
        )

    def transformed(self, T_new_old: Array) -> PointCloud:
        """Express the cloud, its beam origin included, in another frame."""
        return replace(
            self,
            xyz=se3.apply(T_new_old, self.xyz),
            origin=se3.apply(T_new_old, self.origin[None])[0],
        )


@dataclass(frozen=True, eq=False)
class Pole:
    """One pole seen by one LiDAR: a line, and the points on it (M2).

    Attributes
    ----------
    point
        (3,) a point on the fitted line: the centroid of `xyz`.
    direction
        (3,) unit vector; its sign means nothing.
    xyz
        (N, 3) the returns on the pole. They lie on its surface, facing the sensor, so the line
        fitted to them runs about π r/4 in front of the axis (M6).
    length
        Extent of the points along the line, metres.
    rms
        Root mean square distance of the points from the line, metres.
    rings
        How many beams (rings) hit it.
    index
        (N,) index of the points in their cloud.
    """

    point: Array
    direction: Array
    xyz: Array
    length: float
    rms: float
    rings: int
    index: IntArray


@dataclass(frozen=True, eq=False)
class RejectedCluster:
    """A retro-reflective cluster that is not a pole, and why.

    Attributes
    ----------
    index
        (N,) index of its points in their cloud.
    centre
        (3,) centroid, metres.
    code
        Stable reason: ``too_few_points``, ``too_few_rings``, ``too_short``, ``too_wide``, …
    reason
        The same in words and numbers.
    """

    index: IntArray
    centre: Array
    code: str
    reason: str


@dataclass(frozen=True, eq=False)
class Detection:
    """All that `extraction.extract_poles` found in one cloud.

    Attributes
    ----------
    poles
        Accepted poles, the best supported first.
    rejected
        Every other cluster, each with its reason.
    threshold
        Intensity from which a return counts as retro-reflective, on the sensor's own scale.
    threshold_source
        Where the threshold comes from: ``given``, ``sensor VLP-16``, ``auto``.
    retro_points
        How many points passed the threshold.
    """

    poles: tuple[Pole, ...]
    rejected: tuple[RejectedCluster, ...]
    threshold: float
    threshold_source: str
    retro_points: int


@dataclass(frozen=True, eq=False)
class Match:
    """One way of laying the source poles on the target poles (M4).

    Attributes
    ----------
    pairs
        ``((i, j), …)``: target pole ``i`` is source pole ``j``.
    T_target_source
        (4, 4) least-squares pose under these pairs (eq. 1–2).
    pole_rms
        Root mean square distance of source points from target lines, metres.
    exact
        Whether the lines themselves fit: one of the four of the Klein group, or a match of three
        or more poles.
    information
        (6, 6) Gauss–Newton matrix over ``[φ, δ]``, target axes, per unit variance.
    """

    pairs: tuple[tuple[int, int], ...]
    T_target_source: Array
    pole_rms: float
    exact: bool
    information: Array


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A match of the poles, and what the scene says of it (M5).

    Attributes
    ----------
    match
        The pairs of poles and the pose they give.
    icp_rotation, icp_translation
        The paper's e_r, rad, and e_t, m: how far ICP moves from here; None where too few points
        lie near the target for ICP to say anything.
    overlap
        Share of the points with a neighbour in the other cloud, 0 to 1.
    free_space
        Share of the points that stand where the other LiDAR looked through, 0 to 1.
    score
        What the hypotheses are ranked by, larger is better.
    """

    match: Match
    icp_rotation: float | None
    icp_translation: float | None
    overlap: float
    free_space: float
    score: float


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose and how sure it is.

    Attributes
    ----------
    T_target_source
        (4, 4) pose.
    covariance
        (6, 6) over ``[φ_x φ_y φ_z δ_x δ_y δ_z]``, rad and m, target axes; None where not known.
    rms
        Root mean square residual of the stage, metres.
    """

    T_target_source: Array
    covariance: Array | None
    rms: float


@dataclass(frozen=True, eq=False)
class Placement:
    """One placement of the poles: what both LiDARs recorded, and what was found in it.

    Attributes
    ----------
    target, source
        The clouds that were used: of several frames, without what moved.
    found
        The detection in the target and in the source, as far as it came to that.
    left_out
        How far the poles' pose lies from that without this placement, rad and m; None where it is
        the only one, or where the rest gives no pose.
    """

    target: PointCloud
    source: PointCloud
    found: tuple[Detection | None, Detection | None] = (None, None)
    left_out: tuple[float, float] | None = None

    @property
    def target_poles(self) -> tuple[Pole, ...]:
        """Poles found in the target."""
        return self.found[0].poles if self.found[0] else ()

    @property
    def source_poles(self) -> tuple[Pole, ...]:
        """Poles found in the source."""
        return self.found[1].poles if self.found[1] else ()

    def with_detection(self, side: int, detection: Detection) -> Placement:
        """Add what was found in the target (side 0) or the source (1)."""
        found = (detection, self.found[1]) if side == 0 else (self.found[0], detection)
        return replace(self, found=found)

    def with_left_out(self, apart: tuple[float, float]) -> Placement:
        """Add how far the pose lies from that without this placement."""
        return replace(self, left_out=apart)


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """The direction in which a pose is least sure, at the poles.

    Attributes
    ----------
    direction
        (3,) unit vector, target axes.
    sigma
        1 σ of where the poles lie along it, metres.
    words
        The direction, and how far it may be off, for a person.
    condition
        Ratio of the largest to the least 1 σ of the six directions of the pose, in metres at the
        poles (a turn counts by how far it moves what is 10 m away).
    """

    direction: Array
    sigma: float
    words: str
    condition: float


@dataclass(frozen=True, eq=False)
class Reason:
    """Why a verdict is not a plain ok: a stable code, words with numbers, and the numbers."""

    code: str
    message: str
    values: Mapping[str, float | int | str]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The answer of `pipeline.calibrate`, or why there is none.

    Attributes
    ----------
    status
        ``ok``, ``warn`` or ``refused``.
    reasons
        What is wrong or weak; empty when ok.
    T_target_source
        (4, 4) maps source points into the target frame; None when refused.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, target axes; None when refused.
    poles, refined
        The pose from the poles alone, and with the scene; None where a stage was not reached.
    hypotheses
        All ways of laying the poles on each other, the chosen one first.
    margin
        Score of the first hypothesis over the second; None where there is no second.
    predicted_error
        (range, 1 σ error of a point at that range), metres; empty when refused.
    weakest
        The direction in which the pose is least sure; None when refused.
    placements
        What was recorded and found, one for each placement of the poles.
    seconds
        Time of each step.
    """

    status: Literal["ok", "warn", "refused"]
    reasons: tuple[Reason, ...]
    T_target_source: Array | None
    covariance: Array | None
    poles: PoseEstimate | None
    refined: PoseEstimate | None
    hypotheses: tuple[Hypothesis, ...]
    margin: float | None
    predicted_error: tuple[tuple[float, float], ...]
    weakest: WeakDirection | None
    placements: tuple[Placement, ...]
    seconds: Mapping[str, float]

    @property
    def detections(self) -> tuple[Detection | None, Detection | None]:
        """What was found in the target and in the source of the first placement."""
        return self.placements[0].found if self.placements else (None, None)
