"""What was read of each LiDAR and placement, and what was found in it."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import msgspec

from ...base.quantities import counted
from ...result.site import FoundDoc, SiteDoc
from ..markup import MISSING, number, table
from ..text import left_out_words
from .names import placement_name


def found(document: SiteDoc) -> str:
    """Say what was found in every recording: of a refused site, all of it unfolded."""
    if not document.found:
        return ""
    rows = [
        (lidar.name, *(_cell(each) for each in of_lidar))
        for lidar, of_lidar in zip(document.lidars, document.found, strict=True)
    ]
    header = ("LiDAR", *_placements(document))
    refused = document.status == "refused"
    listed = "".join(
        _lidar(document, k, of_lidar, refused) for k, of_lidar in enumerate(document.found)
    )
    return (
        '<section aria-labelledby="found"><h2 id="found">What was found</h2>'
        "<p>Poles that each LiDAR sees in each placement, and retro-reflective clusters that are "
        "none. Two poles in common link two LiDARs.</p>"
        + table("Poles found in each placement", header, rows, range(1, len(header)))
        + listed
        + "</section>"
    )


def _placements(document: SiteDoc) -> list[str]:
    return [placement_name(document.placements, j) for j in range(len(document.placements))]


def _cell(each: FoundDoc | None) -> str:
    if each is None:
        return "not recorded"
    said = counted(len(each.poles), "pole")
    if each.rejected:
        said += f", {len(each.rejected)} rejected"
    return said if each.refusal is None else f"{said} ({each.refusal.code})"


def _lidar(document: SiteDoc, k: int, of_lidar: Sequence[FoundDoc | None], unfold: bool) -> str:
    poles, rejected, refusals = [], [], []
    for name, each in zip(_placements(document), of_lidar, strict=True):
        if each is None:
            continue
        if each.refusal is not None:
            refusals.append(f"Placement {name}: {each.refusal.message}.")
        for pole in each.poles:
            figures = [number(v, 2) for v in pole.point_m]
            size = (number(pole.length_m, 2), pole.points, pole.rings, number(pole.rms_m, 1, 1000))
            poles.append((name, *figures, *size))
        for cluster in each.rejected:
            figures = [number(v, 2) for v in cluster.centre_m]
            rejected.append((name, cluster.code, cluster.reason, cluster.points, *figures))
    if not (poles or rejected or refusals):
        return ""
    lidar = document.lidars[k].name
    at = ("x, m", "y, m", "z, m")
    listed = (
        table(
            f"Poles in the frame of {lidar}",
            ("placement", *at, "length, m", "points", "rings", "rms, mm"),
            poles,
        )
        if poles
        else ""
    )
    if rejected:
        header = ("placement", "code", "reason", "points", *at)
        listed += table(f"Rejected clusters of {lidar}", header, rejected, (1, 2))
    said = "".join(f"<p>{escape(each)}</p>" for each in refusals)
    is_open = " open" if unfold and refusals else ""
    return (
        f"<details{is_open}><summary>{escape(lidar)}: {counted(len(poles), 'pole')}, "
        f'{counted(len(rejected), "rejected cluster")}</summary>{said}<div class="stack">{listed}'
        "</div></details>"
    )


def run(document: SiteDoc) -> str:
    """List inputs, options, version and times."""
    inputs = [
        (
            document.lidars[item.lidar].name,
            placement_name(document.placements, item.placement),
            item.path,
            f"{item.points:,}",
            f"{item.dropped:,}" + (f" ({left_out_words(item)})" if left_out_words(item) else ""),
            item.sensor,
            MISSING if item.threshold is None else f"{item.threshold:g}",
            item.sha256,
        )
        for item in document.inputs
    ]
    header = (
        *("LiDAR", "placement", "path", "points", "dropped", "sensor", "threshold"),
        "sha256",
    )
    notes = [
        f"{row[0]}, {row[1]}: {note}"
        for row, item in zip(inputs, document.inputs, strict=True)
        for note in item.notes
    ]
    times = [(step, number(seconds, 3)) for step, seconds in document.seconds.items()]
    times.append(("sum", number(float(sum(document.seconds.values())), 3)))
    return (
        '<section aria-labelledby="run"><h2 id="run">This run</h2>'
        f"<p>retropole {escape(document.version)}, {escape(document.created)}</p>"
        + (table("Inputs", header, inputs, (1, 2, 5, 7)) if inputs else "")
        + "".join(f"<p>{escape(note)}</p>" for note in notes)
        + '<div class="columns">'
        + table("Site", ("what", "value"), _site(document), (1,))
        + table("Time", ("step", "seconds"), times)
        + "</div></section>"
    )


def _site(document: SiteDoc) -> list[tuple[str, str]]:
    """Write how the site was read and what was asked of it."""
    need = document.need
    said = {
        "name": document.name,
        "datum": document.datum,
        "frame": document.frame.name,
        "reference": document.lidars[document.reference].name,
        "radius": f"{1000 * document.radius_m:g} ± {1000 * document.radius_sigma_m:g} mm",
        "asked for": None if need is None else f"{100 * need.within:g} cm at {need.at:g} m",
        "surveyed poles": len(document.surveyed_poles),
        "control points": len(document.control_points),
        **msgspec.structs.asdict(document.config),
    }
    return [(key.replace("_", " "), _written(value)) for key, value in said.items()]


def _written(value: object) -> str:
    if value is None or value == "":
        return MISSING
    if isinstance(value, tuple):
        return ":".join("" if part is None else str(part) for part in value)
    return str(value)
