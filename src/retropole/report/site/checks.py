"""What was checked: loops, tests of every observation, and poses without each placement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...base.quantities import counted, error
from ...result.site import SiteDoc, TestDoc
from ..markup import MISSING, number, table
from .names import placement_name
from .pairs import LIMIT_W
from .verdict import probability

SHOWN = 12
"""So many loops and tests are shown at once, the worst first; the page unfolds the others."""

UNCHECKED = 0.01
"""Less redundancy than this is none: nothing would show an error there."""


def loops(document: SiteDoc) -> str:
    """List by how much the pairwise poses around each loop fail to close."""
    if not document.loops:
        return ""
    rows = [
        (
            " → ".join(document.lidars[k].name for k in (*loop.lidars, loop.lidars[0]))
            if loop.lidars
            else MISSING,
            number(loop.rotation, 3, 180 / np.pi),
            number(loop.translation, 1, 1000),
            number(loop.chi2, 1),
            loop.freedom,
            probability(loop.probability),
        )
        for loop in sorted(document.loops, key=lambda each: _or_one(each.probability))
    ]
    rest = rows[SHOWN:]
    header = ("loop", "rotation, deg", "translation, mm", "χ²", "freedom", "probability")
    return (
        '<section aria-labelledby="loops"><h2 id="loops">Loops</h2>'
        "<p>The poses of the pairs alone, one after the other around a loop, must lead back to "
        "where they started. χ² is how far they miss it, squared, in units of its covariance; the "
        "probability is that of missing by as much or more by chance.</p>"
        + table("Misclosures, the least likely first", header, rows[:SHOWN])
        + (
            f"<details><summary>{len(rest)} more</summary>"
            f"{table('The other loops', header, rest)}</details>"
            if rest
            else ""
        )
        + "</section>"
    )


def _or_one(value: float | None) -> float:
    return 1.0 if value is None else value


def tests(document: SiteDoc) -> str:
    """List the tests, the largest w first."""
    if not document.tests:
        return ""
    ordered = sorted(document.tests, key=lambda each: -abs(each.w or 0.0))
    shown, rest = ordered[:SHOWN], ordered[SHOWN:]
    folded = (
        f"<details><summary>{len(rest)} more</summary>{_tests('The other tests', rest)}</details>"
        if rest
        else ""
    )
    shares = [each.redundancy for each in ordered if each.redundancy is not None]
    blind = sum(share < UNCHECKED for share in shares)
    unchecked = (
        f"<p>Nothing checks {counted(blind, 'observation')}: an error there would not be seen.</p>"
        if blind
        else ""
    )
    return (
        '<section aria-labelledby="tests"><h2 id="tests">Tests</h2>'
        "<p>Every observation is tested against all others. A sound one has a |<i>w</i>| above "
        f"{LIMIT_W:g} once in a thousand times. Redundancy is the share of it that the others "
        "check; the smallest error to be found is found with a probability of 80 %, and the last "
        "column says by how much an unseen one would move a point 30 m away.</p>"
        + _tests("Tests, the largest |w| first", shown)
        + folded
        + unchecked
        + "</section>"
    )


def _tests(caption: str, tests: Sequence[TestDoc]) -> str:
    rows = [
        (
            test.name,
            test.kind,
            number(None if test.w is None else abs(test.w), 2)
            + (" stands out" if test.w is not None and abs(test.w) > LIMIT_W else ""),
            number(test.chi2, 1),
            test.freedom,
            number(test.redundancy, 0, 100, " %"),
            error(test.minimal_detectable),
            error(test.external),
        )
        for test in tests
    ]
    header = (
        *("observation", "kind", "|w|", "χ²", "freedom", "redundancy"),
        *("smallest error found", "effect at 30 m"),
    )
    return table(caption, header, rows, (1,))


def without(document: SiteDoc) -> str:
    """Say how the poses change without each placement."""
    if not document.without:
        return ""
    rows = [
        (
            placement_name(document.placements, each.placement),
            number(each.rotation, 3, 180 / np.pi),
            number(each.translation, 1, 1000),
            MISSING if each.lidar is None else document.lidars[each.lidar].name,
        )
        for each in document.without
    ]
    lost = any(each.rotation is None for each in document.without)
    note = (
        '<p class="note">A dash: without that placement the others give no poses.</p>'
        if lost
        else ""
    )
    header = ("without placement", "rotation, deg", "translation, mm", "of LiDAR")
    return (
        '<section aria-labelledby="placements"><h2 id="placements">Placements</h2>'
        "<p>Each placement was left out once: the figures are the largest change of a pose. A "
        "placement that stands out from the others deserves a look; switch it on in the view.</p>"
        + table("Change of the poses without each placement", header, rows, (3,))
        + note
        + "</section>"
    )
