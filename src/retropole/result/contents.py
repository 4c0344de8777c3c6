"""What a recording contains, as ``retropole info`` and ``retropole detect`` print it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec

from ..base.bounded import Count, Text, Vector
from ..base.datatypes import Detection, RejectedCluster
from . import InputDoc, PoleDoc, pole_documents


class TopicDoc(msgspec.Struct):
    """A topic of a bag."""

    name: str
    type: str
    messages: int


class IntensityDoc(msgspec.Struct):
    """Intensities: quantiles, a histogram over even bins, and where retro-reflectors may begin.

    `field` is the one that they are of, and `others` those that are called an intensity as well.
    """

    median: float
    p95: float
    max: float
    bin_edges: list[float]
    counts: list[int]
    threshold: float | None
    threshold_source: str
    retro_points: int
    field: str = ""
    others: list[str] = []


class CloudDoc(msgspec.Struct):
    """The frames of a file, or of one topic of a bag; why its rings are ignored, or nothing.

    `beam_origin_m` is where the beams start, and `told_by_rings` whether that is not from the file.
    `odd_coordinates` says why the coordinates cannot be metres about the LiDAR, and `units` which
    units would explain it. `clock_offset_s` is how far the LiDAR's clock is ahead of the
    recorder's.
    """

    topic: str | None
    frame_id: str | None
    frames: int
    frames_read: int
    step: int
    rate_hz: float | None
    duration_s: float | None
    fields: dict[str, str]
    points: int
    dropped: int
    notes: list[str]
    rings: int | None
    rings_ignored: str
    beam_origin_m: list[float]
    told_by_rings: bool
    range_m: list[float]
    intensity: IntensityDoc | None
    sensors: list[str]
    odd_coordinates: str
    units: list[str]
    clock_offset_s: float | None = None


class InfoDoc(msgspec.Struct, kw_only=True):
    """What a recording contains, as ``retropole info`` prints it."""

    schema: Literal["retropole/info/1"] = "retropole/info/1"
    path: str
    topics: list[TopicDoc]
    clouds: list[CloudDoc]


class RejectedDoc(msgspec.Struct, frozen=True, eq=False):
    """A retro-reflective cluster that was rejected."""

    centre_m: Vector
    points: Count
    code: Text
    reason: Text


class DetectionDoc(msgspec.Struct, frozen=True, eq=False):
    """What `retropole detect` found in one file."""

    input: InputDoc
    threshold_source: Text
    retro_points: Count
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]


def rejected_documents(rejected: Sequence[RejectedCluster]) -> list[RejectedDoc]:
    """Write rejected clusters as in the result document."""
    return [RejectedDoc(r.centre, len(r.index), r.code, r.reason) for r in rejected]


def detection_document(detection: Detection, source: InputDoc) -> DetectionDoc:
    """Write what was found in one cloud, the rejected clusters included."""
    return DetectionDoc(
        input=source,
        threshold_source=detection.threshold_source,
        retro_points=detection.retro_points,
        poles=pole_documents(detection.poles),
        rejected=rejected_documents(detection.rejected),
    )
