"""The result document: everything that a run found, as one JSON file that other programs read.

Schema ``retropole/result/1``: metres and radians, 4×4 matrices row by row. The names in the file
are a contract: where a field has a better name here, the file keeps the old one.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..base.datatypes import Calibration, Hypothesis, Placement, PoseEstimate
from ..base.version import __version__
from .bounded import (
    LONGEST_LIST,
    Count,
    Covariance,
    Number,
    Pose,
    Share,
    Size,
    Status,
    Text,
    Vector,
)
from .certainty import (
    BudgetEntryDoc,
    ConfirmationDoc,
    ErrorAtRange,
    FitnessDoc,
    Matrix,
    RadiusDoc,
    UncertaintyDoc,
    WeakestDoc,
    budget_document,
    confirmation_document,
    confirmation_of,
    fitness_document,
    matrix_rows,
    radius_document,
    radius_of,
    uncertainty_document,
    uncertainty_of,
    weakest_document,
)
from .detected import (
    DetectionDoc,
    InputDoc,
    PoleDoc,
    PolesDoc,
    RejectedDoc,
    detection_document,
    pole_documents,
)
from .options import DEFAULT_CONFIG, Reading, RunConfig

__all__ = [
    "COVARIANCE_FRAME",
    "COVARIANCE_ORDER",
    "DEFAULT_CONFIG",
    "RESULT_SCHEMA",
    "BudgetEntryDoc",
    "ConfirmationDoc",
    "DetectionDoc",
    "ErrorAtRange",
    "FitnessDoc",
    "HypothesisDoc",
    "InputDoc",
    "Matrix",
    "PlacementDoc",
    "PoleDoc",
    "PolesDoc",
    "PoseEstimateDoc",
    "RadiusDoc",
    "Reading",
    "ReasonDoc",
    "RejectedDoc",
    "ResultDoc",
    "RunConfig",
    "StagesDoc",
    "UncertaintyDoc",
    "WeakestDoc",
    "confirmation_document",
    "confirmation_of",
    "detection_document",
    "encode",
    "pole_documents",
    "radius_of",
    "result_document",
    "uncertainty_of",
]

RESULT_SCHEMA: Literal["retropole/result/1"] = "retropole/result/1"
COVARIANCE_ORDER = ("phi_x", "phi_y", "phi_z", "delta_x", "delta_y", "delta_z")
COVARIANCE_FRAME = "target axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"


class ReasonDoc(msgspec.Struct, frozen=True):
    """Why a verdict is not a plain ok."""

    code: Text
    message: Text
    values: dict[Text, Number | int | Text]


class PoseEstimateDoc(msgspec.Struct, frozen=True):
    """A pose, from the poles or refined."""

    T_target_source: Pose
    covariance: Covariance | None
    rms_m: Size


class StagesDoc(msgspec.Struct, frozen=True):
    """The poses on the way: from the poles alone, and refined by the scene."""

    poles: PoseEstimateDoc | None
    refined: PoseEstimateDoc | None


class HypothesisDoc(msgspec.Struct, frozen=True):
    """One way of laying the source poles on the target poles.

    It stands where it is the best, or where the scene does not rule it out beside the best.
    """

    pairs: Annotated[list[tuple[Count, Count]], Meta(max_length=LONGEST_LIST)]
    T_target_source: Pose
    pole_rms_m: Size
    exact: bool
    icp_rotation_rad: Size | None
    icp_translation_m: Size | None
    overlap: Share
    free_space_violation: Number = msgspec.field(name="free_space")
    score: Number
    chosen: bool
    stands: bool = False


class PlacementDoc(msgspec.Struct, frozen=True):
    """One of several placements: its poles, and how far the pose without it is from the whole."""

    poles_target: Count
    poles_source: Count
    left_out_rotation_rad: Size | None
    left_out_translation_m: Size | None


class ResultDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The whole document."""

    schema: Literal["retropole/result/1"] = RESULT_SCHEMA
    status: Status
    reasons: list[ReasonDoc]
    T_target_source: Pose | None
    covariance: Covariance | None
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = COVARIANCE_FRAME
    uncertainty: UncertaintyDoc | None = None
    budget: list[BudgetEntryDoc] | None = None
    predicted_error: list[ErrorAtRange] | None
    weakest: WeakestDoc | None = None
    radius: RadiusDoc | None = None
    confirmation: ConfirmationDoc | None = None
    fitness: FitnessDoc | None = None
    stages: StagesDoc
    hypotheses: list[HypothesisDoc]
    margin: Number | None
    vertical: Vector | None = None
    poles: PolesDoc
    placements: list[PlacementDoc] = []
    inputs: list[InputDoc]
    config: RunConfig
    version: Text
    created: Text
    seconds: dict[Text, Size]

    @property
    def chosen(self) -> HypothesisDoc | None:
        """The hypothesis that was chosen; None where the run was refused."""
        return next((hypothesis for hypothesis in self.hypotheses if hypothesis.chosen), None)


def _pose(pose: PoseEstimate | None) -> PoseEstimateDoc | None:
    if pose is None:
        return None
    return PoseEstimateDoc(
        matrix_rows(pose.T_target_source),
        None if pose.covariance is None else matrix_rows(pose.covariance),
        pose.rms,
    )


def _hypothesis(hypothesis: Hypothesis, chosen: bool) -> HypothesisDoc:
    return HypothesisDoc(
        pairs=list(hypothesis.match.pairs),
        T_target_source=matrix_rows(hypothesis.match.T_target_source),
        pole_rms_m=hypothesis.match.pole_rms,
        exact=hypothesis.match.exact,
        icp_rotation_rad=hypothesis.icp_rotation,
        icp_translation_m=hypothesis.icp_translation,
        overlap=hypothesis.overlap,
        free_space_violation=hypothesis.free_space_violation,
        score=hypothesis.score,
        chosen=chosen,
        stands=hypothesis.stands,
    )


def _placements(placements: Sequence[Placement]) -> list[PlacementDoc]:
    """Write several placements; a single one is told by the rest of the document."""
    if len(placements) < 2:
        return []
    return [
        PlacementDoc(
            len(each.target.poles),
            len(each.source.poles),
            None if each.left_out is None else each.left_out.rotation,
            None if each.left_out is None else each.left_out.translation,
        )
        for each in placements
    ]


def _with_thresholds(inputs: Sequence[InputDoc], placements: Sequence[Placement]) -> list[InputDoc]:
    """Add the threshold that was used to each input; target and source alternate."""
    scans = [scan for placement in placements for scan in (placement.target, placement.source)]
    return [
        item
        if scan.detection is None
        else msgspec.structs.replace(item, threshold=scan.detection.threshold)
        for item, scan in zip(inputs, scans, strict=True)
    ]


def result_document(
    calibration: Calibration,
    *,
    inputs: Sequence[InputDoc],
    config: RunConfig,
    seconds: dict[str, float],
) -> ResultDoc:
    """Write a calibration as the result document.

    Parameters
    ----------
    calibration
        The answer, or the refusal.
    inputs
        Target and source of each placement, as they were read.
    config
        The options of the run.
    seconds
        Time of each step, reading included.
    """
    answered = calibration.status != "refused"
    first = calibration.placements[0]
    T, covariance = calibration.T_target_source, calibration.covariance
    return ResultDoc(
        status=calibration.status,
        reasons=[ReasonDoc(r.code, r.message, dict(r.values)) for r in calibration.reasons],
        T_target_source=None if T is None else matrix_rows(T),
        covariance=None if covariance is None else matrix_rows(covariance),
        uncertainty=uncertainty_document(calibration.uncertainty),
        budget=budget_document(calibration.uncertainty),
        predicted_error=[
            ErrorAtRange(range_m, sigma) for range_m, sigma in calibration.predicted_error
        ]
        or None,
        weakest=weakest_document(calibration.weakest),
        radius=radius_document(calibration.radius),
        confirmation=confirmation_document(calibration.confirmation),
        fitness=fitness_document(calibration.fitness),
        stages=StagesDoc(_pose(calibration.poles), _pose(calibration.refined)),
        hypotheses=[
            _hypothesis(h, answered and k == calibration.chosen)
            for k, h in enumerate(calibration.hypotheses)
        ],
        margin=calibration.margin,
        vertical=None if calibration.vertical is None else calibration.vertical.tolist(),
        poles=PolesDoc(
            pole_documents(first.target.poles),
            pole_documents(first.source.poles),
        ),
        placements=_placements(calibration.placements),
        inputs=_with_thresholds(inputs, calibration.placements),
        config=config,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        seconds={name: round(value, 4) for name, value in seconds.items()},
    )


def encode(document: msgspec.Struct) -> bytes:
    """Write a document as indented JSON; numbers of NumPy become Python's."""
    return (
        msgspec.json.format(msgspec.json.encode(document, enc_hook=np.generic.item), indent=1)
        + b"\n"
    )
