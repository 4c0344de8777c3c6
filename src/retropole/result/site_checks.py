"""What was checked of a site, as its result document holds it: a number that is none is null."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import msgspec

from ..base.bounded import Count, Number, Share, Size, Text
from ..base.errors import Reason, Refusal
from ..site.answer import Indices
from . import ReasonDoc, finite, reason_document

Document = TypeVar("Document", bound=msgspec.Struct)


class PairDoc(msgspec.Struct, frozen=True):
    """Two LiDARs, and how well they agree; `site.answer.PairCheck`."""

    lidars: tuple[Count, Count]
    shared_poles: Count
    standing: Count
    patches: Count
    w: Number | None
    refusal: ReasonDoc | None


class LoopDoc(
    msgspec.Struct,
    frozen=True,
    rename={"rotation": "rotation_rad", "translation": "translation_m"},
):
    """What the pairwise poses around a loop fail to close by; `site.answer.LoopClosure`."""

    lidars: Indices
    rotation: Size | None
    translation: Size | None
    chi2: Size | None
    freedom: Count
    probability: Share | None


class TestDoc(
    msgspec.Struct,
    frozen=True,
    rename={"minimal_detectable": "minimal_detectable_m", "external": "external_at_30m_m"},
):
    """One observation, or what several share, tested against all others; `site.answer.Test`."""

    kind: Literal["pole", "placement", "lidar", "survey", "control point", "up"]
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


def check_document(kind: type[Document], check: Any) -> Document:
    """Write a check of a site, which has the fields of its document."""
    return kind(**{name: _written(getattr(check, name)) for name in kind.__struct_fields__})


def _written(value: Any) -> Any:
    if isinstance(value, Reason | Refusal):
        return reason_document(value)
    return finite(value) if isinstance(value, float) else value
