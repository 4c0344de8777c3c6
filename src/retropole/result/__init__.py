"""The result document: everything that a run found, as one JSON file that other programs read.

Schema ``retropole/result/1``: metres and radians, 4×4 matrices row by row. The names in the file
are a contract: where a field has a better name here, the file keeps the old one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast

import msgspec
from msgspec import Meta, structs

from ..base.bounded import (
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
    Whole,
)
from ..base.carried import CarriedWalk
from ..base.datatypes import Calibration, Hypothesis, Kind, Placement, Pole, PoseEstimate, Scan
from ..base.errors import Reason, Refusal, UsageError
from ..base.reasons import Code
from ..base.systematic import Sway
from ..base.uncertainty import BudgetEntry as BudgetEntry
from ..base.uncertainty import ErrorAtRange as ErrorAtRange
from ..base.uncertainty import RadiusEstimate, Uncertainty, WeakDirection
from ..base.uncertainty.confirmation import UNUSABLE, Confirmation
from ..base.uncertainty.purpose import Fitness
from ..base.version import __version__
from .options import DEFAULT_CONFIG as DEFAULT_CONFIG
from .options import Reading as Reading
from .options import RunConfig as RunConfig

Input = TypeVar("Input", bound="InputDoc")
Made = TypeVar("Made", bound=msgspec.Struct)

RESULT_SCHEMA: Literal["retropole/result/1"] = "retropole/result/1"
COVARIANCE_ORDER = ("phi_x", "phi_y", "phi_z", "delta_x", "delta_y", "delta_z")
COVARIANCE_FRAME = "target axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"


class ReasonDoc(msgspec.Struct, frozen=True):
    """Why a verdict is not a plain ok; its code may be one of another version."""

    code: Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,59}\Z")]
    message: Text
    values: dict[Text, Number | Whole | Text]


class SwayDoc(msgspec.Struct, frozen=True, eq=False):
    """How a LiDAR swayed while it recorded a placement: their indices, those of a pair 0 and 1."""

    lidar: Count
    placement: Count
    sway: Sway


def sway_documents(scans: Sequence[Sequence[Scan | None]]) -> list[SwayDoc]:
    """List what swayed of the scans of each LiDAR, one for each placement."""
    return [
        SwayDoc(i, p, scan.sway)
        for i, row in enumerate(scans)
        for p, scan in enumerate(row)
        if scan is not None and scan.sway is not None
    ]


def chance_wrong(reasons: Sequence[ReasonDoc]) -> float:
    """Give the largest chance of a wrong pose that a warning states; 0 if none does."""
    stated = (each.values.get("probability_wrong") for each in reasons)
    return max((float(each) for each in stated if isinstance(each, int | float)), default=0.0)


def verdict_line(status: str, reasons: Sequence[ReasonDoc]) -> str:
    """Write a verdict on one line that is safe in a comment of any format.

    ``verdict of the calibration: warn, not_confirmed; chance of a wrong pose 41.1 %``.
    """
    codes = "".join(f", {code}" for code in dict.fromkeys(each.code for each in reasons))
    wrong = chance_wrong(reasons)
    doubt = f"; chance of a wrong pose {100 * wrong:.1f} %" if wrong else ""
    advice = "; do not use it yet" if wrong > UNUSABLE else ""
    return f"verdict of the calibration: {status}{codes}{doubt}{advice}"


class PoleDoc(msgspec.Struct, frozen=True, eq=False):
    """One pole as one LiDAR sees it, in that LiDAR's frame."""

    point_m: Vector
    direction: Vector
    length_m: Size
    points: Count
    rings: Count
    rms_m: Size


class PolesDoc(msgspec.Struct, frozen=True, eq=False):
    """The poles of both LiDARs."""

    target: list[PoleDoc]
    source: list[PoleDoc]


class InputDoc(msgspec.Struct, frozen=True):
    """What was read, how many surplus points were left out, and in `notes` other losses.

    `frame_id` is the frame of its points by the words of the recording; empty if it has none, or
    several, or what can be no name. `clock_offset_s` is how far the LiDAR's clock is ahead of the
    recorder's; null if the recording does not have both.
    """

    path: Text
    sha256: Text
    points: Count
    dropped: Count
    sensor: Text
    threshold: Number | None
    thinned: Count = 0
    frames_left_out: Count = 0
    frame_id: Text = ""
    notes: list[Text] = []
    clock_offset_s: Number | None = None


class StagesDoc(msgspec.Struct, frozen=True, eq=False):
    """The poses on the way: from the poles alone, and refined by the scene."""

    poles: PoseEstimate | None
    refined: PoseEstimate | None


class HypothesisDoc(msgspec.Struct, frozen=True, eq=False):
    """One way of laying the source poles on the target poles.

    It is kept where it is the best, or where the scene does not rule it out next to the best.
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


class TestDoc(
    msgspec.Struct,
    frozen=True,
    rename={"minimal_detectable": "minimal_detectable_m", "external": "external_at_30m_m"},
):
    """One observation, or several, tested against all others; `base.datatypes.Test`."""

    kind: Kind
    name: Text
    lidar: Count | None
    placement: Count | None
    pole: Count | None
    chi2: Number | None
    freedom: Count
    w: Number | None
    redundancy: Share | None
    minimal_detectable: Size | None
    external: Size | None
    allowed: Number | None = 5.0


class Document(msgspec.Struct, frozen=True, eq=False):
    """A whole document; one that is written the same is the same."""

    def __eq__(self, other: object) -> bool:  # noqa: D105
        return isinstance(other, type(self)) and encode(self) == encode(other)

    def __hash__(self) -> int:  # noqa: D105
        return hash(encode(self))


class ResultDoc(Document, frozen=True, eq=False, kw_only=True):
    """The whole document."""

    schema: Literal["retropole/result/1"] = RESULT_SCHEMA
    status: Status
    reasons: list[ReasonDoc]
    notes: list[ReasonDoc] = []
    T_target_source: Pose | None
    covariance: Covariance | None
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = COVARIANCE_FRAME
    uncertainty: Uncertainty | None = None
    budget: list[BudgetEntry] | None = None
    predicted_error: list[ErrorAtRange] | None
    weakest: WeakDirection | None = None
    radius: RadiusEstimate | None = None
    confirmation: Confirmation | None = None
    fitness: Fitness | None = None
    walk: CarriedWalk | None = None
    stages: StagesDoc
    hypotheses: list[HypothesisDoc]
    margin: Number | None
    vertical: Vector | None = None
    poles: PolesDoc
    placements: list[PlacementDoc] = []
    tests: Annotated[list[TestDoc], Meta(max_length=LONGEST_LIST)] = []
    sways: Annotated[list[SwayDoc], Meta(max_length=LONGEST_LIST)] = []
    inputs: list[InputDoc]
    config: RunConfig
    version: Text
    created: Text
    seconds: dict[Text, Size]

    @property
    def chosen(self) -> HypothesisDoc | None:
        """The hypothesis that was chosen; None if the run was refused."""
        return next((hypothesis for hypothesis in self.hypotheses if hypothesis.chosen), None)

    @property
    def whole_uncertainty(self) -> Uncertainty | None:
        """`uncertainty` with the budget; None if they are not stated."""
        return self.uncertainty and structs.replace(
            self.uncertainty, budget=tuple(self.budget or ())
        )


def pole_documents(poles: Sequence[Pole]) -> list[PoleDoc]:
    """Write poles as in the result document."""
    return [
        PoleDoc(pole.point, pole.direction, pole.length, len(pole.xyz), pole.rings, pole.rms)
        for pole in poles
    ]


def _hypothesis(hypothesis: Hypothesis, chosen: bool) -> HypothesisDoc:
    return document_of(
        HypothesisDoc,
        hypothesis.match,
        hypothesis,
        pole_rms_m=hypothesis.match.pole_rms,
        icp_rotation_rad=hypothesis.icp_rotation,
        icp_translation_m=hypothesis.icp_translation,
        chosen=chosen,
    )


def _placements(placements: Sequence[Placement]) -> list[PlacementDoc]:
    """Write several placements; a single one is described by the rest of the document."""
    if len(placements) < 2:
        return []
    return [
        PlacementDoc(
            len(each.target.poles), len(each.source.poles), *(each.left_out or (None, None))
        )
        for each in placements
    ]


def result_document(
    calibration: Calibration,
    *,
    inputs: Sequence[InputDoc],
    config: RunConfig,
    seconds: Mapping[str, float],
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
    first, uncertainty = calibration.placements[0], calibration.uncertainty
    scans = [scan for each in calibration.placements for scan in each.scans]
    return document_of(
        ResultDoc,
        made_now(seconds),
        calibration,
        # The budget is next to it.
        uncertainty=uncertainty and structs.replace(uncertainty, budget=()),
        budget=None if uncertainty is None else list(uncertainty.budget),
        predicted_error=list(calibration.predicted_error) or None,
        stages=StagesDoc(calibration.poles, calibration.refined),
        hypotheses=[
            _hypothesis(h, answered and k == calibration.chosen)
            for k, h in enumerate(calibration.hypotheses)
        ],
        poles=PolesDoc(pole_documents(first.target.poles), pole_documents(first.source.poles)),
        placements=_placements(calibration.placements),
        tests=[document_of(TestDoc, test) for test in calibration.tests],
        sways=sway_documents(
            list(zip(*(each.scans for each in calibration.placements), strict=True))
        ),
        inputs=[with_threshold(*each) for each in zip(inputs, scans, strict=True)],
        config=config,
    )


def document_of(kind: type[Made], *found: object, **other: Any) -> Made:
    """Make a document of what has attributes with the names of its fields.

    Parameters
    ----------
    kind
        Of the document.
    found
        The first that has an attribute gives it. A number that is not finite becomes None, a tuple
        of anything but indices a list, and a reason its document.
    other
        Fields that are given as they are.
    """
    for name in kind.__struct_fields__:
        owner = next((each for each in found if hasattr(each, name)), None)
        if name not in other and owner is not None:
            other[name] = _written(getattr(owner, name))
    return kind(**other)


def _written(value: Any) -> Any:
    match value:
        case Reason() | Refusal():
            return reason_document(value)
        case float():
            return finite(value)
        case (int(), *_):
            return value
        case tuple():
            return [_written(each) for each in value]
    return value


class Provenance(NamedTuple):
    """What wrote a document, when, and the time of each step."""

    version: str
    created: str
    seconds: dict[str, float]


def made_now(seconds: Mapping[str, float] | None = None) -> Provenance:
    """Give time, version and the seconds of each step of a document."""
    rounded = {name: round(value, 4) for name, value in (seconds or {}).items()}
    return Provenance(__version__, datetime.now(UTC).isoformat(timespec="seconds"), rounded)


def finite(value: float | None) -> float | None:
    """Write a number that may be none: what is not finite is null."""
    return value if value is None or math.isfinite(value) else None


def reason_document(reason: Reason | Refusal) -> ReasonDoc:
    """Write a reason; of its values, what is not finite becomes text."""
    values = {
        name: value if isinstance(value, str) or math.isfinite(value) else str(value)
        for name, value in reason.values.items()
    }
    return ReasonDoc(reason.code, reason.message, values)


def refusal_of(reasons: Sequence[ReasonDoc], prefix: str = "") -> Refusal:
    """Give the refusal of a document: its first reason, after some words."""
    why = next(iter(reasons), ReasonDoc("refused", "the result gives no reason", {}))
    return Refusal(cast("Code", why.code), prefix + why.message, why.values)


def with_threshold(source: Input, scan: Scan | None) -> Input:
    """Add the threshold that was used to what was read."""
    found = None if scan is None else scan.detection
    return source if found is None else structs.replace(source, threshold=finite(found.threshold))


def encode(document: msgspec.Struct) -> bytes:
    """Write a document as indented JSON; numbers and arrays of NumPy become Python's."""
    return msgspec.json.format(msgspec.json.encode(document, enc_hook=plain), indent=1) + b"\n"


def plain(value: Any) -> Any:
    """Write numbers and arrays of NumPy as Python's, as msgspec asks (`enc_hook`)."""
    return value.tolist()


RESULT_FILE, SITE_RESULT_FILE = "result.json", "site-result.json"
"""What the result document of two LiDARs, and that of a site, is called in its folder."""

LEVEL_FILE = "level.json"
"""What their level over the ground is called there."""

REPORT_FILE, SITE_REPORT_FILE = "report.html", "site-report.html"
"""What the reports of both are called there."""

CERTIFICATE = "certificate.json", "certificate.html"
"""What the field test of two LiDARs is called there that were watched."""

PLAN_FILE, PLAN_PAGE = "plan.json", "plan.html"
"""What a plan of poles and its page are called there."""


def result_file(path: Path) -> Path:
    """Find the result document in a folder, that of a site if it is the only one; a file is
    returned unchanged."""
    if not path.is_dir():
        return path
    own, of_site = path / RESULT_FILE, path / SITE_RESULT_FILE
    return of_site if of_site.exists() and not own.exists() else own


def any_result_file(path: Path) -> Path:
    """Find the result document in a folder, that of two LiDARs or of a site; a file is returned
    unchanged.

    Raises
    ------
    UsageError
        If the folder has both.
    """
    if not path.is_dir() or not (path / SITE_RESULT_FILE).exists():
        return result_file(path)
    if (path / RESULT_FILE).exists():
        raise UsageError(f"{path} contains {RESULT_FILE} and {SITE_RESULT_FILE}; give one of them")
    return path / SITE_RESULT_FILE
