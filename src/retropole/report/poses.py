"""The pose of every LiDAR: to read, to copy, how certain it is, and what its error is made of."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import RetropoleError
from ..base.quantities import UNKNOWN, Unit, counted, error, percent, value
from ..base.uncertainty import BUDGET_RANGE, RANGES, Uncertainty
from ..export import FORMATS, TREE_FORMATS, export_lines
from ..export.documents import found_in_result
from ..export.transform import NO_LIDARS
from ..export.tree import tree_of
from ..result import BudgetEntry, ResultDoc, verdict_line
from ..result.site import LIDARS, LidarDoc, SiteDoc
from . import listings
from .curves import ErrorCurve, curve_figure
from .listings import (
    Listing,
    checks_of_site,
    columns,
    error_parts,
    fitness_words,
    number,
    numbers,
    radius_words,
    scene_words,
)
from .page import EMPTY, Html, fill, folded, join, listed, plus_minus, table
from .subject import Subject, colour_class, recorded_by
from .verdict import VERDICTS, folded_notes, listed_statements

FRAMES = ("lidar_target", "lidar_source")
"""Frames of a pair in the lines to copy: the page has those of the recordings in their place, or
what the reader types."""

OF_A_LIDAR = f"(?!(.*/)?({'|'.join(sorted(NO_LIDARS))})$).*"
"""What may be typed there."""

UNFOLDED = ("matrix", "ros2")
"""Formats that are shown at once; the page unfolds the others."""

WHOLE = ("launch", "urdf", "yaml")
"""Formats of a whole site that are ready to copy; `retropole export` writes the others."""

STATES = (
    *(f"rotation about {axis} (phi_{axis})" for axis in "xyz"),
    *(f"translation along {axis} (delta_{axis})" for axis in "xyz"),
)
"""The six directions of a covariance, in its order."""

UNITS: tuple[Unit, ...] = ("rad", "rad", "rad", "m", "m", "m")
"""Of the states."""

FOLDED_BELOW = 0.005
"""Sources of error with a smaller share, written ``< 1 %``, are folded away."""

LISTED_SOURCES = 8
"""Number of sources of error that are listed one by one, the largest first: the sheet stays one
page."""


def transform(subject: Subject, curve: ErrorCurve | None) -> Html:
    """Show the transform of a pair, its lines to copy, and its error over the distance."""
    pair = subject.pair
    if pair is None or pair.T_target_source is None:
        return EMPTY
    target, source = recorded_by(pair)
    return fill(
        "transform",
        target=target,
        source=source,
        matrix=transform_matrix(pair.T_target_source),
        parts=pose_parts(pair.T_target_source),
        curve=curve_figure(curve),
        copies=_copies(subject, 1),
    )


def poses(subject: Subject, curve: ErrorCurve | None = None) -> Html:
    """Show every pose of a site, its error, and lines to copy: a summary, and each folded."""
    site = subject.site
    if not subject.answered or subject.pair is not None:
        return EMPTY
    offset = site.frame.offset
    lidars = (
        fill("lidar", colour=colour_class(k), name=site.lidars[k].name, body=_pose(subject, k))
        for k in range(len(site.lidars))
    )
    return fill(
        "poses",
        named=site.frame.name,
        offset=fill("offset", at=", ".join(f"{v:.3f}" for v in offset)) if any(offset) else "",
        table=listed(listings.poses(site)),
        curve=curve_figure(curve),
        whole=_copies_of_site(site),
        lidars=join(lidars),
    )


def _copies_of_site(site: SiteDoc) -> Html:
    """Show the frames of a whole site in formats that take all frames, folded."""
    try:
        tree = tree_of(site)
    except RetropoleError:
        # A name that no frame can have, or a projection that cannot be computed here.
        return EMPTY
    formats = ((key, TREE_FORMATS[key]) for key in WHOLE)
    copies = join(
        fill("copy", key=key, title=each.title, whose=" of all", text=each.write(tree).strip())
        for key, each in formats
    )
    return fill("copies-of-site", body=folded("All LiDARs, to copy", copies))


def _pose(subject: Subject, k: int) -> Html:
    """Show one pose of a site as matrix, translation, quaternion and angles, and all about it."""
    lidar = subject.site.lidars[k]
    T = np.array(lidar.T_site_lidar)
    text = (
        "" if lidar.sensor == "auto" else lidar.sensor,
        f"serial number {lidar.serial}" if lidar.serial else "",
        "" if lidar.fitness is None else lidar.fitness.words,
    )
    about = ", ".join(each for each in text if each)
    return fill(
        "pose",
        about=fill("p", text=about) if about else "",
        matrix=transform_matrix(T, f"T_site_lidar of {lidar.name}"),
        parts=pose_parts(T),
        copies=_copies(subject, k),
        uncertainty=uncertainty(subject, k),
    )


def transform_matrix(T: Array, name: str = "T_target_source") -> Html:
    """Arrange a transform (4, 4) as a matrix under its name."""
    rows = (join(fill("td", kind=EMPTY, text=f"{v:.6f}") for v in row) for row in T)
    return fill("matrix", name=name, rows=join(fill("row", cells=cells) for cells in rows))


def pose_parts(T: Array) -> Html:
    """Write a transform (4, 4) as translation, quaternion and angles."""
    angles = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
    parts = (
        ("translation", "x y z", T[:3, 3], 4, " m"),
        ("quaternion", "x y z w", se3.quaternion_xyzw(T[:3, :3]), 6, ""),
        ("angles", "roll pitch yaw", angles, 3, "°"),
    )
    named = (
        fill(
            "pose-part",
            name=part,
            values=join(
                fill("named", name=name, value=number(value, digits, unit=unit))
                for name, value in zip(names.split(), values, strict=True)
            ),
        )
        for part, names, values, digits, unit in parts
    )
    return fill("pose-parts", body=join(named))


def _copies(subject: Subject, k: int) -> Html:
    """Show a pose in every format, with a button that copies it and says aloud whose it is."""
    T = np.array(subject.site.lidars[k].T_site_lidar)
    names = [lidar.name for lidar in subject.site.lidars]
    parent, fields = "site" if "site" not in names else "site_frame", EMPTY
    if subject.pair is not None:
        found = found_in_result(subject.pair)
        fields = join(
            fill(
                "frame",
                lidar=lidar,
                frame=frame,
                # The page takes no other signs.
                recorded=name if re.fullmatch(r"[\w./-]+", name or "", re.ASCII) else frame,
                pattern=OF_A_LIDAR,
            )
            for lidar, frame, name in zip(LIDARS, FRAMES, found[:2], strict=True)
        )
        fields = fill("frames", body=fields)
    verdict = verdict_line(subject.site.status, subject.site.reasons)
    try:
        lines = export_lines(T, *(FRAMES if subject.pair else (parent, names[k])), verdict)
    except RetropoleError:
        # A name that no frame can have: another program reads the pose all the same.
        lines = export_lines(T, parent, f"lidar_{k}", verdict)
    whose = f" of {names[k]}" if subject.pair is None else ""
    shown, more = (
        join(
            fill("copy", key=key, title=FORMATS[key].title, whose=whose, text=text.strip())
            for key, text in lines.items()
            if (key in UNFOLDED) is wanted
        )
        for wanted in (True, False)
    )
    # The names of the frames change what is shown at once, too.
    return fill("copies", fields=fields, shown=shown, more=folded("More formats", more))


def certainty(subject: Subject) -> Html:
    """State how certain an answer is, in sentences first; for a pair its figures follow."""
    if not subject.answered:
        return EMPTY
    return fill(
        "certainty",
        statements=listed_statements(subject),
        notes=folded_notes(subject),
        body=EMPTY if subject.pair is None else uncertainty(subject, 1),
    )


def uncertainty(subject: Subject, k: int) -> Html:
    """Show the uncertainty of the k-th LiDAR's pose, its effect, and its sources."""
    pair, lidar, name = subject.pair, subject.site.lidars[k], subject.called(k)
    parts = None if pair is None else pair.uncertainty
    kinds = covariances(lidar, parts)
    if kinds and not kinds["1 σ"].any():
        return fill("p", text="Its frame is that of the site: its pose has no error.")
    order = subject.site.covariance_order
    matrices = (
        table(
            f"Covariance of {name}, rad and m: {kind}",
            ("state", *order),
            [(state, *(f"{v:.3e}" for v in row)) for state, row in zip(order, matrix, strict=True)],
        )
        for kind, matrix in kinds.items()
    )
    tables = (
        listed(ranges(lidar, parts, f"A point of {name} in the frame of {subject.frame}")),
        listed(states(kinds, f"Pose of {name}, axes of {subject.frame}")),
        EMPTY if pair is None else listed(_residuals(pair)),
    )
    text = subject.site.covariance_frame if kinds else "This run gives no covariance."
    return fill(
        "uncertainty",
        weakest=EMPTY if pair is None else _weakest(pair),
        kinds=EMPTY if parts is None else fill("kinds"),
        tables=join(tables),
        budget=budget_table(lidar.budget) if lidar.budget else EMPTY,
        said=text,
        matrices=folded("Covariance matrix", join(matrices)),
    )


def covariances(lidar: LidarDoc, parts: Uncertainty | None) -> dict[str, Array]:
    """Give the covariance (6, 6) of a pose, and its two parts where they are stated."""
    if lidar.covariance is None:
        return {}
    whole = {"1 σ": np.asarray(lidar.covariance)}
    return whole | ({"random": parts.random, "systematic": parts.systematic} if parts else {})


def _weakest(pair: ResultDoc) -> Html:
    """Describe the direction in which the pose is least certain."""
    weakest = pair.weakest
    if weakest is None:
        return EMPTY
    direction = ", ".join(numbers(weakest.direction, 2))
    ratio = number(weakest.condition, 1)
    return fill("weakest", direction=direction, ratio=ratio)


def ranges(lidar: LidarDoc, parts: Uncertainty | None, caption: str) -> Listing:
    """State the error of a point, by its range."""
    stated = lidar.predicted_error or []
    ranges_by_error = [
        [error(each.random), error(each.systematic)] for each in error_parts(stated, parts)
    ]
    rows = [
        [f"{each.range_m:g} m", plus_minus(each.sigma_m), *more]
        for each, more in zip(stated, ranges_by_error or [[]] * len(stated), strict=True)
    ]
    kinds = ("random", "systematic") if ranges_by_error else ()
    return Listing(caption, ("at range", "1 σ", *kinds), rows)


def states(kinds: dict[str, Array], caption: str) -> Listing:
    """State the uncertainty of each rotation and translation, in total and of each kind."""
    sigmas = [np.sqrt(np.maximum(np.diag(matrix), 0.0)) for matrix in kinds.values()]
    rows = [
        [state, *(error(float(s), unit) for s in row)]
        for state, unit, row in zip(STATES, UNITS, np.transpose(sigmas), strict=bool(kinds))
    ]
    return Listing(caption, ("state", *kinds), rows)


def _residuals(pair: ResultDoc) -> Listing:
    estimates = (("poles alone", pair.stages.poles), ("refined", pair.stages.refined))
    rows = [(name, number(each.rms, 1, 1000)) for name, each in estimates if each is not None]
    return Listing("Pose estimates", ("estimate", "rms residual, mm"), rows)


def budget_table(budget: Sequence[BudgetEntry]) -> Html:
    """List every source of error, the largest first, each with a bar as long as its share.

    Those of a small share are folded away.
    """
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    # At least the largest is shown, also of a budget of many equal parts.
    shown = max(1, sum(entry.share_at_30m >= FOLDED_BELOW for entry in entries))
    shared = percent(sum(entry.share_at_30m for entry in entries[shown:]))
    rest = _entries("The rest of the error budget", entries[shown:])
    return fill(
        "budget",
        shown=_entries("Error budget", entries[:shown]),
        rest=folded(f"{len(entries) - shown} smaller, together {shared}", rest),
        range=f"{BUDGET_RANGE:g}",
    )


def _entries(caption: str, entries: Sequence[BudgetEntry]) -> Html:
    if not entries:
        return EMPTY
    bars = [
        (
            colour_class(LIDARS.index(entry.sensor)) if entry.sensor in LIDARS else "both",
            entry.share_at_30m,
        )
        for entry in entries
    ]
    return table(*sources(caption, entries), bars)


def sources(caption: str, entries: Sequence[BudgetEntry]) -> Listing:
    """List sources of error; a column says whose each is, where its name does not."""
    whose = any(entry.sensor for entry in entries)
    rows = [
        [
            *(entry.name, *([entry.sensor or UNKNOWN] if whose else [])),
            error(entry.sigma, entry.unit),
            value(entry.estimated, entry.sigma, entry.unit),
            percent(entry.share_at_30m),
        ]
        for entry in entries
    ]
    lidar = ["LiDAR"] if whose else []
    header = ("source of error", *lidar, "1 σ", "estimated", f"share at {BUDGET_RANGE:g} m")
    return Listing(caption, header, rows, (1,) if whose else ())


def certificate(subject: Subject, place: str = "") -> Html:
    """Write the certificate of a pair or of a site; a refusal has none, nor an unusable answer.

    Parameters
    ----------
    subject
        What the page is of, with the serial numbers of its LiDARs; a line to fill in where empty.
    place
        Where it was calibrated; likewise. Of a site, its name if empty.
    """
    site, pair = subject.site, subject.pair
    if not subject.answered or subject.chance_wrong is not None:
        return EMPTY
    several = len(site.placements) > 1
    recordings = [
        (site.lidars[each.lidar].name + f" {each.placement + 1}" * several, each.path, each.sha256)
        for each in site.inputs
    ]
    lidars = [
        (each.name, _given("" if each.sensor == "auto" else each.sensor), _given(each.serial))
        for each in site.lidars
    ]
    return fill(
        "certificate",
        facts=_facts(subject, place),
        lidars=table("LiDARs", columns("LiDAR; sensor; serial number"), lidars, (1, 2)),
        answer=_of_site(site) if pair is None else _of_pair(pair, site.lidars[1]),
        recordings=table("Recordings", ("input", "path", "SHA-256"), recordings, (1, 2)),
    )


def _of_pair(pair: ResultDoc, source: LidarDoc) -> Html:
    """Give the transform, how certain it is, and what its error is made of."""
    T = np.array(pair.T_target_source)
    return fill(
        "certificate-of-pair",
        matrix=transform_matrix(T),
        parts=pose_parts(T),
        ranges=listed(ranges(source, pair.uncertainty, "Where a source point lands, 1 σ")),
        states=listed(states(covariances(source, None), "The pose, target axes")),
        budget=_budget(pair.budget or []),
    )


def _of_site(site: SiteDoc) -> Html:
    """Give the pose of every LiDAR, and where a point of it lands by its range."""
    at = [f"{each:g} m" for each in RANGES]
    rows = [
        (lidar.name, *(plus_minus(each.sigma_m) for each in lidar.predicted_error))
        for lidar in site.lidars
        if lidar.predicted_error and len(lidar.predicted_error) == len(at)
    ]
    errors = (
        table("Where a point lands, 1 σ, by its range", ("LiDAR", *at), rows) if rows else EMPTY
    )
    return fill("certificate-of-site", poses=table(*listings.poses(site)), ranges=errors)


def _given(text: str) -> str:
    """Write what was given, or leave a line to write on."""
    return text or fill("to-fill")


def _facts(subject: Subject, place: str) -> Html:
    """State the place, time, accuracy and equipment."""
    site, pair = subject.site, subject.pair
    warned = ", ".join(reason.code for reason in site.reasons)
    title = VERDICTS.get(site.status, ("", site.status))[1]
    requested = fitness_words(subject)
    facts = [
        ("Site", _given(place or ("" if pair else site.name))),
        ("Calibrated", f"{site.created}, by retropole {site.version}"),
        ("Verdict", fill("bold", text=title + (f": {warned}" if warned else ""))),
        (
            "Tolerance",
            f"{requested[:1].upper()}{requested[1:]}" if requested else fill("tolerance"),
        ),
    ]
    if pair is None:
        facts += [("Frame", site.datum), ("Checks", "; ".join(checks_of_site(site)))]
    else:
        facts += [("Poles", _poles(pair)), ("Scene", scene_words(pair) or "")]
    return join(fill("fact", name=name, value=value) for name, value in facts if value)


def _poles(pair: ResultDoc) -> str:
    """State the number of poles used, and their radius."""
    placements, radius = len(pair.inputs) // 2, radius_words(pair)
    pairs = 0 if pair.chosen is None else len(pair.chosen.pairs)
    parts = (
        counted(pairs, "pair of poles", "pairs of poles") if pairs else "",
        counted(placements, "placement") if placements > 1 else "",
        "" if radius is None else f"radius {radius} (1 σ)",
    )
    return ", ".join(each for each in parts if each)


def _budget(budget: list[BudgetEntry]) -> Html:
    """List the largest sources of error, and the sum of all others."""
    entries = sorted(budget, key=lambda entry: -entry.share_at_30m)
    caption, header, rows, text_columns = sources("Uncertainty budget", entries[:LISTED_SOURCES])
    rest = entries[LISTED_SOURCES:]
    if rest:
        shared = percent(sum(entry.share_at_30m for entry in rest))
        rows = [*rows, [f"{len(rest)} smaller", *[UNKNOWN] * (len(header) - 2), shared]]
    return table(caption, header, rows, text_columns) if rows else EMPTY
