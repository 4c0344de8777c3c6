"""The outcome of ``retropole certify`` as a separate JSON document.

Schema ``retropole/field-test/1``: metres, and numbers of placements and poles from 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec

from ..base.bounded import Share, Size, Text
from ..checking.certification import DistanceTest, FieldTest, PolesSeen, Verdict
from ..checking.distances import SpreadTest
from . import InputDoc, ReasonDoc, document_of, made_now

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
    """The test of all pairs of LiDARs: fail if one fails, refused if none could be tested, partial
    if some LiDARs, `untested`, are in no tested pair.

    Of a site file, `site` is its name, and `serials` are the serial numbers by the names of LiDARs.
    """

    schema: Literal["retropole/field-test/1"] = FIELD_TEST_SCHEMA
    status: Verdict
    alpha: Share
    radius_m: Size
    pairs: list[PairTestDoc]
    untested: list[Text] = []
    site: Text = ""
    serials: dict[Text, Text] = {}
    inputs: list[InputDoc]
    version: Text
    created: Text


def field_test_document(
    tests: Mapping[tuple[str, str], FieldTest],
    *,
    lidars: Sequence[str],
    radius: float,
    inputs: Sequence[InputDoc],
    site: str = "",
    serials: Mapping[str, str] | None = None,
) -> FieldTestDoc:
    """Write the tests of pairs of LiDARs as a document.

    Parameters
    ----------
    tests
        By the names of both LiDARs; at least one.
    lidars
        The names of all.
    radius
        Of the poles as given, metres.
    inputs
        The recordings.
    site, serials
        Name of the site, and serial numbers by the names of LiDARs, where they are known.
    """
    verdicts = {test.status for test in tests.values()}
    tested = {name for pair, test in tests.items() if test.status != "refused" for name in pair}
    untested = [name for name in lidars if name not in tested]
    status: Verdict = "partial" if untested else "pass"
    if "fail" in verdicts or not tested:
        status = "fail" if "fail" in verdicts else "refused"
    return document_of(
        FieldTestDoc,
        made_now(),
        status=status,
        untested=untested,
        site=site,
        serials=dict(serials or {}),
        alpha=next(iter(tests.values())).alpha,
        radius_m=radius,
        pairs=[
            document_of(PairTestDoc, test, target=target, source=source, variances=test.spread)
            for (target, source), test in tests.items()
        ],
        inputs=list(inputs),
    )
