"""Reading a result document that may have been edited by hand, cut short or made elsewhere.

Whoever holds one that was decoded relies on it: every number is finite, rotations rotate,
covariances are covariances, and what refers to a pole finds one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import msgspec
import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import ReadError
from ..base.uncertainty import covariance_fault
from . import COVARIANCE_ORDER, PoseEstimateDoc, ReasonDoc, ResultDoc
from .bounded import LARGEST, Covariance, Pose

CODE = re.compile("[a-z][a-z0-9_]{,59}")


def decode(data: bytes) -> ResultDoc:
    """Read a result document.

    Raises
    ------
    ReadError
        Where it is not one; names the field, and says what is wrong with it.
    """
    try:
        document = msgspec.json.decode(data, type=ResultDoc)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ReadError(f"no result document: {error}") from None
    _check(document)
    return document


def _check(document: ResultDoc) -> None:
    """Check what the types of the fields cannot say."""
    _check_verdict(document)
    for name, pose in _poses(document):
        try:
            se3.rigid(np.array(pose))
        except ReadError as error:
            raise ReadError(f"{name}: {error}") from None
    for name, covariance, is_part in _covariances(document):
        check_covariance(name, np.array(covariance, dtype=float), is_part=is_part)
    of_target, of_source = document.poles.target, document.poles.source
    for k, hypothesis in enumerate(document.hypotheses):
        for i, j in hypothesis.pairs:
            if i >= len(of_target) or j >= len(of_source):
                raise ReadError(
                    f"hypotheses[{k}].pairs: ({i}, {j}), there are {len(of_target)} poles of the "
                    f"target and {len(of_source)} of the source"
                )


def _check_verdict(document: ResultDoc) -> None:
    """Hold the status, its reasons, the transform and what it is called against each other."""
    answered = document.status != "refused"
    if answered != (document.T_target_source is not None):
        there = "no" if answered else "a"
        raise ReadError(f"T_target_source: {there} transform, and the status is {document.status}")
    if document.covariance_order != COVARIANCE_ORDER:
        raise ReadError(f"covariance_order: expected {' '.join(COVARIANCE_ORDER)}")
    if sum(hypothesis.chosen for hypothesis in document.hypotheses) > 1:
        raise ReadError("hypotheses: more than one is chosen")
    for k, reason in enumerate(document.reasons):
        check_reason(reason, f"reasons[{k}]")


def check_covariance(name: str, C: Array, *, is_part: bool = False) -> None:
    """Check a covariance (N, N); `name` is that of its field, and a part may have no variance.

    Raises
    ------
    ReadError
        Where it is none; says why.
    """
    fault = covariance_fault(C, is_part=is_part)
    if fault is not None:
        raise ReadError(f"{name}: {fault}")


def check_reason(reason: ReasonDoc, name: str) -> None:
    """Check the code and the numbers of a reason; `name` is that of its field.

    Raises
    ------
    ReadError
        Where the code is none, or a number is beyond `LARGEST`.
    """
    # One of another version is a code all the same, and comes with its message.
    if not CODE.fullmatch(reason.code):
        raise ReadError(f"{name}.code: {reason.code[:50]!r} is no code")
    for key, value in reason.values.items():
        if not isinstance(value, str) and not abs(value) <= LARGEST:
            raise ReadError(f"{name}.values[{key[:50]!r}]: beyond {LARGEST:g}")


def _stages(document: ResultDoc) -> Iterator[tuple[str, PoseEstimateDoc]]:
    """Every pose on the way that there is, with the name of its field."""
    for name, stage in (("poles", document.stages.poles), ("refined", document.stages.refined)):
        if stage is not None:
            yield f"stages.{name}", stage


def _poses(document: ResultDoc) -> Iterator[tuple[str, Pose]]:
    """Every pose with the name of its field."""
    if document.T_target_source is not None:
        yield "T_target_source", document.T_target_source
    for name, stage in _stages(document):
        yield f"{name}.T_target_source", stage.T_target_source
    for k, hypothesis in enumerate(document.hypotheses):
        yield f"hypotheses[{k}].T_target_source", hypothesis.T_target_source


def _covariances(document: ResultDoc) -> Iterator[tuple[str, Covariance, bool]]:
    """Every covariance with the name of its field, and whether it is but a part of another."""
    if document.covariance is not None:
        yield "covariance", document.covariance, False
    if document.uncertainty is not None:
        yield "uncertainty.random", document.uncertainty.random, True
        yield "uncertainty.systematic", document.uncertainty.systematic, True
    for name, stage in _stages(document):
        if stage.covariance is not None:
            yield f"{name}.covariance", stage.covariance, False
