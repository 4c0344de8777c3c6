"""The result in words, for a terminal: pure functions from documents to text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import printable, shortened
from ..base.quantities import counted, error
from ..base.reasons import explain, page, plain
from ..result import (
    DetectionDoc,
    HypothesisDoc,
    InputDoc,
    PlacementDoc,
    PoleDoc,
    ReasonDoc,
    ResultDoc,
)
from .certainty import BUDGET_RANGE, error_parts, largest_error, radius_words, scene_words
from .hypotheses_text import describe_standing
from .layout import LINES, WIDTH, legible, table, wrapped
from .subject import LIDARS, hypothesis_name, pair_name, pole_name

ACTIONS = 2
"""How many actions are named of what to do about a reason; the report lists them all."""


def left_out_words(document: InputDoc) -> str:
    """Say how many points and frames of too many were left out; nothing where none were."""
    parts = [
        counted(count, what)
        for count, what in ((document.thinned, "point"), (document.frames_left_out, "frame"))
        if count
    ]
    return f"{' and '.join(parts)} left out as too many" if parts else ""


def input_lines(name: str, document: InputDoc) -> list[str]:
    """Say what was read of a recording, and what was left out."""
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


def _pole_rows(names: Sequence[str], poles: Sequence[PoleDoc]) -> list[list[str]]:
    return [
        [
            name,
            *(f"{value:.3f}" for value in pole.point_m),
            f"{pole.length_m:.2f}",
            str(pole.points),
            str(pole.rings),
            f"{1000 * pole.rms_m:.1f}",
        ]
        for name, pole in zip(names, poles, strict=True)
    ]


_POLE_HEADER = ("pole", "x m", "y m", "z m", "length m", "points", "rings", "rms mm")


def _number(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"


def _degrees(value: float | None) -> float | None:
    return None if value is None else float(np.degrees(value))


def _hypothesis_row(k: int, hypothesis: HypothesisDoc) -> list[str]:
    return [
        f"{hypothesis_name(k)}{' *' if hypothesis.chosen else ''}",
        " ".join(map(pair_name, hypothesis.pairs)),
        "yes" if hypothesis.exact else "no",
        f"{1000 * hypothesis.pole_rms_m:.1f}",
        _number(hypothesis.icp_rotation_rad, 4),
        _number(hypothesis.icp_translation_m, 4),
        f"{hypothesis.overlap:.3f}",
        f"{hypothesis.free_space_violation:.3f}",
        f"{hypothesis.score:.3f}",
    ]


_HYPOTHESIS_HEADER = (
    "hypothesis",
    "pairs",
    "exact",
    "rms mm",
    "e_r rad",
    "e_t m",
    "overlap",
    "free-space\nviolation",
    "score",
)


def transform_lines(T: Array) -> list[str]:
    """Write a 4×4 transform as matrix, translation, quaternion and angles."""
    x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
    roll, pitch, yaw = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
    lines = ["  [" + " ".join(f"{value:12.8f}" for value in row) + "]" for row in T]
    return [
        *lines,
        f"  translation  x {T[0, 3]:.4f}  y {T[1, 3]:.4f}  z {T[2, 3]:.4f} m",
        f"  quaternion   x {x:.8f}  y {y:.8f}  z {z:.8f}  w {w:.8f}",
        f"  angles       roll {roll:.4f}  pitch {pitch:.4f}  yaw {yaw:.4f} deg",
    ]


def describe_result(
    result: ResultDoc,
    written: Sequence[str],
    following: Mapping[str, str] | None = None,
    *,
    verbose: bool = False,
) -> str:
    """Write a result as a person reads it: the verdict first, and a screen at most.

    Parameters
    ----------
    result
        The result document.
    written
        Paths of the files that hold it.
    following
        Commands to type next where there is a transform, by the words that introduce each.
    verbose
        Whether the inputs, all poles, all hypotheses and the time of each step are written as well,
        on as many lines as it takes.
    """
    result, written = legible(result), [printable(path) for path in written]
    head = [f"verdict: {result.status}"]
    # Where it is not yes, the reason says so.
    if result.fitness is not None and result.fitness.answer == "yes":
        head += wrapped(f"  {result.fitness.words}", "    ")
    body = []
    if result.T_target_source is not None:
        body += ["", "T_target_source (source points into the target frame)"]
        body += transform_lines(result.T_target_source)
        body += _certainty_lines(result, verbose)
    scene = scene_words(result)
    if scene is not None:
        body += wrapped(f"  what stands in the scene: {scene}", "    ")
    told = describe_standing(result)
    standing = [part for line in told for part in wrapped(line, "      ")]
    tail = ["", "written: " + ", ".join(written)]
    if result.T_target_source is not None:
        tail += [f"{lead}: {printable(words)}" for lead, words in (following or {}).items()]
    if verbose:
        reasons = reasons_whole(result.status, result.reasons)
        found = [*_found_lines(result), *_verbose_lines(result)]
    else:
        found = _found_counts(result)
        room = LINES - len(head) - len(standing) - len(body) - len(tail)
        reasons = reasons_within(result.status, result.reasons, room - len(found))
        every = _found_lines(result)
        found = every if len(every) + len(reasons) <= room else found
    return "\n".join([*head, *reasons, *standing, *body, *found, *tail])


def reasons_whole(status: str, reasons: Sequence[ReasonDoc], actions: int = ACTIONS) -> list[str]:
    """Write reasons, what to do about each and, of a refusal, where to read on."""
    lines = []
    for reason in reasons:
        lines += reason_lines(reason, actions)
        if status == "refused" and explain(reason.code) is not None:
            lines.append(f"    read on: documentation, {page(reason.code)}")
    return lines


def reasons_within(
    status: str, reasons: Sequence[ReasonDoc], room: int, report: str = "report.html"
) -> list[str]:
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
    # Never fewer than one: a verdict without its reason says nothing.
    shown = cut if len(cut) < room else cut[: max(room - 2, 1)]
    if len(shown) < len(cut):
        shown.append(f"  and {counted(len(cut) - len(shown), 'more reason')}")
    return shown + lines


def _found_lines(result: ResultDoc) -> list[str]:
    """List the poles, or the placements where there are several."""
    if result.placements:
        rows = [_placement_row(k, each) for k, each in enumerate(result.placements, 1)]
        lines = table(_PLACEMENT_HEADER, rows).split("\n")
        return ["", "The poles' pose without each placement differs from it by", *lines]
    rows = []
    for lidar, poles in zip(LIDARS, (result.poles.target, result.poles.source), strict=True):
        rows += _pole_rows([pole_name(lidar, k) for k in range(len(poles))], poles)
    return ["", *table(_POLE_HEADER, rows).split("\n")] if rows else []


def _found_counts(result: ResultDoc) -> list[str]:
    """Count the poles, or the placements, where there is no room to list them."""
    if result.placements:
        return ["", f"{counted(len(result.placements), 'placement')}; -v lists them"]
    target, source = len(result.poles.target), len(result.poles.source)
    if not target + source:
        return []
    return ["", f"{counted(target, 'pole')} of the target, {source} of the source; -v lists them"]


def _verbose_lines(result: ResultDoc) -> list[str]:
    """Write what a screen has no room for: hypotheses, inputs, the time of each step."""
    lines = []
    if result.hypotheses:
        rows = [_hypothesis_row(k, h) for k, h in enumerate(result.hypotheses)]
        lines += ["", *table(_HYPOTHESIS_HEADER, rows).split("\n")]
        if result.margin is not None:
            lines.append(f"  margin over the next: {result.margin:.3f}")
    lines.append("")
    for k, document in enumerate(result.inputs):
        several = f" {k // 2 + 1}" if len(result.inputs) > 2 else ""
        lines += input_lines(LIDARS[k % 2] + several, document)
    if result.seconds:
        times = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in result.seconds.items())
        lines += ["", *wrapped(f"time: {times}", "      ")]
    return lines


def _certainty_lines(result: ResultDoc, verbose: bool) -> list[str]:
    """Say how certain the pose is, what makes it uncertain, and the radius of the poles."""
    lines, largest, radius = [], largest_error(result), radius_words(result)
    if result.predicted_error:
        at = ", ".join(f"± {error(e.sigma_m)} at {e.range_m:g} m" for e in result.predicted_error)
        lines.append(f"  predicted error, 1 sigma: {at}")
    if verbose:
        lines += [
            f"  at {each.range_m:g} m: random ± {error(each.random)}, "
            f"systematic ± {error(each.systematic)}"
            for each in error_parts(result.predicted_error, result.uncertainty)
            if each.range_m == BUDGET_RANGE
        ]
    if largest is not None:
        lines.append(f"  largest source of error, {largest}")
    if result.weakest is not None:
        lines.append(f"  least certain, 1 sigma: {result.weakest.words}")
    if verbose and radius is not None:
        lines.append(f"  radius {radius}")
    return [part for line in lines for part in wrapped(line, "    ")]


_PLACEMENT_HEADER = ("placement", "poles", "rotation deg", "translation m")


def _placement_row(k: int, placement: PlacementDoc) -> list[str]:
    return [
        f"{k}",
        f"{placement.poles_target} + {placement.poles_source}",
        _number(_degrees(placement.left_out_rotation_rad), 3),
        _number(placement.left_out_translation_m, 4),
    ]


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
    names = [f"pole {k}" for k in range(len(detection.poles))]
    parts = [
        *input_lines("file", detection.input),
        f"  {counted(detection.retro_points, 'retro-reflective point')} "
        f"(threshold from: {detection.threshold_source})",
        "",
        counted(len(detection.poles), "pole"),
    ]
    if detection.poles:
        parts.append(table(_POLE_HEADER, _pole_rows(names, detection.poles)))
    parts += ["", counted(len(detection.rejected), "rejected cluster")]
    if detection.rejected:
        rows = [
            [cluster.code, *(f"{value:.2f}" for value in cluster.centre_m), str(cluster.points)]
            for cluster in detection.rejected
        ]
        header, *lines = table(("why", "x m", "y m", "z m", "points"), rows).split("\n")
        parts.append(header)
        for line, cluster in zip(lines, detection.rejected, strict=True):
            parts += [line, *wrapped(f"    {cluster.reason}", "    ")]
    if written:
        parts.append("written: " + ", ".join(written))
    return "\n".join(parts)
