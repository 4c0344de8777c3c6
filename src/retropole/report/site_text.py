"""The result of a site in words, for a terminal: pure functions from the document to text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.errors import printable, shortened
from ..base.quantities import UNKNOWN, error
from ..result.site import SiteDoc
from .certainty import LIMIT_W, far_error, probability
from .checks import UNCHECKED
from .layout import LINES, WIDTH, legible, table, wrapped
from .text import input_lines, reasons_whole, reasons_within

LONGEST_NAME = 20
"""Characters of a LiDAR's name in a table; the middle of a longer one is left out."""

NAMED = 3
"""So many observations that stand out are named; the report lists them all."""


class PoseRow(NamedTuple):
    """Where a LiDAR is, in words; `sigma` is that of a point 30 m away, metres, None for none."""

    name: str
    x: str
    y: str
    z: str
    roll: str
    pitch: str
    yaw: str
    sigma: float | None


def pose_rows(document: SiteDoc) -> list[PoseRow]:
    """Write each pose in the frame's own coordinates, degrees; none where refused."""
    rows = []
    for lidar in document.lidars:
        if lidar.T_site_lidar is None:
            continue
        T = np.array(lidar.T_site_lidar)
        at = T[:3, 3] + document.frame.offset
        angles = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
        # A rounded zero has no sign.
        x, y, z = (f"{v + 0.0:.3f}" for v in np.round(at, 3))
        roll, pitch, yaw = (f"{v + 0.0:.2f}" for v in np.round(angles, 2))
        rows.append(PoseRow(lidar.name, x, y, z, roll, pitch, yaw, far_error(lidar)))
    return rows


def describe_site(
    document: SiteDoc,
    written: Sequence[str],
    following: Mapping[str, str] | None = None,
    *,
    verbose: bool = False,
) -> str:
    """Write the result of a site as a person reads it: the verdict first, and a screen at most.

    Parameters
    ----------
    document
        The result document.
    written
        Paths of the files that hold it.
    following
        Commands to type next where there are poses, by the words that introduce each.
    verbose
        Whether what was read, every pair, loop and test, and the time of each step are written as
        well, on as many lines as it takes.
    """
    document = legible(document)
    answered = document.status != "refused"
    head = [f"verdict: {document.status}", *_fitness(document)]
    checked = [] if not answered else [part for x in _checks(document) for part in wrapped(x, "  ")]
    tail = ["", "written: " + ", ".join(map(printable, written))]
    if answered:
        tail += [f"{lead}: {printable(words)}" for lead, words in (following or {}).items()]
    body = [part for line in _frame(document) for part in wrapped(line, "  ")]
    if verbose:
        reasons = reasons_whole(document.status, document.reasons)
        poses = _poses(document, len(document.lidars))
        checked += _every_check(document)
        found = ["", *_found(document, len(document.inputs)), *_read(document)]
    else:
        room = LINES - len(head) - len(body) - len(checked) - len(tail) - 2
        # Header and at least three rows of what was found or where the LiDARs are.
        least = min(len(document.lidars), 3) + 2
        reasons = reasons_within(
            document.status, document.reasons, room - least, "site-report.html"
        )
        left = room - len(reasons)
        poses = _poses(document, left - 1)
        found = [] if answered else _found(document, left - 1)
    blank = [""] if checked else []
    return "\n".join([*head, *reasons, "", *body, *poses, *found, *blank, *checked, *tail])


def _fitness(document: SiteDoc) -> list[str]:
    """Say whether every pose is as accurate as was asked for; where it is not, a reason does."""
    asked = [each.fitness for each in document.lidars if each.fitness is not None]
    if not asked or any(each.answer != "yes" for each in asked):
        return []
    need = f"within {100 * asked[0].within_m:g} cm at {asked[0].at_m:g} m"
    return [f"  {need}: yes, every LiDAR"]


def _frame(document: SiteDoc) -> Iterator[str]:
    """Say what the coordinates are, what fixes them, and who is linked with whom."""
    if document.status != "refused":
        yield f"frame: {document.frame.name}; datum: {document.datum}"
    if len(document.groups) > 1:
        names = [", ".join(document.lidars[k].name for k in group) for group in document.groups]
        yield f"not linked with each other: {' | '.join(names)}"


def _poses(document: SiteDoc, room: int) -> list[str]:
    """Lay out where the LiDARs are, as many as there is room for."""
    rows = pose_rows(document)
    if not rows:
        return []
    every = [
        [
            shortened(row.name, LONGEST_NAME),
            *row[1:7],
            f"± {error(row.sigma)}" if row.sigma else UNKNOWN,
        ]
        for row in rows
    ]
    header = ["LiDAR", "x m", "y m", "z m", "roll°", "pitch°", "yaw°", "1 σ at 30 m"]
    lines = table(header, every).split("\n")
    if max(map(len, lines)) > WIDTH:
        # Large coordinates leave no room for the angles.
        lines = table([*header[:4], header[7]], [[*row[:4], row[7]] for row in every]).split("\n")
    return _shown(lines, room)


def _shown(lines: list[str], room: int) -> list[str]:
    """Cut a table, its header first, to the lines that there is room for."""
    if len(lines) <= room + 1:
        return lines
    kept = lines[: max(room, 2)]
    return [*kept, f"  and {len(lines) - len(kept)} more; -v lists them"]


def _found(document: SiteDoc, room: int) -> list[str]:
    """Count the poles that each LiDAR sees in each placement."""
    if not document.found:
        return []
    # A run that was refused early has looked at no recording.
    counts = [
        [
            UNKNOWN if each is None or each.threshold is None else f"{len(each.poles)}"
            for each in row
        ]
        for row in document.found
    ]
    if all(count == UNKNOWN for row in counts for count in row):
        return []
    rows = [
        [shortened(lidar.name, LONGEST_NAME), *row]
        for lidar, row in zip(document.lidars, counts, strict=True)
    ]
    header = ["poles found", *(shortened(name, 12) for name in document.placements)]
    lines = table(header, rows).split("\n")
    if max(map(len, lines)) > WIDTH:
        return []
    return _shown(lines, room)


def _checks(document: SiteDoc) -> Iterator[str]:
    """Say in a line each what pairs, loops, tests and placements showed."""
    pairs, names = document.pairs, [lidar.name for lidar in document.lidars]
    if pairs:
        by_itself = sum(pair.standing == 1 for pair in pairs)
        decided = sum(pair.standing > 1 for pair in pairs)
        linked = len(pairs) - by_itself - decided
        counts = (
            (by_itself, "decided by themselves"),
            (decided, "decided by others"),
            (linked, "linked through others"),
        )
        yield f"pairs: {', '.join(f'{n} {what}' for n, what in counts if n)}"
    loops = [loop for loop in document.loops if loop.probability is not None]
    if loops:
        worst = min(loops, key=lambda loop: loop.probability or 0.0)
        around = " → ".join(names[k] for k in (*worst.lidars, *worst.lidars[:1]))
        yield (
            f"loops: {len(loops)}; the least likely, {around}, misses by "
            f"{error(worst.translation)} and {error(worst.rotation, 'rad')}, "
            f"probability {probability(worst.probability)}"
        )
    elif len(names) > 2:
        yield "loops: none closed; no third LiDAR checks a pair"
    yield from _tests(document)
    moved = [each for each in document.without if each.translation is not None]
    if moved:
        most = max(moved, key=lambda each: each.translation or 0.0)
        whose = "" if most.lidar is None else f" of {names[most.lidar]}"
        yield (
            f"without one placement: at most {error(most.translation)} and "
            f"{error(most.rotation, 'rad')}{whose}, without placement "
            f"{document.placements[most.placement]}"
        )


def _tests(document: SiteDoc) -> Iterator[str]:
    """Name what stands out of the tests, and count what nothing checks."""
    tests = sorted(
        (each for each in document.tests if each.w is not None), key=lambda each: -abs(each.w or 0)
    )
    if not tests:
        yield "tests: none; nothing checks these poses"
        return
    high = [each for each in tests if abs(each.w or 0.0) > LIMIT_W]
    named = [f"{each.name} (w {abs(each.w or 0.0):.1f})" for each in (high or tests)[:NAMED]]
    if high:
        rest = f" and {len(high) - NAMED} more" if len(high) > NAMED else ""
        yield f"tests: {len(tests)}; beyond w {LIMIT_W:g}: {', '.join(named)}{rest}"
    else:
        yield f"tests: {len(tests)}; none beyond w {LIMIT_W:g}, the largest: {named[0]}"
    blind = [each for each in tests if each.redundancy is not None and each.redundancy < UNCHECKED]
    if blind:
        yield f"unchecked: {len(blind)} of the tests would not show an error"


def _every_check(document: SiteDoc) -> list[str]:
    """Lay out every pair, loop and test."""
    names, lines = [shortened(lidar.name, LONGEST_NAME) for lidar in document.lidars], []
    if document.pairs:
        rows = [
            [
                f"{names[pair.lidars[0]]} – {names[pair.lidars[1]]}",
                str(pair.shared_poles),
                str(pair.standing),
                str(pair.patches),
                _number(pair.w),
            ]
            for pair in document.pairs
        ]
        header = ("pair", "poles\nshared", "hypotheses\nstanding", "patches", "w")
        lines += ["", *table(header, rows).split("\n")]
    if document.tests:
        rows = [
            [
                each.name,
                _number(each.w),
                UNKNOWN if each.redundancy is None else f"{each.redundancy:.2f}",
                error(each.minimal_detectable),
                error(each.external),
            ]
            for each in sorted(document.tests, key=lambda each: -abs(each.w or 0.0))
        ]
        header = ("observation", "w", "redundancy", "smallest\nfound", "its effect\nat 30 m")
        lines += ["", *table(header, rows).split("\n")]
    return lines


def _number(value: float | None) -> str:
    return UNKNOWN if value is None else f"{abs(value):.2f}"


def _read(document: SiteDoc) -> list[str]:
    """Say what was read, and how long each step took."""
    lines = [""]
    for each in document.inputs:
        name = f"{document.lidars[each.lidar].name}, {document.placements[each.placement]}:"
        lines += input_lines(name, each)
    if document.seconds:
        times = ", ".join(f"{name} {value:.2f} s" for name, value in document.seconds.items())
        lines += ["", *wrapped(f"time: {times}", "      ")]
    return lines
