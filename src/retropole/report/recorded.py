"""What was read and found: recordings, poles, returns on them, and what too few poles lack."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import Any

import msgspec
import numpy as np

from ..base import se3
from ..base.datatypes import Array, Pole, RejectedCluster, Scan
from ..base.quantities import UNKNOWN, counted
from ..base.reasons import explain
from ..extraction.acceptance_shape import MIN_POLE_RINGS
from ..extraction.lines import MIN_POLE_POINTS
from ..result import ResultDoc
from ..result.site import LIDARS, FoundDoc
from . import listings
from .listings import Listing, columns, left_out_words, number, radius_words, rejected_mark
from .page import EMPTY, Html, fill, fill_each, folded, inline, join, listed, table
from .subject import Subject, colour_class, pair_name, pole_name

UNFOLDED_CLUSTERS = 4
"""Up to this many rejected clusters of a pair are listed unfolded."""

HALF_PICTURE = 110.0
"""Half the side of a picture, in its units; `pieces.html` has the same."""

RESIDUAL_SCALE = 0.01
"""Returns further than this from the surface, metres, have less and less weight in its position."""

SHOWN_RETURNS = 0.98
"""Share of the returns in a picture; strays are cut off."""

SAME_DISTANCE = 0.3
"""A cluster may be the missing pole where it is as far from a found one as the other LiDAR's
poles are from each other, within this, metres: two poles leaning by 15°, of which the LiDARs
see parts 0.5 m higher or lower, are 2 · 0.5 m · tan 15° = 0.27 m nearer or farther."""

TOO_LITTLE = ("too_few_points", "too_few_rows")
"""Codes of clusters of which too little was seen."""

NAMED = 3
"""Number of candidates that are named of each LiDAR; the page lists all clusters below."""

NEAREST = 2.0
"""No pole is required to be nearer than this, metres: what would have to is too little to go
by."""


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
    text = fill_each("said", refusals)
    few = subject.pair is not None and len(rejected.rows) <= UNFOLDED_CLUSTERS
    refused = subject.site.status == "refused" and (refusals or subject.pair is not None)
    counts = counted(len(found.rows), "pole"), counted(len(rejected.rows), "rejected cluster")
    return folded(
        f"{subject.site.lidars[k].name}: {', '.join(counts)}",
        fill("stack", body=join((text, poles, clusters))) if text or poles or clusters else EMPTY,
        is_open=bool(refused or few),
    )


def _of_pair(subject: Subject, pair: ResultDoc) -> Html:
    """Show how well the poles of a pair agree under its pose."""
    if pair.T_target_source is None:
        return EMPTY
    millimetres, text = 1000 * pair.config.radius_m, radius_words(pair)
    return fill(
        "agreement",
        residuals=listed(_residuals(subject, pair)),
        radius="" if text is None else fill("radius", text=text),
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
    texts = [k for k, name in enumerate(header) if name in ("placement", "path", "sensor")]
    notes = [
        f"{', '.join(row[: 1 + several])}: {note}"
        for row, item in zip(inputs, site.inputs, strict=True)
        for note in item.notes
    ]
    steps = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in site.seconds.items())
    times = f"Time: {sum(site.seconds.values()):.2f} s ({steps})." if steps else ""
    inputs_table = table("Inputs", header, inputs, (*texts, len(header) - 1)) if inputs else ""
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
    """List the options of the run; those at their default are left out, as stated."""
    rows = _options(subject)
    if not rows:
        return fill("p", text="Every option is at its default.")
    caption = "Options; all others are at their default"
    return table(caption, ("option", "value"), rows, (1,))


def _options(subject: Subject) -> list[tuple[str, str]]:
    """Write what a site is of, and every option that is not at its default, as a person would."""
    site, config = subject.site, subject.pair.config if subject.pair else subject.site.config
    need, text = site.need, {}
    if subject.pair is None:
        text = {
            "name": site.name,
            "datum": site.datum,
            "frame": site.frame.name,
            "reference": site.lidars[site.reference].name,
            "radius": f"{1000 * site.radius_m:g} ± {1000 * site.radius_sigma_m:g} mm",
            "requested": f"{100 * need.within:g} cm at {need.at:g} m" if need else "",
            "surveyed poles": len(site.surveyed_poles),
            "control points": len(site.control_points),
        }
        text = {name: each for name, each in text.items() if each}
    usual = msgspec.structs.asdict(type(config)())
    given = msgspec.structs.asdict(config)
    text |= {name: each for name, each in given.items() if each != usual[name]}
    if config.frames is not None:
        # As the command line takes them: ``0:20``, ``::10``.
        parts = config.frames[:2] if config.frames[2] is None else config.frames
        text["frames"] = ":".join("" if part is None else str(part) for part in parts)
    return [(name, _option(value)) for name, value in text.items()]


def _option(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return str(value) or UNKNOWN


def cross_sections(subject: Subject) -> Html:
    """Draw the returns of both LiDARs of a pair on each of its poles, in the plane across it."""
    pair = subject.pair
    target, source = (of_lidar[0] for of_lidar in subject.scans)
    if pair is None or pair.chosen is None or pair.T_target_source is None:
        return EMPTY
    if target is None or source is None or target.detection is None or source.detection is None:
        return EMPTY
    T, figures = pair.T_target_source, []
    for i, j in pair.chosen.pairs:
        points = target.poles[i].xyz, se3.apply(T, source.poles[j].xyz)
        figures.append(_figure(pair_name((i, j)), *points, T[:3, 3], pair.config.radius_m))
    return fill("sections", figures=join(figures))


def across(points: Array) -> tuple[Array, Array]:
    """Find the plane across the line that points (N, 3) lie along: centre (3,), axes (2, 3)."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    return centre, axes[1:]


def fit_circle(flat: Array, radius: float, start: Array) -> tuple[Array, bool]:
    """Fit a circle of a given radius to points (N, 2), with weights against strays, metres.

    Gives its centre (2,) from a start (2,), and whether the fit converged.
    """
    # Not at the top: scipy's optimisers take a while to import.
    from scipy.optimize import least_squares

    def away(centre: Array) -> Array:
        return np.asarray(np.linalg.norm(flat - centre, axis=1) - radius)

    def slope(centre: Array) -> Array:
        offset = centre - flat
        return np.asarray(offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-9)[:, None])

    robust: dict[str, Any] = {"loss": "soft_l1", "f_scale": RESIDUAL_SCALE, "x_scale": radius}
    found = least_squares(away, start, slope, ftol=None, gtol=None, **robust)
    return np.asarray(found.x), bool(found.success)


def _figure(name: str, target: Array, source: Array, origin: Array, radius: float) -> Html:
    """Draw one pair: points (N, 3) and (M, 3), the source's origin (3,), in the target frame."""
    centre, axes = across(np.concatenate([target, source]))
    flat = [(points - centre) @ axes.T for points in (target, source)]
    # Returns lie in front of the axis: it is to be found on their far side.
    sensors = [-(axes @ centre), axes @ (origin - centre)]
    towards = [s / max(float(np.linalg.norm(s)), 1e-9) for s in sensors]
    start = -np.mean(towards, axis=0) * radius * np.pi / 4
    middle, converged = fit_circle(np.concatenate(flat), radius, start)
    distances = np.linalg.norm(np.concatenate(flat) - middle, axis=1)
    rms = float(np.sqrt(np.mean((distances - radius) ** 2)))
    half_width = float(max(3 * radius, np.quantile(distances, SHOWN_RETURNS)))
    scale = (HALF_PICTURE - 14) / half_width
    colours = [colour_class(k) for k in range(len(LIDARS))]
    dots = join(
        fill("return", colour=colour, x=x, y=y)
        for colour, points in zip(colours, flat, strict=True)
        for x, y in ((points - middle) * scale * [1, -1])
        if max(abs(x), abs(y)) < HALF_PICTURE
    )
    inner, outer = HALF_PICTURE - 12, HALF_PICTURE - 2
    rim = join(
        fill("rim", colour=colour, x1=x * inner, y1=-y * inner, x2=x * outer, y2=-y * outer)
        for colour, (x, y) in zip(colours, towards, strict=True)
    )
    bar = 10.0 ** np.floor(np.log10(half_width))
    text, kind = f"{1000 * rms:.1f} mm rms from the surface", ""
    if not converged:
        text, kind = f"{text} (the fit of the circle did not converge)", " unconverged"
    return fill(
        "section",
        name=name,
        text=text,
        returns=f"{len(target)} + {len(source)} returns",
        dots=dots,
        rim=rim,
        kind=kind,
        radius=radius * scale,
        bar=bar * scale,
        cm=f"{100 * bar:g}",
    )


def missing_poles(subject: Subject) -> Html:
    """For each LiDAR of a refused pair that sees too few poles: state what it sees, and what is
    missing."""
    pair = subject.pair
    if pair is None or pair.status != "refused":
        return EMPTY
    needed = pair.config.poles or 2
    parts = []
    for j, both in enumerate(zip(*subject.scans, strict=True), 1):
        where = f" in placement {j}" if len(subject.scans[0]) > 1 else ""
        for k, lidar in enumerate(LIDARS):
            scan, other = both[k], both[1 - k]
            if scan is None or other is None or scan.detection is None:
                continue
            if len(scan.poles) < needed:
                title = f"The {lidar} sees {len(scan.poles)} of {needed} poles{where}"
                items = fill_each("li", _items(k, scan, other))
                parts.append(fill("lacking", title=title, items=items))
    return fill("missing", parts=join(parts)) if parts else EMPTY


def _items(lidar: int, scan: Scan, other: Scan) -> Iterator[str]:
    """Name the poles that one LiDAR sees, then what else may be one."""
    assert scan.detection is not None
    origin = scan.cloud.origin
    for k, pole in enumerate(scan.poles):
        yield (
            f"Pole {pole_name(LIDARS[lidar], k)}, {_place(pole.point - origin)}: "
            f"{counted(len(pole.index), 'return')} on {counted(pole.rings, 'ring')}."
        )
    rejected = list(enumerate(scan.detection.rejected))
    threshold = f"{scan.detection.threshold:g}"
    unseen = (
        f"its returns are below the threshold of {threshold}, or something hides it, or it "
        "is outside the field of view."
    )
    if not rejected:
        yield f"Nothing else is as bright as tape. If the pole is present, {unseen}"
        return
    distances = _distances(other.poles)
    if not scan.poles or not distances:
        # First those of which too little was seen: nearer, they may be poles.
        little = sorted(rejected, key=lambda each: each[1].code not in TOO_LITTLE)
        for k, cluster in little[:NAMED]:
            yield _candidate(lidar, k, cluster, scan)
        if len(rejected) > NAMED:
            yield f"{counted(len(rejected) - NAMED, 'more bright cluster')}, listed under Poles."
        return
    near = sorted(
        (abs(_distance_to_axis(pole, cluster.centre) - distance), k, n)
        for k, cluster in rejected
        for n, pole in enumerate(scan.poles)
        for distance in distances
    )
    fitting = list(dict.fromkeys((k, n) for apart, k, n in near if apart <= SAME_DISTANCE))
    clusters = scan.detection.rejected
    for k, n in fitting[:NAMED]:
        place = f"{_distance_to_axis(scan.poles[n], clusters[k].centre):.1f} m from"
        name = pole_name(LIDARS[lidar], n)
        yield _candidate(lidar, k, clusters[k], scan, f", {place} {name}")
    listed = " or ".join(dict.fromkeys(f"{distance:.1f}" for distance in distances))
    there = f"The other LiDAR sees poles {listed} m from each other"
    if fitting:
        yield f"{there}: the clusters named here fit that."
    else:
        yield (
            f"{there}. None of the {len(rejected)} rejected clusters fits that. If the pole is "
            f"present, {unseen}"
        )


def _candidate(lidar: int, k: int, cluster: RejectedCluster, scan: Scan, near: str = "") -> Html:
    """Describe the position of a rejected cluster, and what it lacks to be a pole."""
    away = cluster.centre - scan.cloud.origin
    name = f"Cluster {rejected_mark(lidar, k)}, {_place(away)}{near}"
    return fill("candidate", name=name, lacks=_lacks(cluster, scan, float(np.linalg.norm(away))))


def _lacks(cluster: RejectedCluster, scan: Scan, distance: float) -> str:
    """State how much is missing, in numbers if there are any; else the reason and its advice."""
    returns, ring = len(cluster.index), scan.cloud.ring
    if cluster.code == "too_few_points" and returns < MIN_POLE_POINTS:
        count = f"{counted(returns, 'return')}, {MIN_POLE_POINTS} are needed"
        return f"{count}: {_nearer(distance, returns / MIN_POLE_POINTS)}"
    rings = 0 if ring is None else len(np.unique(ring[cluster.index]))
    if cluster.code == "too_few_rows" and 0 < rings < MIN_POLE_RINGS:
        count = f"on {counted(rings, 'ring')}, {MIN_POLE_RINGS} are needed"
        return f"{count}: {_nearer(distance, rings / MIN_POLE_RINGS)}"
    known = explain(cluster.code) if cluster.code != "too_few_points" else None
    advice = fill_each("sentence", map(inline, known.advice if known else ()))
    return fill("lacks", reason=cluster.reason, advice=advice)


def _nearer(distance: float, share: float) -> str:
    """State how much nearer a pole has the required number of returns, or rings.

    Rings on a pole are as the inverse of its distance, and returns on each ring grow towards the
    LiDAR, too: this much nearer there are enough, on average at least.
    """
    enough = share * distance
    if enough < NEAREST:
        return "if it is your pole, place it much nearer."
    return f"if it is your pole, place it {math.ceil(10 * (distance - enough)) / 10:.1f} m nearer."


def _place(away: Array) -> str:
    """Describe a position as seen by the LiDAR: its distance and azimuth."""
    azimuth = math.degrees(math.atan2(away[1], away[0]))
    return f"{float(np.linalg.norm(away)):.1f} m away at azimuth {azimuth:.0f}°"


def _distances(poles: Sequence[Pole]) -> list[float]:
    """How far each pole's centre is from the line of each other, metres, without repetition."""
    found = sorted(_distance_to_axis(a, b.point) for a, b in permutations(poles, 2))
    return [d for k, d in enumerate(found) if k == 0 or d - found[k - 1] > 0.05]


def _distance_to_axis(pole: Pole, point: Array) -> float:
    """Distance of a point from the line of a pole, metres."""
    return float(np.linalg.norm(np.cross(point - pole.point, pole.direction)))
