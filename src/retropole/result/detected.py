"""What was read, and what was detected in it, as the result document holds it."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from ..base.bounded import Count, Number, Size, Text, Vector
from ..base.datatypes import Detection, Pole, RejectedCluster


class PoleDoc(msgspec.Struct, frozen=True, eq=False):
    """One pole as one LiDAR sees it, in that LiDAR's frame."""

    point_m: Vector
    direction: Vector
    length_m: Size
    points: Count
    rings: Count
    rms_m: Size


class RejectedDoc(msgspec.Struct, frozen=True, eq=False):
    """A retro-reflective cluster that was rejected."""

    centre_m: Vector
    points: Count
    code: Text
    reason: Text


class PolesDoc(msgspec.Struct, frozen=True, eq=False):
    """The poles of both LiDARs."""

    target: list[PoleDoc]
    source: list[PoleDoc]


class InputDoc(msgspec.Struct, frozen=True):
    """What was read, what was left out of too many, and in `notes` what was lost."""

    path: Text
    sha256: Text
    points: Count
    dropped: Count
    sensor: Text
    threshold: Number | None
    thinned: Count = 0
    frames_left_out: Count = 0
    notes: list[Text] = []


class DetectionDoc(msgspec.Struct, frozen=True, eq=False):
    """What `retropole detect` found in one file."""

    input: InputDoc
    threshold_source: Text
    retro_points: Count
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]


def pole_documents(poles: Sequence[Pole]) -> list[PoleDoc]:
    """Write poles as the result document holds them."""
    return [
        PoleDoc(pole.point, pole.direction, pole.length, len(pole.xyz), pole.rings, pole.rms)
        for pole in poles
    ]


def rejected_documents(rejected: Sequence[RejectedCluster]) -> list[RejectedDoc]:
    """Write rejected clusters as the result document holds them."""
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
