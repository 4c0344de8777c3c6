"""The outcome of ``retropole certify`` as a JSON document of its own.

Schema ``retropole/field-test/1``: metres, and numbers of placements and poles from 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Literal

import msgspec

from ..base.bounded import Share, Size, Text
from ..base.version import __version__
from ..site.certification import DistanceTest, FieldTest, PolesSeen, Verdict
from ..site.repetition import SpreadTest
from . import ReasonDoc, reason_document
from .detected import InputDoc

FIELD_TEST_SCHEMA: Literal["retropole/field-test/1"] = "retropole/field-test/1"


class PairTestDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The test of two LiDARs."""

    target: Text
    source: Text
    status: Verdict
    reasons: list[ReasonDoc]
    poles: list[PolesSeen]
    distances: list[DistanceTest]
    z: Size | None
    variances: SpreadTest | None


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
        pairs=[
            PairTestDoc(
                target=target,
                source=source,
                status=test.status,
                reasons=[reason_document(reason) for reason in test.reasons],
                poles=list(test.poles),
                distances=list(test.distances),
                z=test.z,
                variances=test.spread,
            )
            for (target, source), test in tests.items()
        ],
        inputs=list(inputs),
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
