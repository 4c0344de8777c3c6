"""The pages that every law is held against: of a pair and of a site, with every verdict."""

from __future__ import annotations

from functools import cache

import pytest

from retropole.base.bounded import Status
from retropole.report import render_report, render_site
from retropole.report.subject import Subject, of_pair, of_site
from tests.report.made_up import made_up
from tests.report.site.made_up import document_of, made_up_site

STATUSES: tuple[Status, ...] = ("ok", "warn", "refused")

of_each_kind = pytest.mark.parametrize("kind", ["pair", "site"])
with_each_verdict = pytest.mark.parametrize("status", STATUSES)


@cache
def subject_of(kind: str, status: Status = "ok", count: int = 300) -> Subject:
    """Make up what a page is of."""
    if kind == "pair":
        return of_pair(*made_up(status, count))
    site = made_up_site(status, lidars=4, placements=2, count=count)
    return of_site(document_of(site), site.scans)


@cache
def page_of(kind: str, status: Status = "ok", count: int = 300, notes: tuple[str, ...] = ()) -> str:
    """Render its page."""
    if kind == "pair":
        return render_report(*made_up(status, count), notes=notes)
    site = made_up_site(status, lidars=4, placements=2, count=count)
    return render_site(document_of(site), site.scans, notes=notes)
