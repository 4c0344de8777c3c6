"""What the answer rests on: poles, residuals, placements, inputs; from the result to HTML."""

from __future__ import annotations

import math
from html import escape

import msgspec
import numpy as np

from ..base import se3
from ..base.datatypes import Placement, Scan
from ..result import ResultDoc, RunConfig
from .certainty import radius_words
from .crosssections import cross_sections
from .markup import MISSING, number, table
from .missing import REJECTED_SYMBOLS
from .names import LIDARS, pair_name, pole_name
from .text import left_out_words

UNFOLDED_CLUSTERS = 4
"""Up to so many rejected clusters are listed unfolded."""


def poles(result: ResultDoc, first: Placement) -> str:
    """List the poles, their residuals under the transform, and the rejected clusters.

    Parameters
    ----------
    result
        The result document.
    first
        The first placement of the poles, whose poles the result lists.
    """
    rows = [
        (
            f"{lidar} {pole_name(lidar, k)}",
            *(number(value, 3) for value in pole.point_m),
            number(pole.length_m, 2),
            pole.points,
            pole.rings,
            number(pole.rms_m, 1, 1000),
        )
        for lidar, found in zip(LIDARS, (result.poles.target, result.poles.source), strict=True)
        for k, pole in enumerate(found)
    ]
    header = ("pole", "x, m", "y, m", "z, m", "length, m", "points", "rings", "rms, mm")
    listed = table("Poles, each in its LiDAR's frame", header, rows)
    unfold = result.status == "refused"
    return "".join(
        (
            '<section aria-labelledby="poles"><h2 id="poles">Poles</h2>',
            "" if rows else "<p>No pole was found in either cloud.</p>",
            f'<div class="columns">{listed if rows else ""}{_residuals(result, first)}</div>',
            _radius_note(result),
            cross_sections(result, first),
            _rejected("target", first.target, unfold),
            _rejected("source", first.source, unfold),
            "</section>",
        )
    )


def _rejected(lidar: str, scan: Scan, unfold: bool) -> str:
    """List the rejected clusters of one LiDAR, each with its reason."""
    if scan.detection is None or not scan.detection.rejected:
        return ""
    rows = [
        (
            f"{REJECTED_SYMBOLS[lidar]} {k}",
            cluster.code,
            cluster.reason,
            len(cluster.index),
            *(number(value, 2) for value in cluster.centre.tolist()),
        )
        for k, cluster in enumerate(scan.detection.rejected)
    ]
    header = ("mark", "code", "reason", "points", "x, m", "y, m", "z, m")
    is_open = " open" if unfold or len(rows) <= UNFOLDED_CLUSTERS else ""
    listed = table(f"Rejected clusters of the {lidar}", header, rows, (1, 2))
    summary = f"<summary>Rejected in the {lidar}: {len(rows)}</summary>"
    return f"<details{is_open}>{summary}{listed}</details>"


def _residuals(result: ResultDoc, first: Placement) -> str:
    """Distance of each source pole from its target pole's line, under the transform."""
    if result.chosen is None or result.T_target_source is None:
        return ""
    T = np.array(result.T_target_source)
    detection = first.source.detection
    rows = []
    for i, j in result.chosen.pairs:
        a, b = result.poles.target[i], result.poles.source[j]
        n = np.array(a.direction)
        points = np.array([b.point_m]) if detection is None else detection.poles[j].xyz
        away = se3.apply(T, points) - np.array(a.point_m)
        lateral = away - (away @ n)[:, None] * n
        distance = np.linalg.norm(lateral, axis=1)
        sine = float(np.linalg.norm(np.cross(T[:3, :3] @ np.array(b.direction), n)))
        rms, largest = float(np.sqrt(np.mean(distance**2))), float(distance.max())
        rows.append(
            (
                pair_name((i, j)),
                number(math.degrees(math.asin(min(1.0, sine))), 2),
                number(float(np.linalg.norm(lateral.mean(axis=0))), 1, 1000),
                MISSING if detection is None else number(rms, 1, 1000),
                MISSING if detection is None else number(largest, 1, 1000),
            )
        )
    header = ("pair", "angle, deg", "lateral offset, mm", "rms, mm", "largest, mm")
    return table("Source poles from the target poles' lines, with the transform", header, rows)


def _radius_note(result: ResultDoc) -> str:
    if result.T_target_source is None:
        return ""
    millimetres, words = 1000 * result.config.radius_m, radius_words(result)
    apart = f"{millimetres * math.pi / 2:.0f}"
    stated = "" if words is None else f"<p>Radius of the poles: {escape(words)} (1 σ).</p>"
    return (
        f'{stated}<p class="note">Returns lie on the side of the pole that faces their LiDAR: at '
        f"a radius of {millimetres:g} mm two LiDARs may see lines up to {apart} mm apart though "
        "the transform is exact.</p>"
    )


def placements(result: ResultDoc) -> str:
    """Say of each of several placements how the poles' pose differs without it."""
    if len(result.placements) < 2:
        return ""
    rows = [
        (
            f"placement {k}",
            f"{each.poles_target} + {each.poles_source}",
            number(each.left_out_rotation_rad, 3, 180 / math.pi),
            number(each.left_out_translation_m, 1, 1000),
        )
        for k, each in enumerate(result.placements, 1)
    ]
    header = ("placement", "poles, target + source", "rotation, deg", "translation, mm")
    return (
        '<section aria-labelledby="placements"><h2 id="placements">Placements</h2>'
        f"<p>One pose was found for all {len(rows)} placements of the poles. Each was left out "
        "once: the figures say how far the poles' pose lies from the pose without it. A placement "
        "that stands out from the others deserves a look; choose it above the view.</p>"
        + table("Change of the pose without each placement", header, rows)
        + "</section>"
    )


def provenance(result: ResultDoc) -> str:
    """List inputs, options, version and times."""
    several = len(result.inputs) > 2
    inputs = [
        (
            f"{LIDARS[k % 2]} {k // 2 + 1}" if several else LIDARS[k % 2],
            item.path,
            f"{item.points:,}",
            f"{item.dropped:,}" + (f" ({left_out_words(item)})" if left_out_words(item) else ""),
            item.sensor,
            MISSING if item.threshold is None else f"{item.threshold:g}",
            item.sha256,
        )
        for k, item in enumerate(result.inputs)
    ]
    header = ("input", "path", "points", "dropped", "sensor", "threshold", "sha256")
    notes = [
        f"{row[0]}: {note}"
        for row, item in zip(inputs, result.inputs, strict=True)
        for note in item.notes
    ]
    times = [(step, number(seconds, 3)) for step, seconds in result.seconds.items()]
    times.append(("sum", number(float(sum(result.seconds.values())), 3)))
    return (
        '<section aria-labelledby="run"><h2 id="run">This run</h2>'
        f"<p>retropole {escape(result.version)}, {escape(result.created)}</p>"
        + table("Inputs", header, inputs, (1, 4, 6))
        + "".join(f"<p>{escape(note)}</p>" for note in notes)
        + '<div class="columns">'
        + table("Options", ("option", "value"), _options(result.config), (1,))
        + table("Time", ("step", "seconds"), times)
        + "</div></section>"
    )


def _options(config: RunConfig) -> list[tuple[str, str]]:
    """Write every option of the run, whatever there are, as a person would."""
    options = msgspec.structs.asdict(config) | {"frames": _slice(config)}
    return [(name, _option(value)) for name, value in options.items()]


def _slice(config: RunConfig) -> str | None:
    """Write the frames as the command line takes them: ``0:20``, ``::10``."""
    if config.frames is None:
        return None
    parts = config.frames[:2] if config.frames[2] is None else config.frames
    return ":".join("" if part is None else str(part) for part in parts)


def _option(value: object) -> str:
    if value is None:
        return "default"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return str(value)
