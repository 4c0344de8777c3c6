"""The parts of a site's result document, and how each is written."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from ..base.bounded import Count, Number, PartCovariance, Pose, Text
from ..base.datatypes import Scan
from ..base.uncertainty import BudgetEntry, ErrorAtRange
from ..base.uncertainty.purpose import Fitness
from ..io.thinning import MAX_POINTS
from ..io.units import Unit
from ..site.answer import LidarPose
from ..site.description import SiteLidar, Up
from . import ReasonDoc, finite, reason_document, with_threshold
from .detected import InputDoc, PoleDoc, RejectedDoc, pole_documents, rejected_documents
from .options import Frames, MaxPoints


class SiteConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How a site was read: the site file, and the options of the run.

    None stands for frames evenly spread; frames are start, stop and step.
    """

    site_file: Text = ""
    site_sha256: Text = ""
    frames: Frames | None = None
    max_points: MaxPoints = MAX_POINTS
    unit: Unit = "m"


class LidarDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One LiDAR and its pose in the frame of the site; the pose is null where refused.

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
        """Its pose, where it is the LiDAR of this index; None where it has none."""
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
    """What was read of one LiDAR and placement."""

    lidar: Count
    placement: Count


def lidar_document(lidar: SiteLidar, pose: LidarPose | None) -> LidarDoc:
    """Write a LiDAR and its pose; None where it has none.

    Raises
    ------
    ValueError
        Where the pose is not finite: that is no answer.
    """
    said = LidarDoc(
        name=lidar.name,
        sensor="auto" if lidar.sensor is None else lidar.sensor.name,
        serial=lidar.serial,
        up=lidar.up,
    )
    if pose is None:
        return said
    if not (np.isfinite(pose.T_site_lidar).all() and np.isfinite(pose.covariance).all()):
        raise ValueError(f"{lidar.name}: a number of the answer is not finite")
    return msgspec.structs.replace(
        said,
        T_site_lidar=pose.T_site_lidar,
        covariance=pose.covariance,
        budget=list(pose.budget),
        predicted_error=list(pose.predicted_error),
        fitness=pose.fitness,
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
    return with_threshold(recording, scans[lidar][placement] if scans else None)
