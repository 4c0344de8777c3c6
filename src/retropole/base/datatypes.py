"""Data passed between the steps: frozen data classes over arrays, in metres and radians.

Every cloud, pole and ray is in the frame of its LiDAR unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Literal, TypeVar, cast
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
from numpy.typing import NDArray

from . import se3
from .bounded import Covariance, Pose, Size, Status
from .carried import CarriedWalk
from .errors import Reason, Refusal
from .reasons import Code
from .se3 import PoseDifference
from .sensors import Sensor
from .systematic import MAP_SIGMA, Sway
from .uncertainty import ErrorAtRange, RadiusEstimate, Uncertainty, WeakDirection
from .uncertainty.confirmation import Confirmation
from .uncertainty.purpose import Fitness

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

DEFAULT_RADIUS = 0.02
"""Default radius of the taped poles, metres (Xue et al. 2019)."""

MIN_RADIUS, MAX_RADIUS = 0.002, 0.25
"""Smallest and largest radius of taped poles, metres: a wire and a bollard."""

MAX_POLES = 50
"""More are not simulated."""

PER_POINT = ("intensity", "ring", "time", "frame")
"""Fields of a cloud that have one value per point, or are None."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one LiDAR in its frame, or of a map.

    Attributes
    ----------
    xyz
        (N, 3) float64, metres; finite, and none at zero range.
    intensity
        (N,) float64 on the scale of the sensor, or None if the file has none.
    ring, time, frame
        (N,) int64 index of the ring (laser channel), float64 seconds, and int64 index of the sweep
        that the point came from; or None.
    origin, axis
        (3,) origin of the beams, and the unit vector about which they rotate; for a map the
        position of interest, and the vertical.
    recorded
        First and last time by the recorder's clock, Unix seconds; None if the file has none.
    dropped, thinned, source, fields, notes
        Number of points that were dropped (not finite, at zero range), and that were left out of
        too many; the file; the names of its values, with their types; in words what was lost.
    model, nominal_angles
        Of the LiDAR, if its packets contain it: the name in ``sensors.toml``, else maker and model.
        And the model whose angles were used for the points, if those of the unit are not known.
    is_map
        Whether the points were seen from many positions: free space is then not known.
    map_sigma
        1 σ of positions in such a map relative to each other, metres.
    """

    xyz: Array
    intensity: Array | None = None
    ring: IntArray | None = None
    time: Array | None = None
    frame: IntArray | None = None
    origin: Array = field(default_factory=lambda: np.zeros(3))
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    recorded: tuple[float, float] | None = None
    dropped: int = 0
    thinned: int = 0
    source: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    model: str = ""
    nominal_angles: str = ""
    is_map: bool = False
    map_sigma: float = MAP_SIGMA

    def __post_init__(self) -> None:
        """Check that all arrays are as long as `xyz`."""
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise ValueError(f"xyz must be (N, 3), is {self.xyz.shape}")
        for name in PER_POINT:
            value = getattr(self, name)
            if value is not None and value.shape != (len(self.xyz),):
                raise ValueError(f"{name} must be ({len(self.xyz)},), is {value.shape}")

    def __len__(self) -> int:  # noqa: D105
        return len(self.xyz)

    def select(self, index: BoolArray | IntArray) -> PointCloud:
        """Keep the points of a mask or index array (points, not `dropped`, are re-counted)."""
        rows = np.flatnonzero(index) if index.dtype == bool else index
        columns = {name: getattr(self, name) for name in ("xyz", *PER_POINT)}
        return replace(
            self, **{k: v.take(rows, axis=0) for k, v in columns.items() if v is not None}
        )

    def transformed(self, T_new_old: Array) -> PointCloud:
        """Express the cloud, its beam origin and axis included, in another frame."""
        return replace(
            self,
            xyz=se3.apply(T_new_old, self.xyz),
            origin=se3.apply(T_new_old, self.origin[None])[0],
            axis=T_new_old[:3, :3] @ self.axis,
        )


Made = TypeVar("Made")


def kept(make: Callable[[PointCloud], Made]) -> Callable[[PointCloud], Made]:
    """Compute a value from a cloud once, and keep it as long as the cloud is in use: every step
    needs it.

    It may be the cloud itself, and must not refer to it otherwise: the cloud would never be freed.
    """
    made: WeakKeyDictionary[PointCloud, tuple[Made, ...]] = WeakKeyDictionary()

    @wraps(make)
    def given(cloud: PointCloud) -> Made:
        if cloud not in made:
            found = make(cloud)
            made[cloud] = () if found is cloud else (found,)
        return made[cloud][0] if made[cloud] else cast(Made, cloud)

    return given


@dataclass(frozen=True, eq=False)
class Pole:
    """One pole seen by one LiDAR: a line, and the points on it.

    Attributes
    ----------
    point, direction
        (3,) a point on the fitted line, the centroid of `xyz`; and a unit vector of any sign.
    xyz
        (N, 3) the returns on the pole. They lie on its surface, facing the sensor, so that the line
        fitted to them runs in front of the axis (docs/method.md, A line is not the axis).
    length, rms
        Extent of the points along the line, and their root mean square distance from it, metres.
    rings
        How many rings of the LiDAR hit it.
    index
        (N,) index of the points in their cloud.
    to_axis
        (3,) from the line to where that of a pole of `DEFAULT_RADIUS` about the same axis would
        be, metres: of a thicker one, the line runs farther in front.
    log_odds
        That it is a pole and not another bright object; infinite if it is given.
    """

    point: Array
    direction: Array
    xyz: Array
    length: float
    rms: float
    rings: int
    index: IntArray
    to_axis: Array = field(default_factory=lambda: np.zeros(3))
    log_odds: float = np.inf

    @property
    def inner_point(self) -> Array:
        """(3,) the point of the line, moved by `to_axis`."""
        return np.asarray(self.point + self.to_axis)


@dataclass(frozen=True, eq=False)
class RejectedCluster:
    """A retro-reflective cluster that is not a pole, and why.

    Attributes
    ----------
    index, centre
        (N,) index of its points in their cloud, and (3,) their centroid, metres.
    code, reason
        One of `reasons.Code`, such as ``too_few_points``; the same in words and numbers.
    """

    index: IntArray
    centre: Array
    code: Code
    reason: str


@dataclass(frozen=True, eq=False)
class Detection:
    """All that `extraction.poles.extract_poles` found in one cloud.

    Attributes
    ----------
    poles, rejected
        Accepted poles, the best supported first; every other cluster, each with its reason.
    threshold, threshold_source, retro_points
        Intensity from which a return is treated as retro-reflective, on the scale of the sensor;
        where it comes from: ``given``, ``VLP-16``, ``auto: …``; and how many points passed it.
    candidates
        Lines that may be poles; their points are among the rejected.
    threshold_least
        To what the threshold falls with the range; None if it applies at any range.
    """

    poles: tuple[Pole, ...]
    rejected: tuple[RejectedCluster, ...]
    threshold: float
    threshold_source: str
    retro_points: int
    candidates: tuple[Pole, ...] = ()
    threshold_least: float | None = None


@dataclass(frozen=True, eq=False)
class Match:
    """One way of matching the source poles with the target poles (Xue et al. 2019, Fig. 4).

    Attributes
    ----------
    pairs
        ``((i, j), …)``: target pole ``i`` is source pole ``j``.
    T_target_source
        (4, 4) least-squares pose under these pairs (eq. 1–2), unless `icp_refined`.
    pole_rms
        Root mean square distance of source points from target lines at that minimum, metres.
    exact, converged, icp_refined, by_place
        Whether the lines fit, one of the Klein group's four, or more; the solver converged; the
        scenes coincide; and they determine what one pole, or parallel ones, do not.
    information
        (6, 6) Gauss–Newton matrix over ``[φ, δ]``, target axes, per unit variance.
    """

    pairs: tuple[tuple[int, int], ...]
    T_target_source: Array
    pole_rms: float
    exact: bool
    converged: bool
    information: Array
    icp_refined: bool = False
    by_place: bool = False


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose of one LiDAR relative to another, and the evidence for it (Xue et al. 2019, Tab. III).

    Attributes
    ----------
    match
        The pairs of poles and their pose.
    icp_rotation, icp_translation
        The paper's e_r, rad, and e_t, m: the movement by ICP; None with too few points for ICP.
    overlap, covisible_overlap
        Share of all points, and of those that both could see, with a neighbour in the other cloud.
    free_space_violation
        Share of the points in space that the other LiDAR saw to be empty, 0 to 1.
    score
        Overlap less free-space violation; the hypotheses are ranked by it.
    stands
        Whether it is the best, or the scene does not rule it out against the best.
    possible
        Whether it is not ruled out, or scores little less than the best: on bare ground a pose that
        brings the LiDARs near each other overlaps twice as much as the right one. Of a site.
    poles
        From the index of each placement that allows it to the number of poles that agree there. Of
        a site.
    """

    match: Match
    icp_rotation: float | None
    icp_translation: float | None
    overlap: float
    free_space_violation: float
    score: float
    covisible_overlap: float | None = None
    stands: bool = False
    possible: bool = False
    poles: Mapping[int, int] = field(default_factory=dict)

    @property
    def T(self) -> Array:
        """(4, 4) maps points of the source, or of the second LiDAR, to those of the other."""
        return self.match.T_target_source

    @property
    def evidence(self) -> int:
        """Evidence from the poles of all placements: for each, one less than the number that
        agrees.

        Two poles of one placement allow several poses, one of which is right; every further pole
        that agrees with a wrong one does so by chance.
        """
        return sum(self.poles.values()) - len(self.poles)


class PoseEstimate(msgspec.Struct, frozen=True, eq=False, rename={"rms": "rms_m"}):
    """A pose and its covariance.

    Attributes
    ----------
    T_target_source
        (4, 4) pose.
    covariance
        (6, 6) over ``[φ_x φ_y φ_z δ_x δ_y δ_z]``, rad and m, target axes; None if not known.
    rms
        Root mean square residual of the observations, metres.
    """

    T_target_source: Pose
    covariance: Covariance | None
    rms: Size


@dataclass(frozen=True, eq=False)
class Scan:
    """The recording of one placement of the poles by one LiDAR, and the poles found in it.

    Attributes
    ----------
    cloud, sensor
        The cloud that was used, of several frames without dynamic points; what recorded it or None.
    detection, refusal, sway, motion
        What was found; why it cannot be searched for poles; how the LiDAR swayed, and (B, 6) turn
        and shift that were removed from the parts of the cloud (`surfaces.sway`); each or None.
    """

    cloud: PointCloud
    sensor: Sensor | None = None
    detection: Detection | None = None
    refusal: Refusal | None = None
    sway: Sway | None = None
    motion: Array | None = None

    @property
    def poles(self) -> tuple[Pole, ...]:
        """Poles found in it."""
        return self.detection.poles if self.detection else ()

    @property
    def candidates(self) -> tuple[Pole, ...]:
        """Those found in it that are doubtful by themselves."""
        return self.detection.candidates if self.detection else ()


@dataclass(frozen=True, eq=False)
class Placement:
    """One placement of the poles, as both LiDARs recorded it.

    Attributes
    ----------
    target, source, left_out
        What each LiDAR recorded; and the difference between the pose from the poles with and
        without it, None if the others give none.
    """

    target: Scan
    source: Scan
    left_out: PoseDifference | None = None

    @property
    def scans(self) -> tuple[Scan, Scan]:
        """Those of the target and of the source."""
        return self.target, self.source


Kind = Literal[
    "pole", "placement", "lidar", "survey", "control point", "up", "surfaces", "radius", "scale"
]
"""What a test is about."""


@dataclass(frozen=True, eq=False)
class Test:
    """One observation, or what several have in common, tested against all others.

    Attributes
    ----------
    kind
        The possible error: ``pole`` (another position for one LiDAR than for the others),
        ``placement`` (a LiDAR's recording of one), ``lidar``, ``survey`` (a surveyed end of a
        pole), ``control point``, ``up``; of a pair also ``surfaces`` (the pose that they and the
        poles have together, against that of the poles alone), ``radius`` and ``scale``.
    name
        In words: ``pole 2 of placement 1 as mast-a sees it``.
    lidar, placement, pole
        Indices in the site, and in `SiteCalibration.poles`; None if it is about none. Those of a
        pair are 0 for the target and 1 for the source.
    chi2, freedom
        By how much the fit improves without it, χ² with this many degrees of freedom.
    w
        The same as a standard normal number: Baarda's w with one degree of freedom.
    redundancy
        Share of it that the others check, 0 to 1: at 0 an error would not be detected.
    minimal_detectable
        Least error that is found with a probability of 80 %, metres; None if none is.
    external
        By how much an error of that size would move a point 30 m away, metres; None likewise.
    allowed
        The largest w to expect without an error.
    """

    kind: Kind
    name: str
    lidar: int | None
    placement: int | None
    pole: int | None
    chi2: float
    freedom: int
    w: float
    redundancy: float
    minimal_detectable: float | None
    external: float | None
    allowed: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """The answer of `pipeline.calibrate`, or why there is none.

    Attributes
    ----------
    status, reasons, notes
        ``ok``, ``warn`` or ``refused``; errors or doubts, empty when ok; and notes.
    T_target_source, covariance
        (4, 4) maps source points into the target frame, and (6, 6) over ``[φ, δ]``, rad and m,
        target axes; None when refused.
    poles, refined
        The pose from the poles alone, and with the scene; None if it was not computed.
    hypotheses, chosen, margin
        All ways of matching the poles, the best first; the position of the chosen one, 0
        when refused; and its score, or the best, minus the best other, None without another.
    vertical
        (3,) the ground's normal, target axes; None if not found, or if only one was placed.
    predicted_error, weakest, uncertainty, radius
        At several ranges; the direction in which it is least certain; the two parts of
        `covariance`, with the budget; the poles' radius; empty and None when refused.
    placements, seconds
        What was recorded and found, one for each placement of the poles; and the time of each step.
    confirmation, fitness
        What the scene shows about the pose, and whether it is as accurate as required; or None.
    walk
        Of a pole that was carried: the walk, and the clocks of both LiDARs; else None.
    tests
        Of every observation against all others; empty when refused, and without poles.
    """

    status: Status
    reasons: tuple[Reason, ...]
    T_target_source: Array | None = None
    covariance: Array | None = None
    poles: PoseEstimate | None = None
    refined: PoseEstimate | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    margin: float | None = None
    predicted_error: tuple[ErrorAtRange, ...] = ()
    weakest: WeakDirection | None = None
    placements: tuple[Placement, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    uncertainty: Uncertainty | None = None
    radius: RadiusEstimate | None = None
    confirmation: Confirmation | None = None
    fitness: Fitness | None = None
    chosen: int = 0
    vertical: Array | None = None
    notes: tuple[Reason, ...] = ()
    walk: CarriedWalk | None = None
    tests: tuple[Test, ...] = ()


Rows = TypeVar("Rows", bound=np.ndarray)


def every_nth(rows: Rows, most: int) -> Rows:
    """Take every n-th row of an array, so that no more than a number of them are left."""
    return rows[:: 1 + max(len(rows) - 1, 0) // most]  # type: ignore[return-value]
