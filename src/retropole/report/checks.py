"""What was checked: loops, tests of every observation, and poses without each placement."""

from __future__ import annotations

import numpy as np

from ..base.quantities import UNKNOWN, counted, error
from ..result.site import SiteDoc
from .certainty import LIMIT_W, around, probability
from .markup import long_table, number, table
from .page import Html, fill
from .subject import Subject

UNCHECKED = 0.01
"""Less redundancy than this is none: nothing would show an error there."""


def loops(site: SiteDoc) -> Html:
    """List by how much the pairwise poses around each loop fail to close."""
    if not site.loops:
        return Html("")
    ordered = sorted(
        site.loops, key=lambda loop: 1.0 if loop.probability is None else loop.probability
    )
    rows = [
        (
            around(site, loop),
            number(loop.rotation, 3, 180 / np.pi),
            number(loop.translation, 1, 1000),
            number(loop.chi2, 1),
            loop.freedom,
            probability(loop.probability),
        )
        for loop in ordered
    ]
    header = ("loop", "rotation, deg", "translation, mm", "χ²", "freedom", "probability")
    captions = ("Misclosures, the least likely first", "The other loops")
    return fill("loops", table=long_table(captions, header, rows))


def tests(site: SiteDoc) -> Html:
    """List the tests, the largest w first."""
    if not site.tests:
        return Html("")
    rows = [
        (
            test.name,
            test.kind,
            size_of(test.w, 2),
            number(test.chi2, 1),
            test.freedom,
            number(test.redundancy, 0, 100, " %"),
            error(test.minimal_detectable),
            error(test.external),
        )
        for test in sorted(site.tests, key=lambda test: -abs(test.w or 0.0))
    ]
    header = (
        *("observation", "kind", "|w|", "χ²", "freedom", "redundancy"),
        *("smallest error found", "effect at 30 m"),
    )
    captions = ("Tests, the largest |w| first", "The other tests")
    blind = unchecked(site)
    return fill(
        "tests",
        limit=f"{LIMIT_W:g}",
        table=long_table(captions, header, rows, (1,)),
        blind=fill("unchecked", count=counted(blind, "observation")) if blind else "",
    )


def size_of(w: float | None, digits: int) -> str:
    """Write the size of a w, and whether it stands out."""
    said = number(None if w is None else abs(w), digits)
    return said + (" stands out" if w is not None and abs(w) > LIMIT_W else "")


def unchecked(site: SiteDoc) -> int:
    """Count the tests that would not show an error."""
    return sum(each.redundancy is not None and each.redundancy < UNCHECKED for each in site.tests)


def without(subject: Subject) -> Html:
    """Say how the poses change without each placement."""
    site = subject.site
    if not site.without:
        return Html("")
    rows = [
        (
            subject.placement(each.placement),
            number(each.rotation, 3, 180 / np.pi),
            number(each.translation, 1, 1000),
            UNKNOWN if each.lidar is None else site.lidars[each.lidar].name,
        )
        for each in site.without
    ]
    header = ("without placement", "rotation, deg", "translation, mm", "of LiDAR")
    lost = any(each.rotation is None for each in site.without)
    return fill(
        "placements",
        table=table("Change of the poses without each placement", header, rows, (3,)),
        lost=fill("lost") if lost else "",
    )
