"""What was checked of a site, as its result document holds it, and how it is written."""

from __future__ import annotations

from typing import Literal

import msgspec

from ..site.answer import LoopClosure, PairCheck, Test, WithoutPlacement
from . import ReasonDoc
from .bounded import Count, Number, Share, Size, Text
from .site_parts import Indices, finite, reason_document


class PairDoc(msgspec.Struct, frozen=True):
    """Two LiDARs, and how well they agree; `site.answer.PairCheck`."""

    lidars: tuple[Count, Count]
    shared_poles: Count
    standing: Count
    patches: Count
    w: Number | None
    refusal: ReasonDoc | None


class LoopDoc(msgspec.Struct, frozen=True):
    """What the pairwise poses around a loop fail to close by."""

    lidars: Indices
    rotation_rad: Size | None
    translation_m: Size | None
    chi2: Size | None
    freedom: Count
    probability: Share | None


class TestDoc(msgspec.Struct, frozen=True, kw_only=True):
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
    minimal_detectable_m: Size | None
    external_at_30m_m: Size | None


class WithoutDoc(msgspec.Struct, frozen=True):
    """Largest change of a pose without one placement, and whose; null where there is none then."""

    placement: Count
    rotation_rad: Size | None
    translation_m: Size | None
    lidar: Count | None


def pair_document(pair: PairCheck) -> PairDoc:
    """Write how well two LiDARs agree."""
    return PairDoc(
        pair.lidars,
        pair.shared_poles,
        pair.standing,
        pair.patches,
        finite(pair.w),
        None if pair.refusal is None else reason_document(pair.refusal),
    )


def loop_document(loop: LoopClosure) -> LoopDoc:
    """Write what a loop fails to close by."""
    return LoopDoc(
        list(loop.lidars),
        finite(loop.rotation),
        finite(loop.translation),
        finite(loop.chi2),
        loop.freedom,
        finite(loop.probability),
    )


def test_document(test: Test) -> TestDoc:
    """Write a test."""
    return TestDoc(
        kind=test.kind,
        name=test.name,
        lidar=test.lidar,
        placement=test.placement,
        pole=test.pole,
        chi2=finite(test.chi2),
        freedom=test.freedom,
        w=finite(test.w),
        redundancy=finite(test.redundancy),
        minimal_detectable_m=finite(test.minimal_detectable),
        external_at_30m_m=finite(test.external),
    )


def without_document(without: WithoutPlacement) -> WithoutDoc:
    """Write how the poses change without a placement."""
    return WithoutDoc(
        without.placement, finite(without.rotation), finite(without.translation), without.lidar
    )
