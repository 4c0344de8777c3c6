"""The outcome of ``retropole certify`` as a JSON document of its own.

Schema ``retropole/field-test/1``: metres, and numbers of placements and poles from 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Literal

import msgspec

from ..base.version import __version__
from ..site.certification import FieldTest
from ..site.repetition import Spread
from . import ReasonDoc
from .bounded import Count, Number, Share, Size, Text
from .detected import InputDoc

FIELD_TEST_SCHEMA: Literal["retropole/field-test/1"] = "retropole/field-test/1"

Verdict = Literal["pass", "fail", "refused"]


class DistanceDoc(msgspec.Struct, frozen=True, kw_only=True):
    """A distance between two poles as both LiDARs have it; each `u` is a standard uncertainty.

    `poles` are numbers in the target's list. `u_end_m` is that of one end of one of both distances:
    the difference has twice as much, and passes where it is at most ``limit_m = 2 u_end_m z``.
    """

    placement: Count
    poles: tuple[Count, Count]
    target_m: Size
    source_m: Size
    u_target_m: Size
    u_source_m: Size
    random_target_m: Size
    random_source_m: Size
    difference_m: Number
    u_end_m: Size
    limit_m: Size
    passed: bool


class SpreadDoc(msgspec.Struct, frozen=True):
    """How far distances scatter from sweep to sweep, 1 sigma; `variance` as a multiple of what the
    returns allow."""

    sweeps: Count
    sigma_m: Size
    variance: Size
    freedom: Size


class VariancesDoc(msgspec.Struct, frozen=True):
    """The F-test of equal variances: `ratio` passes from `low` to `high`."""

    target: SpreadDoc
    source: SpreadDoc
    ratio: Size
    low: Size
    high: Size
    probability: Share
    passed: bool


class PolesSeenDoc(msgspec.Struct, frozen=True):
    """How many poles of a placement each LiDAR sees, and how many are compared."""

    target: Count
    source: Count
    compared: Count


class PairTestDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The test of two LiDARs."""

    target: Text
    source: Text
    status: Verdict
    reasons: list[ReasonDoc]
    poles: list[PolesSeenDoc]
    distances: list[DistanceDoc]
    z: Size | None
    variances: VariancesDoc | None


class FieldTestDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The test of all pairs of LiDARs: fail where one fails, refused where none could be tested."""

    schema: Literal["retropole/field-test/1"] = FIELD_TEST_SCHEMA
    status: Verdict
    alpha: Share
    radius_m: Size
    pairs: list[PairTestDoc]
    inputs: list[InputDoc]
    version: Text
    created: Text


def field_test_document(
    tests: Mapping[tuple[str, str], FieldTest], *, radius: float, inputs: Sequence[InputDoc]
) -> FieldTestDoc:
    """Write the tests of pairs of LiDARs as a document.

    Parameters
    ----------
    tests
        By the names of both LiDARs; at least one.
    radius
        Of the poles as given, metres.
    inputs
        The recordings.
    """
    verdicts = {test.status for test in tests.values()}
    status: Verdict = "fail" if "fail" in verdicts else "pass" if "pass" in verdicts else "refused"
    return FieldTestDoc(
        status=status,
        alpha=next(iter(tests.values())).alpha,
        radius_m=radius,
        pairs=[_pair(names, test) for names, test in tests.items()],
        inputs=list(inputs),
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _pair(names: tuple[str, str], test: FieldTest) -> PairTestDoc:
    spread = test.spread
    return PairTestDoc(
        target=names[0],
        source=names[1],
        status=test.status,
        reasons=[ReasonDoc(r.code, r.message, dict(r.values)) for r in test.reasons],
        poles=[PolesSeenDoc(*counts) for counts in test.poles],
        distances=[
            DistanceDoc(
                placement=each.placement,
                poles=each.poles,
                target_m=each.lengths[0],
                source_m=each.lengths[1],
                u_target_m=each.sigma[0],
                u_source_m=each.sigma[1],
                random_target_m=each.random[0],
                random_source_m=each.random[1],
                difference_m=each.difference,
                u_end_m=each.u,
                limit_m=each.limit,
                passed=each.passed,
            )
            for each in test.distances
        ],
        z=test.z,
        variances=None
        if spread is None
        else VariancesDoc(
            _spread(spread.target),
            _spread(spread.source),
            spread.ratio,
            spread.low,
            spread.high,
            spread.probability,
            spread.passed,
        ),
    )


def _spread(each: Spread) -> SpreadDoc:
    return SpreadDoc(each.sweeps, each.sigma, each.variance, each.freedom)
