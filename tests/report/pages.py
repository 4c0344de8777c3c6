"""The pages that every law is held against: of a pair, a site and recordings."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from retropole.base.bounded import Status
from retropole.base.datatypes import PointCloud, Scan
from retropole.base.errors import Refusal
from retropole.report import render_recordings, render_report
from retropole.report.subject import Subject, as_subject
from tests.report.made_up import made_up
from tests.report.site.made_up import document_of, made_up_site

STATUSES: tuple[Status, ...] = ("ok", "warn", "refused")

of_each_kind = pytest.mark.parametrize("kind", ["pair", "site"])
with_each_verdict = pytest.mark.parametrize("status", STATUSES)


def cloud_of(count: int) -> PointCloud:
    """A cloud of which a tenth is bright, on a scale from 0 to 1."""
    rng = np.random.default_rng(7)
    level = np.where(np.arange(count) % 10 == 0, 0.9, rng.uniform(0.0, 0.4, count))
    return PointCloud(rng.uniform(-9.0, 9.0, (count, 3)), level)


@cache
def subject_of(kind: str, status: Status = "ok", count: int = 300) -> Subject:
    """Make up what a page is of."""
    if kind == "pair":
        return as_subject(*made_up(status, count))
    site = made_up_site(status, lidars=4, placements=2, count=count)
    return as_subject(document_of(site), site.scans)


@cache
def page_of(kind: str, status: Status = "ok", count: int = 300, notes: tuple[str, ...] = ()) -> str:
    """Render its page."""
    if kind == "recordings":
        target, source = made_up(status, count).placements[0].target, Scan(cloud_of(count))
        unsearched = Scan(target.cloud, refusal=Refusal("no_intensity", "it has none"))
        names = ("front.pcd", "rear.pcd", "flat.pcd")
        scans, texts = [target, source, unsearched], ("", "frames  1\nrings  64", "")
        return render_recordings(names, scans, texts)
    if kind == "pair":
        return render_report(*made_up(status, count), notes=notes)
    site = made_up_site(status, lidars=4, placements=2, count=count)
    return render_report(document_of(site), site.scans, notes=notes)
