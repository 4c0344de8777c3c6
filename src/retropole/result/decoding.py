"""Reading a result document that may have been edited by hand, cut short or made elsewhere.

Whoever holds one that was decoded relies on it: every number is finite, rotations rotate,
covariances are covariances, and what refers to a pole finds one.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from ..base import se3
from ..base.bounded import Covariance, Direction, Number, PartCovariance, Pose, Vector
from ..base.datatypes import Array
from ..base.errors import ReadError
from ..base.uncertainty import covariance_fault
from . import COVARIANCE_ORDER, ResultDoc

UNIT = 1e-6
"""A direction is as long as 1 but for this."""

Document = TypeVar("Document")


def decode(data: bytes) -> ResultDoc:
    """Read a result document.

    Raises
    ------
    ReadError
        Where it is not one; names the field, and says what is wrong with it.
    """
    document = parsed(data, ResultDoc, "result document")
    answered = document.status != "refused"
    if answered != (document.T_target_source is not None):
        there = "no" if answered else "a"
        raise ReadError(f"T_target_source: {there} transform, and the status is {document.status}")
    if document.covariance_order != COVARIANCE_ORDER:
        raise ReadError(f"covariance_order: expected {' '.join(COVARIANCE_ORDER)}")
    if sum(hypothesis.chosen for hypothesis in document.hypotheses) > 1:
        raise ReadError("hypotheses: more than one is chosen")
    of_target, of_source = document.poles.target, document.poles.source
    for k, hypothesis in enumerate(document.hypotheses):
        for i, j in hypothesis.pairs:
            if i >= len(of_target) or j >= len(of_source):
                raise ReadError(
                    f"hypotheses[{k}].pairs: ({i}, {j}), there are {len(of_target)} poles of the "
                    f"target and {len(of_source)} of the source"
                )
    return document


def parsed(data: bytes, kind: type[Document], what: str) -> Document:
    """Read a document, and check of each field all that its type says.

    Raises
    ------
    ReadError
        Where it is not one; names the field.
    """
    try:
        return msgspec.json.decode(data, type=kind, dec_hook=_array)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ReadError(f"no {what}: {error}") from None


def _array(kind: Any, value: Any) -> Array:
    """Read an array of the kind that a field has."""
    rows, check = _ARRAYS[kind]
    try:
        array = np.array(msgspec.convert(value, rows), dtype=float)
        check(array)
    except (msgspec.ValidationError, ReadError) as error:
        # msgspec names the field of no other error.
        raise ValueError(str(error)) from None
    return array


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


def _check_unit(direction: Array) -> None:
    if abs(float(np.linalg.norm(direction)) - 1) > UNIT:
        raise ReadError("no unit vector")


def _row(size: int, of: Any = Number) -> Any:
    return Annotated[list[of], Meta(min_length=size, max_length=size)]


_ARRAYS: dict[Any, tuple[Any, Any]] = {
    Vector: (_row(3), lambda vector: None),
    Direction: (_row(3), _check_unit),
    Pose: (_row(4, _row(4)), se3.rigid),
    Covariance: (_row(6, _row(6)), partial(check_covariance, "covariance")),
    PartCovariance: (_row(6, _row(6)), partial(check_covariance, "covariance", is_part=True)),
    # How large it must be depends on other fields.
    Array: (list[list[Number]], lambda matrix: None),
}
"""Of each kind of array its rows in JSON, and what checks it."""
