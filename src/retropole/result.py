"""The result document: everything that a run found, as one JSON file that other programs read.

Schema ``retropole/result/1``. Metres and radians; 4×4 matrices row by row; poses and covariances
say in which frame and order they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Literal

import msgspec
import numpy as np

from . import __version__
from .datatypes import (
    Array,
    Calibration,
    Detection,
    Hypothesis,
    Placement,
    Pole,
    PoseEstimate,
    WeakDirection,
)

RESULT_SCHEMA: Literal["retropole/result/1"] = "retropole/result/1"
COVARIANCE_ORDER = ("phi_x", "phi_y", "phi_z", "delta_x", "delta_y", "delta_z")
COVARIANCE_FRAME = "target axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"
RANGES_M = (1.0, 10.0, 30.0, 60.0)

Matrix = list[list[float]]


class ReasonDoc(msgspec.Struct):
    """Why a verdict is not a plain ok."""

    code: str
    message: str
    values: dict[str, float | int | str]


class PoseEstimateDoc(msgspec.Struct):
    """A pose of one stage."""

    T_target_source: Matrix
    covariance: Matrix | None
    rms_m: float


class StagesDoc(msgspec.Struct):
    """The poses on the way."""

    poles: PoseEstimateDoc | None
    refined: PoseEstimateDoc | None


class HypothesisDoc(msgspec.Struct):
    """One way of laying the source poles on the target poles."""

    pairs: list[tuple[int, int]]
    T_target_source: Matrix
    pole_rms_m: float
    exact: bool
    icp_rotation_rad: float | None
    icp_translation_m: float | None
    overlap: float
    free_space: float
    score: float
    chosen: bool


class PoleDoc(msgspec.Struct):
    """One pole as one LiDAR sees it, in that LiDAR's frame."""

    point_m: list[float]
    direction: list[float]
    length_m: float
    points: int
    rings: int
    rms_m: float


class RejectedDoc(msgspec.Struct):
    """A retro-reflective cluster that is no pole."""

    centre_m: list[float]
    points: int
    code: str
    reason: str


class PolesDoc(msgspec.Struct):
    """The poles of both LiDARs."""

    target: list[PoleDoc]
    source: list[PoleDoc]


class InputDoc(msgspec.Struct):
    """What was read."""

    path: str
    sha256: str
    points: int
    dropped: int
    sensor: str
    threshold: float | None


class ErrorAtRange(msgspec.Struct):
    """Predicted error of a point at a range, 1 sigma."""

    range_m: float
    sigma_m: float


class WeakestDoc(msgspec.Struct):
    """The direction in which the pose is least sure, at the poles, target axes."""

    direction: list[float]
    sigma_m: float
    words: str
    condition: float


class PlacementDoc(msgspec.Struct):
    """One of several placements: its poles, and how far the pose without it is from the whole."""

    poles_target: int
    poles_source: int
    left_out_rotation_rad: float | None
    left_out_translation_m: float | None


class ResultDoc(msgspec.Struct, kw_only=True):
    """The whole document."""

    schema: Literal["retropole/result/1"] = RESULT_SCHEMA
    status: str
    reasons: list[ReasonDoc]
    T_target_source: Matrix | None
    covariance: Matrix | None
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = COVARIANCE_FRAME
    predicted_error: list[ErrorAtRange] | None
    weakest: WeakestDoc | None = None
    stages: StagesDoc
    hypotheses: list[HypothesisDoc]
    margin: float | None
    poles: PolesDoc
    placements: list[PlacementDoc] = []
    inputs: list[InputDoc]
    config: dict[str, Any]
    version: str
    created: str
    seconds: dict[str, float]


class DetectionDoc(msgspec.Struct):
    """What `retropole detect` found in one file."""

    input: InputDoc
    threshold_source: str
    retro_points: int
    poles: list[PoleDoc]
    rejected: list[RejectedDoc]


def _matrix(value: Array | None) -> Any:
    return None if value is None else np.asarray(value).tolist()


def _stage(stage: PoseEstimate | None) -> PoseEstimateDoc | None:
    if stage is None:
        return None
    return PoseEstimateDoc(_matrix(stage.T_target_source), _matrix(stage.covariance), stage.rms)


def _hypothesis(hypothesis: Hypothesis, chosen: bool) -> HypothesisDoc:
    return HypothesisDoc(
        pairs=list(hypothesis.match.pairs),
        T_target_source=_matrix(hypothesis.match.T_target_source),
        pole_rms_m=hypothesis.match.pole_rms,
        exact=hypothesis.match.exact,
        icp_rotation_rad=hypothesis.icp_rotation,
        icp_translation_m=hypothesis.icp_translation,
        overlap=hypothesis.overlap,
        free_space=hypothesis.free_space,
        score=hypothesis.score,
        chosen=chosen,
    )


def _weakest(weakest: WeakDirection | None) -> WeakestDoc | None:
    if weakest is None:
        return None
    return WeakestDoc(weakest.direction.tolist(), weakest.sigma, weakest.words, weakest.condition)


def _placements(placements: Sequence[Placement]) -> list[PlacementDoc]:
    """Write several placements; a single one is told by the rest of the document."""
    if len(placements) < 2:
        return []
    return [
        PlacementDoc(len(p.target_poles), len(p.source_poles), *(p.left_out or (None, None)))
        for p in placements
    ]


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


def result_document(
    calibration: Calibration,
    *,
    inputs: Sequence[InputDoc],
    config: dict[str, Any],
    seconds: dict[str, float],
) -> ResultDoc:
    """Write a calibration as the result document.

    Parameters
    ----------
    calibration
        The answer, or the refusal.
    inputs
        Target and source, as they were read.
    config
        The options of the run.
    seconds
        Time of each step, reading included.
    """
    answered = calibration.status != "refused"
    found = calibration.detections
    return ResultDoc(
        status=calibration.status,
        reasons=[ReasonDoc(r.code, r.message, dict(r.values)) for r in calibration.reasons],
        T_target_source=_matrix(calibration.T_target_source),
        covariance=_matrix(calibration.covariance),
        predicted_error=[
            ErrorAtRange(range_m, sigma) for range_m, sigma in calibration.predicted_error
        ]
        or None,
        weakest=_weakest(calibration.weakest),
        stages=StagesDoc(_stage(calibration.poles), _stage(calibration.refined)),
        hypotheses=[
            _hypothesis(h, answered and k == 0) for k, h in enumerate(calibration.hypotheses)
        ],
        margin=calibration.margin,
        poles=PolesDoc(
            pole_documents(found[0].poles if found[0] else ()),
            pole_documents(found[1].poles if found[1] else ()),
        ),
        placements=_placements(calibration.placements),
        inputs=list(inputs),
        config=config,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        seconds={name: round(value, 4) for name, value in seconds.items()},
    )


def encode(document: msgspec.Struct) -> bytes:
    """Write a document as indented JSON."""
    return msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n"


def decode(data: bytes) -> ResultDoc:
    """Read a result document; raises `msgspec.ValidationError` where it is not one."""
    return msgspec.json.decode(data, type=ResultDoc)
