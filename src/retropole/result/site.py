"""The result document of a site: every LiDAR's pose in one frame, and what was checked, as JSON.

Schema ``retropole/site-result/1``: metres and radians, matrices row by row. LiDARs, placements and
poles are identified by their index in the lists of the document. What is no number is null, and so
is every pose where the run was refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..adjustment.answer import (
    MOST_LIDARS,
    Indices,
    LidarPose,
    SiteCalibration,
    SitePole,
    WithoutPlacement,
)
from ..base.bounded import (
    LONGEST_LIST,
    Count,
    Number,
    PartCovariance,
    Pose,
    Share,
    Size,
    Status,
    Text,
)
from ..base.carried import SiteWalk
from ..base.datatypes import Array, Scan
from ..base.description import ControlPoint, Frame, SiteLidar, SurveyedPole, Up
from ..base.uncertainty import BudgetEntry, ErrorAtRange
from ..base.uncertainty.purpose import Fitness, Need
from ..io.fields import Unit, Wanted
from ..io.recordings import MAX_POINTS
from . import (
    COVARIANCE_ORDER,
    DEFAULT_CONFIG,
    Document,
    InputDoc,
    PoleDoc,
    ReasonDoc,
    ResultDoc,
    SwayDoc,
    TestDoc,
    document_of,
    finite,
    made_now,
    pole_documents,
    reason_document,
    sway_documents,
    with_threshold,
)
from .contents import RejectedDoc, rejected_documents
from .options import Frames, MaxPoints, Reading, slice_of

SITE_SCHEMA: Literal["retropole/site-result/1"] = "retropole/site-result/1"
SITE_COVARIANCE_FRAME = "site axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"


class SiteConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How a site was read: the site file, and the options of the run.

    None means frames evenly spread; frames are start, stop and step. A pole that was carried
    has no fixed place.
    """

    site_file: Text = ""
    site_sha256: Text = ""
    frames: Frames | None = None
    max_points: MaxPoints = MAX_POINTS
    unit: Unit = "m"
    carried: bool = False


class LidarDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One LiDAR and its pose in the frame of the site; the pose is null if refused.

    `covariance` is over the document's `covariance_order`, in its `covariance_frame`; it is zero
    for the LiDAR whose frame is the site's.
    """

    name: Text
    sensor: Text
    serial: Text
    up: Up | None
    T_site_lidar: Pose | None = None
    covariance: PartCovariance | None = None
    budget: list[BudgetEntry] | None = None
    predicted_error: list[ErrorAtRange] | None = None
    fitness: Fitness | None = None

    def pose(self, lidar: int) -> LidarPose | None:
        """Its pose, where it is the LiDAR of this index; None if it has none."""
        if self.T_site_lidar is None or self.covariance is None:
            return None
        stated = tuple(self.budget or ()), tuple(self.predicted_error or ())
        return LidarPose(lidar, self.T_site_lidar, self.covariance, *stated, self.fitness)


class FoundDoc(msgspec.Struct, frozen=True, eq=False):
    """What was found in one recording, in its LiDAR's frame; `refusal` where it has no poles."""

    threshold: Number | None
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]
    refusal: ReasonDoc | None


class RecordingDoc(InputDoc, frozen=True, kw_only=True):
    """What was read of one LiDAR and placement, and how."""

    lidar: Count
    placement: Count
    topic: Text | None = None
    frames: Frames | None = None
    unit: Unit = "m"
    intensity: Text | None = None
    angles: Text | None = None

    def reading(self, max_points: int) -> Reading:
        """How it was read, with at most this many points of a cloud."""
        how = slice_of(self.frames), max_points, self.unit, Wanted(self.intensity, self.angles)
        return Reading(self.sensor, self.threshold, self.topic, *how)


class PairDoc(msgspec.Struct, frozen=True):
    """Two LiDARs, and how well they agree; `adjustment.answer.PairCheck`."""

    lidars: tuple[Count, Count]
    shared_poles: Count
    standing: Count
    patches: Count
    w: Number | None
    refusal: ReasonDoc | None


class LoopDoc(
    msgspec.Struct, frozen=True, rename={"rotation": "rotation_rad", "translation": "translation_m"}
):
    """What the pairwise poses around a loop fail to close by; `adjustment.answer.LoopClosure`."""

    lidars: Indices
    rotation: Size | None
    translation: Size | None
    chi2: Size | None
    freedom: Count
    probability: Share | None


class SiteDoc(Document, frozen=True, eq=False, kw_only=True):
    """The whole document.

    `joint_covariance` is that of all poses together: 6 rows for each, in the order of
    `lidars`, named by `joint_order`, in the `covariance_frame`.
    """

    schema: Literal["retropole/site-result/1"] = SITE_SCHEMA
    name: Text
    status: Status
    reasons: list[ReasonDoc]
    notes: list[ReasonDoc] = msgspec.field(default_factory=list)
    datum: Text
    frame: Frame
    reference: Count
    placements: Annotated[list[Text], Meta(min_length=1, max_length=LONGEST_LIST)]
    radius_m: Size
    radius_sigma_m: Size
    need: Need | None
    lidars: Annotated[list[LidarDoc], Meta(min_length=1, max_length=MOST_LIDARS)]
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = SITE_COVARIANCE_FRAME
    joint_order: list[Text]
    joint_covariance: Array | None
    groups: list[Indices]
    poles: Annotated[list[SitePole], Meta(max_length=LONGEST_LIST)]
    pairs: Annotated[list[PairDoc], Meta(max_length=LONGEST_LIST)]
    loops: Annotated[list[LoopDoc], Meta(max_length=LONGEST_LIST)]
    tests: Annotated[list[TestDoc], Meta(max_length=LONGEST_LIST)]
    without: Annotated[list[WithoutPlacement], Meta(max_length=LONGEST_LIST)]
    found: list[list[FoundDoc | None]]
    surveyed_poles: list[SurveyedPole]
    control_points: list[ControlPoint]
    sways: Annotated[list[SwayDoc], Meta(max_length=LONGEST_LIST)] = msgspec.field(
        default_factory=list
    )
    walk: SiteWalk | None = None
    inputs: Annotated[list[RecordingDoc], Meta(max_length=LONGEST_LIST)]
    config: SiteConfig
    version: Text
    created: Text
    seconds: dict[Text, Size]


LIDARS = ("target", "source")
"""The two LiDARs of a pair, in their order."""

NO_SITE: dict[str, Any] = {
    **{name: [] for name in ("joint_order", "groups", "poles", "pairs", "loops")},
    **{name: [] for name in ("surveyed_poles", "control_points")},
    **{"need": None, "joint_covariance": None},
    **{"schema": SITE_SCHEMA, "datum": "", "reference": 0},
}
"""What two LiDARs have nothing of."""


def as_site(document: ResultDoc | SiteDoc) -> SiteDoc:
    """Convert a pair to a site of two LiDARs in the frame of the target; a site is unchanged."""
    if isinstance(document, SiteDoc):
        return document
    names, T, config = input_names(document), document.T_target_source, document.config
    count = max((len(names) + 1) // 2, len(document.placements), 1)
    listed = document.poles.target, document.poles.source
    sensors = [*(item.sensor for item in document.inputs), "auto", "auto"]
    about = [SiteLidar(name, ()) for name in LIDARS]
    at_origin = {"T_site_lidar": None if T is None else np.eye(4), "covariance": np.zeros((6, 6))}
    reads = config.of_target, config.of_source
    return document_of(
        SiteDoc,
        document,
        **NO_SITE,
        name=" ← ".join(names[:2] if len(names) >= 2 else LIDARS),
        frame=Frame("LiDAR target"),
        placements=[" ← ".join(names[2 * j : 2 * j + 2]) for j in range(count)],
        radius_m=config.radius_m,
        radius_sigma_m=0.0 if document.radius is None else document.radius.sigma,
        lidars=[
            document_of(LidarDoc, about[0], sensor=sensors[0], **at_origin),
            document_of(LidarDoc, about[1], document, sensor=sensors[1], T_site_lidar=T),
        ],
        without=[
            WithoutPlacement(j, each.left_out_rotation_rad, each.left_out_translation_m, 1)
            for j, each in enumerate(document.placements)
            if len(document.placements) > 1
        ],
        # The document lists the poles of the first placement alone.
        found=[[FoundDoc(None, poles, [], None), *[None] * (count - 1)] for poles in listed],
        inputs=[
            recording_document(item, k % 2, k // 2, reads[k % 2])
            for k, item in enumerate(document.inputs)
        ],
        walk=None if document.walk is None else document.walk.of_site,
        config=SiteConfig(max_points=config.max_points, carried=config.carried),
    )


def input_names(result: ResultDoc) -> list[str]:
    """Name the inputs by their files, and by their topics where they are in bags."""
    topics = (result.config.target_topic, result.config.source_topic)
    return [
        " ".join([Path(item.path).name, topics[k % 2] or ""]).strip()
        for k, item in enumerate(result.inputs)
    ]


def joint_order(names: Sequence[str]) -> list[str]:
    """Name the rows of the joint covariance: ``mast-a.phi_x`` to ``mast-b.delta_z``."""
    return [f"{name}.{state}" for name in names for state in COVARIANCE_ORDER]


def site_document(
    calibration: SiteCalibration,
    *,
    inputs: Sequence[RecordingDoc],
    config: SiteConfig,
    seconds: Mapping[str, float],
) -> SiteDoc:
    """Write a site's calibration as its result document.

    Parameters
    ----------
    calibration
        The answer, or the refusal.
    inputs
        What was read, LiDAR by LiDAR.
    config
        How it was read.
    seconds
        Time of each step, reading included.

    Raises
    ------
    ValueError
        If a pose or a covariance of an answer is not finite.
    """
    site = calibration.site
    answered = calibration.status != "refused"
    names = [lidar.name for lidar in site.lidars]
    poses = calibration.lidars if answered else (None,) * len(names)
    joint = calibration.covariance if answered else None
    if joint is not None and not np.isfinite(joint).all():
        raise ValueError("joint covariance: a number of the answer is not finite")
    scans = calibration.scans
    return document_of(
        SiteDoc,
        made_now(seconds),
        calibration,
        site,
        radius_m=site.radius,
        radius_sigma_m=site.radius_sigma,
        lidars=[lidar_document(*each) for each in zip(site.lidars, poses, strict=True)],
        joint_order=joint_order(names),
        joint_covariance=joint,
        pairs=[document_of(PairDoc, pair) for pair in calibration.pairs],
        loops=[document_of(LoopDoc, loop) for loop in calibration.loops],
        tests=[document_of(TestDoc, test) for test in calibration.tests],
        found=[[found_document(scan) for scan in of_lidar] for of_lidar in scans],
        sways=sway_documents(scans),
        surveyed_poles=list(site.poles),
        control_points=list(site.points),
        # A run that was refused early has looked at no scan.
        inputs=[
            with_threshold(each, scans[each.lidar][each.placement] if scans else None)
            for each in inputs
        ],
        config=config,
    )


def lidar_document(lidar: SiteLidar, pose: LidarPose | None) -> LidarDoc:
    """Write a LiDAR and its pose; None if it has none.

    Raises
    ------
    ValueError
        If the pose is not finite: that is no answer.
    """
    if pose and not (np.isfinite(pose.T_site_lidar).all() and np.isfinite(pose.covariance).all()):
        raise ValueError(f"{lidar.name}: a number of the answer is not finite")
    sensor = "auto" if lidar.sensor is None else lidar.sensor.name
    return document_of(LidarDoc, lidar, pose, sensor=sensor)


def found_document(scan: Scan | None) -> FoundDoc | None:
    """Write what was found in a recording; None if there is none."""
    if scan is None:
        return None
    return FoundDoc(
        None if scan.detection is None else finite(scan.detection.threshold),
        pole_documents(scan.poles),
        rejected_documents(() if scan.detection is None else scan.detection.rejected),
        None if scan.refusal is None else reason_document(scan.refusal),
    )


def recording_document(
    source: InputDoc, lidar: int, placement: int, how: Reading = DEFAULT_CONFIG.of_target
) -> RecordingDoc:
    """Describe a recording that was read, with its LiDAR and placement by their indices."""
    frames = None if how.frames is None else (how.frames.start, how.frames.stop, how.frames.step)
    at = {"lidar": lidar, "placement": placement}
    read = {"topic": how.topic, "frames": frames, "unit": how.unit}
    return document_of(RecordingDoc, source, how.wanted, **at, **read)
