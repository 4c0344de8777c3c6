"""Made-up runs whose every string is another that somebody chose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import msgspec

from retropole.base.bounded import Status
from retropole.base.datatypes import Placement, Scan
from retropole.report.subject import Scans
from retropole.result import ResultDoc
from retropole.result.site import SiteDoc
from tests.report.made_up import made_up
from tests.report.site.made_up import document_of, made_up_site


def everywhere(value: Any, text: Callable[[], str]) -> Any:
    """Put a text in place of every string of a document, names of values too."""
    if isinstance(value, str):
        return text()
    if isinstance(value, msgspec.Struct):
        fields = {name: everywhere(getattr(value, name), text) for name in value.__struct_fields__}
        return msgspec.structs.replace(value, **fields)
    if isinstance(value, dict):
        return {text(): everywhere(each, text) for each in value.values()}
    if isinstance(value, list | tuple):
        return type(value)(everywhere(each, text) for each in value)
    return value


def hostile_pair(
    status: Status, text: Callable[[], str], *, keeps_status: bool = True
) -> tuple[ResultDoc, list[Placement]]:
    """Make up a run of two placements."""
    result, placements = made_up(status, 200)
    config = msgspec.structs.replace(result.config, target_topic="/a", source_topic="/b")
    result = everywhere(msgspec.structs.replace(result, config=config), text)
    if keeps_status:
        result = msgspec.structs.replace(result, status=status)

    def scan(given: Scan) -> Scan:
        detection = given.detection
        assert detection is not None
        rejected = tuple(
            replace(r, code=cast("Any", text()), reason=text()) for r in detection.rejected
        )
        detection = replace(detection, rejected=rejected, threshold_source=text())
        return replace(given, detection=detection)

    hostile = [Placement(scan(p.target), scan(p.source)) for p in placements]
    return result, [*hostile, *hostile]


def hostile_site(
    status: Status, text: Callable[[], str], *, keeps_status: bool = True
) -> tuple[SiteDoc, Scans]:
    """Make up a site of three LiDARs."""
    calibration = made_up_site(status, lidars=3, placements=2, count=50)
    document = everywhere(document_of(calibration), text)
    if keeps_status:
        document = msgspec.structs.replace(document, status=status)
    return document, calibration.scans
