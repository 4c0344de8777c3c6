"""What was read, and what was detected in it, as the result document holds it."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from ..datatypes import Detection, Pole


class PoleDoc(msgspec.Struct, frozen=True):
    """One pole as one LiDAR sees it, in that LiDAR's frame."""

    point_m: list[float]
    direction: list[float]
    length_m: float
    points: int
    rings: int
    rms_m: float


class RejectedDoc(msgspec.Struct, frozen=True):
    """A retro-reflective cluster that was rejected."""

    centre_m: list[float]
    points: int
    code: str
    reason: str


class PolesDoc(msgspec.Struct, frozen=True):
    """The poles of both LiDARs."""

    target: list[PoleDoc]
    source: list[PoleDoc]


class InputDoc(msgspec.Struct, frozen=True):
    """What was read."""

    path: str
    sha256: str
    points: int
    dropped: int
    sensor: str
    threshold: float | None


class DetectionDoc(msgspec.Struct, frozen=True):
    """What `retropole detect` found in one file."""

    input: InputDoc
    threshold_source: str
    retro_points: int
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]


def pole_documents(poles: Sequence[Pole]) -> list[PoleDoc]:
    """Write poles as the result document holds them."""
    return [
        PoleDoc(
            pole.point.tolist(),
            pole.direction.tolist(),
            pole.length,
            len(pole.xyz),
            pole.rings,
            pole.rms,
        )
        for pole in poles
    ]


def detection_document(detection: Detection, source: InputDoc) -> DetectionDoc:
    """Write what was found in one cloud, the rejected clusters included."""
    return DetectionDoc(
        input=source,
        threshold_source=detection.threshold_source,
        retro_points=detection.retro_points,
        poles=pole_documents(detection.poles),
        rejected=[
            RejectedDoc(r.centre.tolist(), len(r.index), r.code, r.reason)
            for r in detection.rejected
        ],
    )
