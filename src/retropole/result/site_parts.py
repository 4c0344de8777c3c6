"""The parts of a site's result document, and how each is written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from ..base.datatypes import Array, Scan
from ..base.errors import Reason, Refusal
from ..io.thinning import MAX_POINTS
from ..io.units import Unit
from ..site.answer import LidarPose, SitePole
from ..site.description import ControlPoint, Frame, SiteLidar, SurveyedPole
from . import ReasonDoc
from .bounded import Count, Covariance, Number, Pose, Size, Text, Vector
from .certainty import (
    BudgetEntryDoc,
    ErrorAtRange,
    FitnessDoc,
    Matrix,
    budget_entries,
    budget_of,
    fitness_document,
    fitness_of,
    matrix_rows,
)
from .detected import InputDoc, PoleDoc, RejectedDoc, pole_documents, rejected_documents
from .options import Frames, MaxPoints

MOST_LIDARS = 100
"""Of one document: its joint covariance has then 360,000 numbers."""

Indices = Annotated[list[Count], Meta(max_length=MOST_LIDARS)]


class SiteConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How a site was read: the site file, and the options of the run.

    None stands for frames evenly spread; frames are start, stop and step.
    """

    site_file: Text = ""
    site_sha256: Text = ""
    frames: Frames | None = None
    max_points: MaxPoints = MAX_POINTS
    unit: Unit = "m"


class GeodeticDoc(msgspec.Struct, frozen=True):
    """Origin of a local east-north-up frame; the height is ellipsoidal."""

    latitude_rad: Number
    longitude_rad: Number
    height_m: Number


class FrameDoc(msgspec.Struct, frozen=True):
    """The frame of the site: its own coordinates are those of this document plus `offset_m`."""

    name: Text
    surveyed: bool
    offset_m: Vector
    epsg: Count | None
    geodetic: GeodeticDoc | None


class UpDoc(msgspec.Struct, frozen=True):
    """Which way is up in a LiDAR's frame, and 1 sigma of it about each level axis."""

    direction: Vector
    sigma_rad: Size


class LidarDoc(msgspec.Struct, frozen=True, kw_only=True):
    """One LiDAR and its pose in the frame of the site; the pose is null where refused.

    `covariance` is over the document's `covariance_order`, in its `covariance_frame`; it is zero
    for the LiDAR whose frame is the site's.
    """

    name: Text
    sensor: Text
    serial: Text
    up: UpDoc | None
    T_site_lidar: Pose | None = None
    covariance: Covariance | None = None
    budget: list[BudgetEntryDoc] | None = None
    predicted_error: list[ErrorAtRange] | None = None
    fitness: FitnessDoc | None = None


class FoundDoc(msgspec.Struct, frozen=True):
    """What was found in one recording, in its LiDAR's frame; `refusal` where it has no poles."""

    threshold: Number | None
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]
    refusal: ReasonDoc | None


class RecordingDoc(InputDoc, frozen=True, kw_only=True):
    """What was read of one LiDAR and placement."""

    lidar: Count
    placement: Count


class SurveyedPoleDoc(msgspec.Struct, frozen=True):
    """A pole with surveyed ends on its axis, frame of the site; 1 sigma of each coordinate."""

    name: Text
    placement: Count
    foot_m: Vector | None
    top_m: Vector | None
    sigma_m: Size


class SightingDoc(msgspec.Struct, frozen=True):
    """Where a LiDAR sees a control point, in its own frame."""

    lidar: Count
    at_m: Vector
    sigma_m: Size


class ControlPointDoc(msgspec.Struct, frozen=True):
    """A surveyed point that LiDARs see, frame of the site."""

    name: Text
    at_m: Vector
    sigma_m: Size
    seen: list[SightingDoc]


class SitePoleDoc(msgspec.Struct, frozen=True):
    """A pole as all LiDARs together have it: the middle of its tape, frame of the site."""

    name: Text
    placement: Count
    point_m: Vector
    direction: Vector
    length_m: Size
    seen_by: Indices
    surveyed: Count | None


class NeedDoc(msgspec.Struct, frozen=True):
    """How accurate every pose had to be."""

    within_m: Size
    at_m: Size


def finite_rows(matrix: Array, what: str) -> Matrix:
    """Write a matrix row by row.

    Raises
    ------
    ValueError
        Where it is not finite: that is no answer.
    """
    if not np.isfinite(matrix).all():
        raise ValueError(f"{what}: a number of the answer is not finite")
    return matrix_rows(matrix)


def finite(value: float | None) -> float | None:
    """Write a number that may be none: what is not finite is null."""
    return None if value is None or not math.isfinite(value) else float(value)


def reason_document(reason: Reason | Refusal) -> ReasonDoc:
    """Write a reason; of its values, what is not finite becomes text."""
    values = {
        name: value if isinstance(value, str) or math.isfinite(value) else str(value)
        for name, value in reason.values.items()
    }
    return ReasonDoc(reason.code, reason.message, values)


def frame_document(frame: Frame) -> FrameDoc:
    """Write the frame of the site."""
    geodetic = None if frame.geodetic is None else GeodeticDoc(*map(float, frame.geodetic))
    return FrameDoc(frame.name, frame.surveyed, _vector(frame.offset), frame.epsg, geodetic)


def lidar_document(lidar: SiteLidar, pose: LidarPose | None) -> LidarDoc:
    """Write a LiDAR and its pose; None where it has none."""
    said = LidarDoc(
        name=lidar.name,
        sensor="auto" if lidar.sensor is None else lidar.sensor.name,
        serial=lidar.serial,
        up=None if lidar.up is None else UpDoc(_vector(lidar.up.direction), lidar.up.sigma),
    )
    if pose is None:
        return said
    return msgspec.structs.replace(
        said,
        T_site_lidar=finite_rows(pose.T_site_lidar, lidar.name),
        covariance=finite_rows(pose.covariance, lidar.name),
        budget=budget_entries(pose.budget),
        predicted_error=[ErrorAtRange(float(r), float(s)) for r, s in pose.predicted_error],
        fitness=fitness_document(pose.fitness),
    )


def lidar_pose_of(document: LidarDoc, lidar: int) -> LidarPose | None:
    """Read back the pose that `lidar_document` wrote; None where there is none."""
    if document.T_site_lidar is None or document.covariance is None:
        return None
    return LidarPose(
        lidar,
        np.array(document.T_site_lidar, dtype=float),
        np.array(document.covariance, dtype=float),
        budget_of(document.budget),
        tuple((each.range_m, each.sigma_m) for each in document.predicted_error or ()),
        fitness_of(document.fitness),
    )


def found_document(scan: Scan | None) -> FoundDoc | None:
    """Write what was found in a recording; None where there is none."""
    if scan is None:
        return None
    refusal = None if scan.refusal is None else reason_document(scan.refusal)
    if scan.detection is None:
        return FoundDoc(None, [], [], refusal)
    return FoundDoc(
        finite(scan.detection.threshold),
        pole_documents(scan.detection.poles),
        rejected_documents(scan.detection.rejected),
        refusal,
    )


def recording_document(
    source: InputDoc, lidar: int, placement: int, scans: Sequence[Sequence[Scan | None]]
) -> RecordingDoc:
    """Write what was read of a LiDAR and placement, with the threshold that was used."""
    recording = RecordingDoc(**msgspec.structs.asdict(source), lidar=lidar, placement=placement)
    # A run that was refused early has looked at no scan.
    scan = scans[lidar][placement] if scans else None
    if scan is None or scan.detection is None:
        return recording
    return msgspec.structs.replace(recording, threshold=finite(scan.detection.threshold))


def surveyed_pole_document(pole: SurveyedPole) -> SurveyedPoleDoc:
    """Write what was surveyed of a pole."""
    foot, top = (None if end is None else _vector(end) for end in (pole.foot, pole.top))
    return SurveyedPoleDoc(pole.name, pole.placement, foot, top, pole.sigma)


def control_point_document(point: ControlPoint) -> ControlPointDoc:
    """Write a control point and where LiDARs see it."""
    seen = [SightingDoc(each.lidar, _vector(each.at), each.sigma) for each in point.seen]
    return ControlPointDoc(point.name, _vector(point.at), point.sigma, seen)


def site_pole_document(pole: SitePole) -> SitePoleDoc:
    """Write a pole as all LiDARs together have it."""
    point, direction, seen = _vector(pole.point), _vector(pole.direction), list(pole.seen_by)
    return SitePoleDoc(
        pole.name, pole.placement, point, direction, pole.length, seen, pole.surveyed
    )


def _vector(value: Array) -> list[float]:
    return [float(v) for v in value]
