"""The result in words, for a terminal: pure functions from documents to text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from .. import se3
from ..errors import printable
from ..quantities import error
from ..reasons import explain, page, plain
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
from .names import LIDARS, hypothesis_name

ACTIONS = 2
"""How many actions are named of what to do about a reason; the report lists them all."""


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


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out rows under a header, each column as wide as it needs, numbers to the right."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  " + "  ".join(cells).rstrip())
    return "\n".join(lines)


def left_out_words(document: InputDoc) -> str:
    """Say how many points and frames of too many were left out; nothing where none were."""
    parts = [
        f"{count:,} {what}"
        for count, what in (
            (document.thinned, "points"),
            (document.frames_left_out, "frames"),
        )
        if count
    ]
    return f"{' and '.join(parts)} left out as too many" if parts else ""


def _input_line(name: str, document: InputDoc) -> str:
    threshold = "none" if document.threshold is None else f"{document.threshold:g}"
    left_out = left_out_words(document)
    line = (
        f"{name}  {document.path}: {document.points:,} points ({document.dropped:,} dropped"
        f"{', ' + left_out if left_out else ''}), "
        f"sensor {document.sensor}, threshold {threshold}"
    )
    return "\n".join([line, *(f"  {note}" for note in document.notes)])


def _pole_rows(name: str, poles: Sequence[PoleDoc]) -> list[list[str]]:
    return [
        [
            f"{name} {k}",
            *(f"{value:.3f}" for value in pole.point_m),
            f"{pole.length_m:.2f}",
            str(pole.points),
            str(pole.rings),
            f"{1000 * pole.rms_m:.1f}",
        ]
        for k, pole in enumerate(poles)
    ]


_POLE_HEADER = ("pole", "x m", "y m", "z m", "length m", "points", "rings", "rms mm")


def _number(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"


def _degrees(value: float | None) -> float | None:
    return None if value is None else float(np.degrees(value))


def _hypothesis_row(k: int, hypothesis: HypothesisDoc) -> list[str]:
    return [
        f"{hypothesis_name(k)}{' *' if hypothesis.chosen else ''}",
        " ".join(f"{i}-{j}" for i, j in hypothesis.pairs),
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
    "free-space violation",
    "score",
)


def transform_lines(matrix: Sequence[Sequence[float]]) -> list[str]:
    """Write a 4×4 transform as matrix, translation, quaternion and angles."""
    T = np.array(matrix)
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
    result: ResultDoc, written: Sequence[str], following: Mapping[str, str] | None = None
) -> str:
    """Write a whole result as a person reads it.

    Parameters
    ----------
    result
        The result document.
    written
        Paths of the files that hold it.
    following
        Commands to type next where there is a transform, by the words that introduce each.
    """
    result, written = legible(result), [printable(path) for path in written]
    parts = [_input_line(LIDARS[k % 2], document) for k, document in enumerate(result.inputs)]
    parts.append("")
    poles = _pole_rows("target", result.poles.target) + _pole_rows("source", result.poles.source)
    if poles:
        parts += [table(_POLE_HEADER, poles), ""]
    if result.hypotheses:
        rows = [_hypothesis_row(k, h) for k, h in enumerate(result.hypotheses)]
        parts.append(table(_HYPOTHESIS_HEADER, rows))
        if result.margin is not None:
            parts.append(f"  margin over the next: {result.margin:.3f}")
        parts.append("")
    if result.T_target_source is not None:
        parts += ["T_target_source (source points into the target frame)"]
        parts += transform_lines(result.T_target_source)
        parts += _certainty_lines(result)
        if result.placements:
            rows = [
                _placement_row(k, placement) for k, placement in enumerate(result.placements, 1)
            ]
            parts += ["", "The poles' pose without each placement differs from it by"]
            parts.append(table(_PLACEMENT_HEADER, rows))
        parts.append("")
    scene = scene_words(result)
    if scene is not None:
        parts.append(f"what stands in the scene: {scene}")
    parts.append(f"verdict: {result.status}")
    # Where it is not yes, the reason says so.
    if result.fitness is not None and result.fitness.answer == "yes":
        parts.append(f"  {result.fitness.words}")
    for reason in result.reasons:
        parts += reason_lines(reason)
        if result.status == "refused" and explain(reason.code) is not None:
            parts.append(f"    read on: documentation, {page(reason.code)}")
    parts += describe_standing(result)
    parts.append("written: " + ", ".join(written))
    if result.T_target_source is not None:
        parts += [f"{lead}: {printable(words)}" for lead, words in (following or {}).items()]
    return "\n".join(parts)


def _certainty_lines(result: ResultDoc) -> list[str]:
    """Say how certain the pose is, what makes it uncertain, and the radius of the poles."""
    lines, largest, radius = [], largest_error(result), radius_words(result)
    if result.predicted_error:
        at = ", ".join(f"± {error(e.sigma_m)} at {e.range_m:g} m" for e in result.predicted_error)
        lines.append(f"  predicted error, 1 sigma: {at}")
    for each in error_parts(result):
        if each.range_m == BUDGET_RANGE:
            lines.append(
                f"  at {each.range_m:g} m: random ± {error(each.random)}, "
                f"systematic ± {error(each.systematic)}"
            )
    if largest is not None:
        lines.append(f"  largest source of error, {largest}")
    if result.weakest is not None:
        lines.append(f"  least certain, 1 sigma: {result.weakest.words}")
    if radius is not None:
        lines.append(f"  radius {radius}")
    return lines


_PLACEMENT_HEADER = ("placement", "poles", "rotation deg", "translation m")


def _placement_row(k: int, placement: PlacementDoc) -> list[str]:
    return [
        f"{k}",
        f"{placement.poles_target} + {placement.poles_source}",
        _number(_degrees(placement.left_out_rotation_rad), 3),
        _number(placement.left_out_translation_m, 4),
    ]


def reason_lines(reason: ReasonDoc) -> list[str]:
    """Write a reason on a line, and what to do about it on the next where that is known."""
    lines = [f"  {reason.code}: {reason.message}"]
    known = explain(reason.code)
    if known is not None and known.advice:
        actions = " ".join(plain(action) for action in known.advice[:ACTIONS])
        lines.append(f"    what to do: {actions}")
    return lines


def describe_detection(detection: DetectionDoc, written: Sequence[str]) -> str:
    """Write what was found in one cloud as a person reads it."""
    detection, written = legible(detection), [printable(path) for path in written]
    parts = [
        _input_line("file", detection.input),
        f"  {detection.retro_points:,} retro-reflective points "
        f"(threshold from: {detection.threshold_source})",
        "",
        f"{len(detection.poles)} poles",
    ]
    if detection.poles:
        parts.append(table(_POLE_HEADER, _pole_rows("pole", detection.poles)))
    parts += ["", f"{len(detection.rejected)} rejected clusters"]
    if detection.rejected:
        rows = [
            [
                cluster.code,
                *(f"{value:.2f}" for value in cluster.centre_m),
                str(cluster.points),
                cluster.reason,
            ]
            for cluster in detection.rejected
        ]
        header = ("why", "x m", "y m", "z m", "points", "in words")
        parts.append(table(header, rows))
    if written:
        parts.append("written: " + ", ".join(written))
    return "\n".join(parts)
