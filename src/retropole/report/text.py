"""A result, or the content of a recording, as text for a terminal: from documents to text.

Tables, and lines that are broken at the width of the screen; nothing that steers a terminal.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import msgspec
import numpy as np

from ..base import se3
from ..base.clocks import words_of
from ..base.datatypes import Array
from ..base.errors import printable, shortened
from ..base.quantities import UNKNOWN, counted
from ..base.reasons import explain, page, plain
from ..base.sensors import LITTLE, SENSORS
from ..result import REPORT_FILE, SITE_REPORT_FILE, InputDoc, ReasonDoc, ResultDoc
from ..result.contents import CloudDoc, DetectionDoc, InfoDoc, IntensityDoc
from ..result.site import SiteDoc
from . import listings
from .hypotheses import describe_undecided, margin_words, tried_words
from .listings import (
    POLE_COLUMNS,
    Listing,
    columns,
    fitness_words,
    left_out_words,
    numbers,
    pole_row,
    statements,
)
from .subject import Subject, as_subject, recorded_by
from .verdict import instead_words

WIDTH, LINES = 80, 40
"""Columns and lines of a screen. No path and no command is cut: they are copied."""

VALUE_SPACE = re.compile(r"(?<=±) | (?=±)|(?<=\d) (?=(?:mm|cm|m|s|deg|σ|%)(?!\w))")
"""Spaces at which no line is broken: a value stays with its error and its unit."""


def legible(value: Any) -> Any:
    """Write every text of a document so that it steers no terminal and stays on its line."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, msgspec.Struct):
        fields = {name: legible(getattr(value, name)) for name in value.__struct_fields__}
        return msgspec.structs.replace(value, **fields)
    if isinstance(value, dict):
        return {legible(key): legible(each) for key, each in value.items()}
    return type(value)(map(legible, value)) if isinstance(value, list | tuple) else value


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Arrange rows under a header, each column as wide as it needs, numbers to the right.

    A name of the header may have several lines, one for each word where a screen is too narrow.
    """
    cells = [[str(cell) for cell in row] for row in rows]
    longest = [max(len(row[k]) for row in cells) for k in range(len(header))]
    broken = [
        name if len(name) <= most else name.replace(" ", "\n")
        for name, most in zip(header, longest, strict=True)
    ]
    for names in (header, broken):
        heads = zip_longest(*(name.split("\n") for name in names), fillvalue="")
        whole = [*map(list, heads), *cells]
        widths = [max(len(row[k]) for row in whole) for k in range(len(header))]
        if sum(widths) + 2 * len(widths) <= WIDTH:
            break
    lines = []
    for first, *others in whole:
        right = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        lines.append("  " + "  ".join([first.ljust(widths[0]), *right]).rstrip())
    return "\n".join(lines)


def wrapped(line: str, indent: str) -> list[str]:
    """Break a line of words at the width of a screen; what follows the first is indented."""
    kept = VALUE_SPACE.sub("\N{NO-BREAK SPACE}", line)
    lines = textwrap.wrap(
        kept, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [each.replace("\N{NO-BREAK SPACE}", " ") for each in lines]


ACTIONS = 2
"""How many actions are named of what to do about a reason; the report lists them all."""

FEW_LISTED = 3
"""Rejected clusters that are listed where none is conspicuous."""

LONGEST_NAME = 20
"""Characters of a LiDAR's name in a table; the middle of a longer one is left out."""


def input_lines(name: str, document: InputDoc) -> list[str]:
    """State what was read from a recording, and what was left out."""
    threshold = "none" if document.threshold is None else f"{document.threshold:g}"
    left_out = left_out_words(document)
    line = (
        f"{name}  {document.path}: {counted(document.points, 'point')} ({document.dropped:,} "
        f"dropped"
        f"{', ' + left_out if left_out else ''}), "
        f"sensor {document.sensor}, threshold {threshold}"
    )
    notes = [part for note in document.notes for part in wrapped(f"  {note}", "    ")]
    return [*wrapped(line, " " * (len(name) + 2)), *notes]


def transform_lines(T: Array) -> list[str]:
    """Write a 4×4 transform as matrix, translation, quaternion and angles."""
    rows = ["  [" + " ".join(f"{value:12.8f}" for value in row) + "]" for row in T]
    x, y, z = (f"{v:.4f}" for v in T[:3, 3])
    q = "  ".join(
        f"{n} {v:.8f}" for n, v in zip("xyzw", se3.quaternion_xyzw(T[:3, :3]), strict=True)
    )
    roll, pitch, yaw = (f"{v:.4f}" for v in np.degrees(se3.rpy_from_rotation(T[:3, :3])))
    return [
        *rows,
        f"  translation  x {x}  y {y}  z {z} m",
        f"  quaternion   {q}",
        f"  angles       roll {roll}  pitch {pitch}  yaw {yaw} deg",
    ]


def describe_result(
    document: ResultDoc | SiteDoc,
    written: Sequence[str],
    following: Mapping[str, str] | None = None,
    *,
    verbose: bool = False,
) -> str:
    """Write a result as a person reads it: the verdict first, and at most a screen.

    Parameters
    ----------
    document
        The result document, of a pair or of a site.
    written
        Paths of the files that hold it.
    following
        Commands to type next where there is a transform to use, by the words that introduce each.
    verbose
        Whether the inputs, all that was found and tried and the time of each step are written as
        well, on as many lines as it takes.
    """
    subject = as_subject(legible(document))
    report = REPORT_FILE if subject.pair else SITE_REPORT_FILE
    site, pair = subject.site, subject.pair
    answered = subject.answered
    head = [f"verdict: {site.status}"]
    # Where it is not yes, a reason says so.
    requested = [each.fitness.answer for each in site.lidars if each.fitness is not None]
    if requested and set(requested) == {"yes"}:
        head += wrapped(f"  {fitness_words(subject)}", "    ")
    undecided = [] if pair is None else describe_undecided(pair)
    head_end = [part for line in undecided for part in wrapped(line, "      ")]
    text = [
        part for x in statements(subject, verbose=verbose) for part in wrapped(f"  {x}", "    ")
    ]
    tail = ["", "written: " + ", ".join(map(printable, written))]
    instead = plain(instead_words(subject))
    if instead:
        tail += wrapped(f"what to do instead: {instead}", "  ")
    elif answered:
        tail += [f"{lead}: {printable(command)}" for lead, command in (following or {}).items()]
    if verbose:
        reasons = reasons_whole(site.status, [*site.reasons, *site.notes])
        poses, found = _poses(subject, len(site.lidars) + 2), [*_found(subject), *_more(subject)]
    else:
        room = LINES - len(head) - len(head_end) - len(text) - len(tail)
        # Header and at least three rows of what was found or where the LiDARs are.
        least = 13 if pair is not None and answered else min(len(site.lidars), 3) + 3
        reasons = reasons_within(site.status, site.reasons, room - least, report)
        reasons += _notes_line(site.notes)
        poses = _poses(subject, room - len(reasons))
        left = room - len(reasons) - len(poses)
        found = _cut(_found(subject), left) if pair is not None or not answered else []
    return "\n".join([*head, *reasons, *head_end, *poses, *text, *found, *tail])


def _poses(subject: Subject, room: int) -> list[str]:
    """Write the pose of a pair, or where the LiDARs are, as many as there is room for."""
    site, pair = subject.site, subject.pair
    if pair is not None:
        T = pair.T_target_source
        target, source = recorded_by(pair)
        title = wrapped(f"T_target_source maps points of {source} into the frame of {target}", "  ")
        return [] if T is None else ["", *title, *transform_lines(T)]
    listing = listings.poses(site)
    rows = [[shortened(str(name), LONGEST_NAME), *row] for name, *row in listing.rows]
    listing = Listing("", listing.header, rows)
    lines = _lines(listing.only(*range(8)))
    if max(map(len, lines), default=0) > WIDTH:
        # Large coordinates leave no room for the angles.
        lines = _lines(listing.only(0, 1, 2, 3, 7))
    return _cut(lines, room)


def _found(subject: Subject) -> list[str]:
    """List the poles of a pair or its placements, or count the poles that each LiDAR sees."""
    site, pair = subject.site, subject.pair
    if pair is not None:
        if len(pair.placements) > 1:
            return _lines(listings.changes(subject))
        rows = [row for k in range(2) for row in listings.poles(subject, k).rows]
        return _lines(Listing("", columns(POLE_COLUMNS), rows))
    # A run that was refused early has looked at no recording.
    counts = [
        [
            UNKNOWN if each is None or each.threshold is None else f"{len(each.poles)}"
            for each in of_lidar
        ]
        for of_lidar in site.found
    ]
    names = [shortened(lidar.name, LONGEST_NAME) for lidar in site.lidars]
    header = ["poles found", *(shortened(name, 12) for name in site.placements)]
    lines = _lines(Listing("", header, [[n, *c] for n, c in zip(names, counts, strict=False)]))
    looked = any(count != UNKNOWN for row in counts for count in row)
    return lines if looked and max(map(len, lines)) <= WIDTH else []


def _more(subject: Subject) -> list[str]:
    """Write what a screen has no room for: every check, inputs, the time of each step."""
    site, pair, lines = subject.site, subject.pair, []
    if pair is not None:
        lines += _lines(listings.hypotheses(pair))
        lines += [f"  {margin}" for margin in [margin_words(pair)] if margin]
    else:
        lines += _lines(listings.changes(subject))
    tried = tried_words(site.reasons)
    lines += wrapped(f"  {tried}", "    ") if tried else []
    lines += _lines(listings.pairs(site))
    lines += _lines(listings.loops(site))
    lines += _lines(listings.tests(site).only(0, 2, 3, 6, 7, 8))
    lines.append("")
    for each in site.inputs:
        several = f", {subject.placement(each.placement)}" if len(site.placements) > 1 else ""
        lines += input_lines(site.lidars[each.lidar].name + several, each)
    if site.seconds:
        times = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in site.seconds.items())
        lines += ["", *wrapped(f"time: {times}", "      ")]
    return lines


def _lines(listing: Listing) -> list[str]:
    """Arrange a table and its caption below a blank line; nothing if it has no rows."""
    caption, header, rows, _ = listing
    if not rows:
        return []
    return ["", *([caption] if caption else []), *table(header, rows).split("\n")]


def _cut(lines: list[str], room: int) -> list[str]:
    """Keep as many lines of a table, its header first, as there is room for."""
    if len(lines) <= room:
        return lines
    kept = lines[: max(room - 1, 2)]
    return [*kept, f"  and {len(lines) - len(kept)} more; -v lists them"]


def reasons_whole(status: str, reasons: Sequence[ReasonDoc], actions: int = ACTIONS) -> list[str]:
    """Write reasons, what to do about each and, of a refusal, where to read on."""
    lines = []
    for reason in reasons:
        lines += reason_lines(reason, actions)
        if status == "refused" and explain(reason.code) is not None:
            lines.append(f"    read on: {page(reason.code)}")
    return lines


def reasons_within(status: str, reasons: Sequence[ReasonDoc], room: int, report: str) -> list[str]:
    """Write every reason, with as much of what to do as there is room for."""
    for actions in range(ACTIONS, 0, -1):
        lines = reasons_whole(status, reasons, actions)
        if len(lines) <= room:
            return lines
    lines = [f"  what to do about each: -v, or {report}"]
    whole = [line for reason in reasons for line in reason_lines(reason, 0)]
    if len(whole) < room:
        return whole + lines
    cut = [shortened(f"  {reason.code}: {reason.message}", WIDTH) for reason in reasons]
    # Never fewer than one: a verdict without its reason gives no information.
    shown = cut if len(cut) < room else cut[: max(room - 2, 1)]
    if len(shown) < len(cut):
        shown.append(f"  and {counted(len(cut) - len(shown), 'more reason')}")
    return shown + lines


def _notes_line(notes: Sequence[ReasonDoc]) -> list[str]:
    """Name the notes, on one line."""
    codes = ", ".join(dict.fromkeys(note.code for note in notes))
    return [shortened(f"  notes (-v says more): {codes}", WIDTH)] if codes else []


def reason_lines(reason: ReasonDoc, actions: int = ACTIONS) -> list[str]:
    """Write a reason, and below it as many actions of what to do about it as are known."""
    lines = wrapped(f"  {reason.code}: {reason.message}", "    ")
    known = explain(reason.code)
    if known is not None and known.advice and actions:
        advice = " ".join(plain(action) for action in known.advice[:actions])
        lines += wrapped(f"    what to do: {advice}", "      ")
    return lines


def describe_detection(detection: DetectionDoc, written: Sequence[str]) -> str:
    """Write what was found in one cloud as a person reads it."""
    detection, written = legible(detection), [printable(path) for path in written]
    parts = [
        *input_lines("file", detection.input),
        f"  {counted(detection.retro_points, 'retro-reflective point')} "
        f"(threshold from: {detection.threshold_source})",
        "",
        counted(len(detection.poles), "pole"),
    ]
    if detection.poles:
        rows = [pole_row(f"pole {k}", pole) for k, pole in enumerate(detection.poles)]
        parts.append(table(columns(POLE_COLUMNS), rows))
    listed = detection.rejected
    if not detection.poles and detection.threshold_source.endswith(LITTLE):
        # Their reasons are of pieces of the ground and of walls.
        message = "nothing is distinctly brighter than the rest: no tape is in view, or the "
        parts += ["", *wrapped(message + "intensity is not the measured one", "  ")]
        listed = listed[:FEW_LISTED]
    parts += ["", counted(len(detection.rejected), "rejected cluster")]
    if len(listed) < len(detection.rejected):
        parts[-1] += f", the largest {len(listed)} of them listed here; --json lists all"
    if listed:
        rows = [
            [cluster.code, *numbers(cluster.centre_m, 2), str(cluster.points)] for cluster in listed
        ]
        header, *lines = table(columns("why; x, m; y, m; z, m; points"), rows).split("\n")
        parts.append(header)
        for line, cluster in zip(lines, listed, strict=True):
            parts += [line, *wrapped(f"    {cluster.reason}", "    ")]
    if written:
        parts.append("written: " + ", ".join(written))
    return "\n".join(parts)


BAR = 40
"""Characters of the longest bar of a histogram."""


def describe_info(document: InfoDoc) -> str:
    """Write what is in a recording as a person reads it."""
    document = legible(document)
    parts = [document.path]
    if document.topics:
        rows = [[topic.name, topic.type, str(topic.messages)] for topic in document.topics]
        parts.append(table(("topic", "type", "messages"), rows))
    for cloud in document.clouds:
        parts += ["", *_cloud_lines(cloud)]
    return "\n".join(parts)


def describe_cloud(cloud: CloudDoc) -> str:
    """Write what is in the frames of a file, or of one topic of a bag."""
    return "\n".join(_cloud_lines(legible(cloud)))


def _cloud_lines(cloud: CloudDoc) -> list[str]:
    read = "" if cloud.frames_read == cloud.frames else f" ({cloud.frames_read} read"
    if read:
        read += f", every {cloud.step}th)" if cloud.step > 1 else ")"
    rate = "unknown" if cloud.rate_hz is None else f"{cloud.rate_hz:.2f} Hz"
    duration = "" if cloud.duration_s is None else f", {cloud.duration_s:.1f} s"
    fields = ", ".join(f"{name} {kind}" for name, kind in cloud.fields.items())
    near, middle, far = cloud.range_m
    is_short = cloud.rings is None and cloud.frames < max(s.sweeps for s in SENSORS.values())
    lines = [
        *([f"topic      {cloud.topic}"] if cloud.topic else []),
        *([f"frame_id   {cloud.frame_id}"] if cloud.frame_id else []),
        f"frames     {cloud.frames}{read}",
        f"rate       {rate}{duration}",
        *(
            []
            if cloud.clock_offset_s is None
            else wrapped(f"clock      {words_of(cloud.clock_offset_s)}", " " * 11)
        ),
        f"fields     {fields}",
        f"points     {cloud.points:,} ({cloud.dropped:,} dropped), "
        f"{cloud.points / cloud.frames_read:,.0f} a frame",
        *(f"note       {note}" for note in cloud.notes),
        f"rings      {'none' if cloud.rings is None else cloud.rings}"
        + (f", ignored: {cloud.rings_ignored}" if cloud.rings_ignored else ""),
        *([_pattern_line()] if is_short else []),
        *([_beams_line(cloud.beam_origin_m)] if cloud.told_by_rings else []),
        f"range      {near:.2f} to {far:.2f} m, median {middle:.2f} m",
        *_odd_lines(cloud),
        f"sensor     {' or '.join(cloud.sensors) or 'unknown'}",
    ]
    if cloud.intensity is None:
        return [*lines, "intensity  none: tape cannot be distinguished from the rest"]
    return lines + _intensity_lines(cloud.intensity)


def _pattern_line() -> str:
    """State how long to record LiDARs that do not repeat their pattern."""
    requested = [f"{s.name} {s.seconds:g} s" for s in SENSORS.values() if s.sweeps > 1]
    return f"           a pattern that does not repeat needs time ({', '.join(requested)}), or more"


def _odd_lines(cloud: CloudDoc) -> list[str]:
    """Describe what is odd about the coordinates, with advice."""
    if not cloud.odd_coordinates:
        return []
    options = " or ".join(f"--unit {unit}" for unit in cloud.units)
    advice = (
        f"read them with {options}, in this and every other command"
        if options
        else "give the cloud in metres and in the LiDAR's frame, or subtract the LiDAR's "
        "position from all points"
    )
    return [f"           {cloud.odd_coordinates}", f"           what to do: {advice}"]


def _beams_line(origin: list[float]) -> str:
    x, y, z = origin
    return f"beams      start at ({x:.3f}, {y:.3f}, {z:.3f}) m, as the rings show"


def _intensity_lines(intensity: IntensityDoc) -> list[str]:
    values = f"median {intensity.median:.4g}, 95 % below {intensity.p95:.4g}"
    lines = [f"intensity  {values}, largest {intensity.max:.4g}"]
    if intensity.others:
        instead = " or ".join(f"--intensity {name}" for name in intensity.others)
        lines.append(f"           of the field {intensity.field}; {instead} selects another")
    if intensity.threshold is None:
        return [*lines, f"threshold  {intensity.threshold_source}; tape cannot be distinguished"]
    lines += [
        f"threshold  {intensity.threshold:.4g} would be used ({intensity.threshold_source}): "
        f"{counted(intensity.retro_points, 'point')}",
        "",
        "  intensity from     points  (bars on a logarithmic scale)",
    ]
    # Few returns are tape: on an even scale their bars would not be seen.
    longest = np.log1p(max(intensity.counts))
    edges = intensity.bin_edges
    marked = np.searchsorted(edges[1:-1], intensity.threshold, side="right")
    for k, count in enumerate(intensity.counts):
        bar = "█" * round(BAR * float(np.log1p(count) / longest))
        mark = "  ← threshold" if k == marked else ""
        lines.append(f"  {edges[k]:14.4g} {count:10,}  {bar}{mark}".rstrip())
    return lines
