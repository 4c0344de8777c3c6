"""Reading result documents that may have been edited by hand, cut short or made by others.

Whoever uses one that was decoded relies on it: every number is finite, rotations rotate,
covariances are covariances that agree with each other, and every index finds what it points to.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from msgspec.structs import fields

from ..base import se3
from ..base.bounded import Covariance, Direction, Number, PartCovariance, Pose, Vector
from ..base.datatypes import Array
from ..base.errors import NewerError, ReadError, is_newer, printable, said
from ..base.uncertainty import covariance_fault, predicted_error
from . import COVARIANCE_ORDER, ResultDoc
from .pole_plan import PolePlanDoc, PredictedDoc, below
from .site import SITE_COVARIANCE_FRAME, SiteDoc, joint_order

UNIT = 1e-6
"""A direction is as long as 1 but for this."""

BLOCKS_AGREE = 1e-6
"""A LiDAR's covariance is its block of the joint one, but for this part of the largest number."""

LEANS_AGREE, ERRORS_AGREE = float(np.radians(2.5)), 1e-3
"""A pole leans as its direction does, rad, upright up to 2°; and an error is that of its
covariance, in parts."""

INDEX_OF = {
    **dict.fromkeys(("reference", "groups", "lidar", "lidars", "seen_by"), "lidars"),
    "placement": "placements",
    "pole": "poles",
    "surveyed": "surveyed_poles",
}
"""Fields with indices, wherever they are, and the list that each points into."""

Document = TypeVar("Document")


def decode(data: bytes) -> ResultDoc:
    """Read a result document.

    Raises
    ------
    ReadError
        If it is not one; names the field, and states what is wrong.
    """
    document = parsed(data, ResultDoc, "result document")
    _check_verdict(document, {"T_target_source": document.T_target_source})
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


def decode_site(data: bytes) -> SiteDoc:
    """Read the result document of a site.

    Raises
    ------
    ReadError
        If it is not one; names the field, and states what is wrong.
    """
    document = parsed(data, SiteDoc, "result document of a site")
    stated = {
        f"lidars[{k}].{name}": getattr(lidar, name)
        for k, lidar in enumerate(document.lidars)
        for name in ("T_site_lidar", "covariance")
    }
    _check_verdict(document, stated | {"joint_covariance": document.joint_covariance})
    _check_names(document)
    _check_indices(document)
    _check_joint(document)
    return document


def decode_plan(data: bytes) -> PolePlanDoc:
    """Read a plan of poles.

    Raises
    ------
    ReadError
        If it is not one; names the field, and states what is wrong.
    """
    plan = parsed(data, PolePlanDoc, "plan of poles")
    names = [lidar.name for lidar in plan.lidars]
    if len(set(names)) < len(names):
        raise ReadError("lidars: two have the same name")
    _check_planned_poles(plan, names)
    if (plan.moved is None) != bool(plan.predicted):
        expected = "none, since poles were moved" if plan.moved else "one of each but the first"
        raise ReadError(f"predicted: {len(plan.predicted)} LiDARs, expected {expected}")
    of = {"predicted": [each.lidar for each in plan.predicted]}
    if plan.moved is not None:
        of = {"moved.errors": [each.lidar for each in plan.moved.errors]}
    for field, given in of.items():
        if given != names[1:]:
            raise ReadError(f"{field}: expected one for each LiDAR but the first, in their order")
    for k, each in enumerate(plan.predicted):
        _check_prediction(f"predicted[{k}]", each, plan.predicted[0])
    return plan


def _check_planned_poles(plan: PolePlanDoc, lidars: Sequence[str]) -> None:
    """Check that every pole has a unique name, points up, and is seen by LiDARs of the plan."""
    of_poles = [pole.name for placement in plan.placements for pole in placement.poles]
    if len(set(of_poles)) < len(of_poles):
        raise ReadError("placements: two poles have the same name")
    for name in () if plan.moved is None else plan.moved.poles:
        if name not in of_poles:
            raise ReadError(f"moved.poles: no pole is named {printable(name)}")
    for p, placement in enumerate(plan.placements):
        for k, pole in enumerate(placement.poles):
            field, seers = f"placements[{p}].poles[{k}]", [each.lidar for each in pole.seen]
            lean = float(np.arccos(np.clip(pole.direction[2], -1.0, 1.0)))
            if lean > np.pi / 2 or abs(lean - pole.lean_rad) > LEANS_AGREE:
                raise ReadError(
                    f"{field}.lean_rad: {pole.lean_rad:.3g} rad, its direction leans by "
                    f"{lean:.3g} rad from upright"
                )
            if len(set(seers)) < len(seers) or not set(seers) <= set(lidars):
                raise ReadError(f"{field}.seen: expected LiDARs of the plan, each once")
        ends = {pole.name for pole in placement.poles}
        starts = ends | {below(name) for name in lidars}
        for k, tape in enumerate(placement.tape):
            if tape.start not in starts or tape.end not in ends:
                raise ReadError(
                    f"placements[{p}].tape[{k}]: expected from a pole or below a LiDAR to a pole"
                )


def _check_prediction(field: str, each: PredictedDoc, first: PredictedDoc) -> None:
    """Check that the errors are those of the covariance, at the ranges of the first LiDAR's."""
    ranges = tuple(one.range_m for one in first.predicted_error)
    if not ranges or any(a >= b for a, b in pairwise(ranges)):
        raise ReadError(f"{field}.predicted_error: expected ranges, each larger than the last")
    for name in ("predicted_error", "alone"):
        if tuple(one.range_m for one in getattr(each, name)) != ranges:
            raise ReadError(f"{field}.{name}: expected the ranges of predicted[0].predicted_error")
        if not all(one.sigma_m > 0 for one in getattr(each, name)):
            raise ReadError(f"{field}.{name}: sigma_m is 0, expected more")
    if len(each.bounds_m) != len(ranges):
        raise ReadError(f"{field}.bounds_m: expected one for each range")
    for one, other in zip(
        each.predicted_error, predicted_error(each.covariance, ranges), strict=True
    ):
        if abs(one.sigma_m - other.sigma_m) > ERRORS_AGREE * other.sigma_m:
            raise ReadError(
                f"{field}.predicted_error: {one.sigma_m:.3g} m at {one.range_m:g} m, by its "
                f"covariance it is {other.sigma_m:.3g} m"
            )


def _check_verdict(document: ResultDoc | SiteDoc, stated: Mapping[str, Array | None]) -> None:
    """Check that every answer exists, under its name, unless the run was refused."""
    for name, array in stated.items():
        if (document.status == "refused") != (array is None):
            there = "there is one" if array is not None else "none"
            raise ReadError(f"{name}: {there}, and the status is {document.status}")
    if document.covariance_order != COVARIANCE_ORDER:
        raise ReadError(f"covariance_order: expected {' '.join(COVARIANCE_ORDER)}")


def _check_names(document: SiteDoc) -> None:
    """Check that every LiDAR has a unique name, which names its rows of the joint covariance."""
    names = [lidar.name for lidar in document.lidars]
    if len(set(names)) < len(names):
        raise ReadError("lidars: two have the same name")
    if document.covariance_frame != SITE_COVARIANCE_FRAME:
        raise ReadError(f"covariance_frame: expected {SITE_COVARIANCE_FRAME}")
    if document.joint_order != joint_order(names):
        raise ReadError("joint_order: expected six rows for each LiDAR, in their order")


def _check_indices(document: SiteDoc) -> None:
    """Check that every index is that of a LiDAR, a placement or a pole."""
    for name, of, index in _indices(document):
        count = len(getattr(document, of))
        if index >= count:
            raise ReadError(f"{name}: {index}, there are {count}")
    for k, pair in enumerate(document.pairs):
        if pair.lidars[0] >= pair.lidars[1]:
            raise ReadError(f"pairs[{k}].lidars: expected two, the lower first")
    grouped = [index for group in document.groups for index in group]
    if grouped and sorted(grouped) != list(range(len(document.lidars))):
        raise ReadError("groups: every LiDAR is in one group")
    rows = {"found": (len(document.found), len(document.lidars))} if document.found else {}
    rows |= {
        f"found[{k}]": (len(row), len(document.placements)) for k, row in enumerate(document.found)
    }
    for name, (count, expected) in rows.items():
        if count != expected:
            raise ReadError(f"{name}: {count} entries, expected {expected}")
    recorded = {(each.lidar, each.placement) for each in document.inputs}
    if len(recorded) < len(document.inputs):
        raise ReadError("inputs: two of the same LiDAR and placement")


def _indices(value: Any, name: str = "", of: str = "") -> Iterator[tuple[str, str, int]]:
    """Every index: the name of its field, the list that it points into, and the index."""
    if isinstance(value, msgspec.Struct):
        for field in value.__struct_fields__:
            place = f"{name}.{field}" if name else field
            yield from _indices(getattr(value, field), place, INDEX_OF.get(field, ""))
    elif isinstance(value, list | tuple):
        for k, each in enumerate(value):
            yield from _indices(each, f"{name}[{k}]", of)
    elif of and type(value) is int:
        yield name, of, value


def _check_joint(document: SiteDoc) -> None:
    """Check the joint covariance, and that it contains those of the LiDARs."""
    joint = document.joint_covariance
    if joint is None:
        return
    size = 6 * len(document.lidars)
    if joint.shape != (size, size):
        raise ReadError(f"joint_covariance: expected {size} rows of {size} numbers")
    check_covariance("joint_covariance", joint, is_part=True)
    for k, lidar in enumerate(document.lidars):
        block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert lidar.covariance is not None
        if np.abs(lidar.covariance - block).max() > BLOCKS_AGREE * np.abs(block).max():
            raise ReadError(f"lidars[{k}].covariance: not its block of joint_covariance")


def parsed(data: bytes, kind: type[Document], what: str) -> Document:
    """Read a document, and check of each field all that its type says.

    Raises
    ------
    ReadError
        If it is not one; names the field.
    """
    try:
        return msgspec.json.decode(data, type=kind, dec_hook=_array)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            schema = msgspec.json.decode(data, type=_Head).schema
            own: Any = kind
            if is_newer(schema, next(f.default for f in fields(own) if f.name == "schema")):
                raise NewerError(f"schema {schema!r}") from None
        raise ReadError(f"no {what}: {said(error)}") from None


class _Head(msgspec.Struct):
    """What any document begins with."""

    schema: str


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
        If it is none; says why.
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
