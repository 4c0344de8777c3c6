"""What was read and found: the poles of every LiDAR and placement, recordings, options, times."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from ..base import se3
from ..base.quantities import UNKNOWN, counted
from ..result import ResultDoc
from ..result.site import FoundDoc
from . import listings
from .certainty import number, radius_words
from .crosssections import cross_sections
from .listings import Listing, columns, left_out_words
from .page import EMPTY, Html, fill, fill_each, folded, join, listed, table
from .subject import Subject, pair_name

UNFOLDED_CLUSTERS = 4
"""Up to so many rejected clusters of a pair are listed unfolded."""


def poles(subject: Subject) -> Html:
    """Show what was found in every recording; of a refused run, all of it unfolded."""
    site = subject.site
    if not site.found:
        return EMPTY
    several = len(site.placements) > 1 or len(site.lidars) > 2
    nothing = not any(each and each.poles for of_lidar in site.found for each in of_lidar)
    return fill(
        "found",
        none=fill("p", text="No pole was found in any cloud.") if nothing else "",
        counts=table(*listings.found(subject)) if several else "",
        pair=EMPTY if subject.pair is None else _of_pair(subject, subject.pair),
        lidars=join(_of_lidar(subject, k, of_lidar) for k, of_lidar in enumerate(site.found)),
    )


def _of_lidar(subject: Subject, k: int, of_lidar: Sequence[FoundDoc | None]) -> Html:
    """List the poles and the rejected clusters of one LiDAR, each with its reason."""
    found, rejected = listings.poles(subject, k), listings.rejected(subject, k)
    refusals = [
        f"Placement {name}: {each.refusal.message}."
        for name, each in zip(subject.placements, of_lidar, strict=True)
        if each is not None and each.refusal is not None
    ]
    poles = table(*found) if found.rows else EMPTY
    clusters = fill("rejected", body=table(*rejected)) if rejected.rows else EMPTY
    said = fill_each("said", refusals)
    few = subject.pair is not None and len(rejected.rows) <= UNFOLDED_CLUSTERS
    refused = subject.site.status == "refused" and (refusals or subject.pair is not None)
    counts = counted(len(found.rows), "pole"), counted(len(rejected.rows), "rejected cluster")
    return folded(
        f"{subject.site.lidars[k].name}: {', '.join(counts)}",
        fill("stack", body=join((said, poles, clusters))) if said or poles or clusters else EMPTY,
        is_open=bool(refused or few),
    )


def _of_pair(subject: Subject, pair: ResultDoc) -> Html:
    """Show how well the poles of a pair agree under its pose."""
    if pair.T_target_source is None:
        return EMPTY
    millimetres, words = 1000 * pair.config.radius_m, radius_words(pair)
    return fill(
        "agreement",
        residuals=listed(_residuals(subject, pair)),
        radius="" if words is None else fill("radius", words=words),
        given=f"{millimetres:g}",
        apart=f"{millimetres * math.pi / 2:.0f}",
        sections=cross_sections(subject),
    )


def _residuals(subject: Subject, pair: ResultDoc) -> Listing:
    """Distance of each source pole from its target pole's line, under the transform."""
    T, scan, rows = np.array(pair.T_target_source), subject.scans[1][0], []
    seen = () if scan is None else scan.poles
    for i, j in pair.chosen.pairs if pair.chosen else ():
        a, b = pair.poles.target[i], pair.poles.source[j]
        away = se3.apply(T, seen[j].xyz if seen else np.array([b.point_m])) - a.point_m
        lateral = away - (away @ a.direction)[:, None] * a.direction
        distance = np.linalg.norm(lateral, axis=1)
        sine = float(np.linalg.norm(np.cross(T[:3, :3] @ b.direction, a.direction)))
        angle = math.degrees(math.asin(min(1.0, sine)))
        spread = (np.sqrt(np.mean(distance**2)), distance.max()) if seen else (None, None)
        offsets = (np.linalg.norm(lateral.mean(axis=0)), *spread)
        name = pair_name((i, j))
        rows.append([name, number(angle, 2), *(number(each, 1, 1000) for each in offsets)])
    header = columns("pair; angle, deg; lateral offset, mm; rms, mm; largest, mm")
    return Listing("Source poles from the target poles' lines, with the pose", header, rows)


def run(subject: Subject) -> Html:
    """List inputs, options, version and times."""
    site = subject.site
    several = len(site.placements) > 1
    inputs = [
        (
            site.lidars[item.lidar].name,
            *([subject.placement(item.placement)] if several else []),
            item.path,
            f"{item.points:,}",
            f"{item.dropped:,}" + (f" ({left_out_words(item)})" if left_out_words(item) else ""),
            item.sensor,
            UNKNOWN if item.threshold is None else f"{item.threshold:g}",
            item.sha256,
        )
        for item in site.inputs
    ]
    names = "path; points; dropped; sensor; threshold; sha256"
    header = columns(f"LiDAR; {'placement; ' if several else ''}{names}")
    words = [k for k, name in enumerate(header) if name in ("placement", "path", "sensor")]
    notes = [
        f"{', '.join(row[: 1 + several])}: {note}"
        for row, item in zip(inputs, site.inputs, strict=True)
        for note in item.notes
    ]
    steps = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in site.seconds.items())
    times = f"Time: {sum(site.seconds.values()):.2f} s ({steps})." if steps else ""
    inputs_table = table("Inputs", header, inputs, (*words, len(header) - 1)) if inputs else ""
    return fill(
        "run",
        version=site.version,
        created=site.created,
        inputs=inputs_table,
        notes=fill_each("said", notes),
        options=_options_table(subject),
        times=fill("p", text=times) if times else "",
    )


def _options_table(subject: Subject) -> Html:
    """List the options of the run; those at their default are left out, and that is said."""
    rows = _options(subject)
    if not rows:
        return fill("p", text="Every option is at its default.")
    caption = "Options; all others are at their default"
    return table(caption, ("option", "value"), rows, (1,))


def _options(subject: Subject) -> list[tuple[str, str]]:
    """Write what a site is of, and every option that is not at its default, as a person would."""
    site, config = subject.site, subject.pair.config if subject.pair else subject.site.config
    need, said = site.need, {}
    if subject.pair is None:
        said = {
            "name": site.name,
            "datum": site.datum,
            "frame": site.frame.name,
            "reference": site.lidars[site.reference].name,
            "radius": f"{1000 * site.radius_m:g} ± {1000 * site.radius_sigma_m:g} mm",
            "asked for": f"{100 * need.within:g} cm at {need.at:g} m" if need else "",
            "surveyed poles": len(site.surveyed_poles),
            "control points": len(site.control_points),
        }
        said = {name: each for name, each in said.items() if each}
    usual = msgspec.structs.asdict(type(config)())
    given = msgspec.structs.asdict(config)
    said |= {name: each for name, each in given.items() if each != usual[name]}
    if config.frames is not None:
        # As the command line takes them: ``0:20``, ``::10``.
        parts = config.frames[:2] if config.frames[2] is None else config.frames
        said["frames"] = ":".join("" if part is None else str(part) for part in parts)
    return [(name, _option(value)) for name, value in said.items()]


def _option(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return str(value) or UNKNOWN
