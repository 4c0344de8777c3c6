"""The command ``retropole merge``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..result.options import Frames
from .common import echo_warning, json_text, listening, say, show, show_written
from .options import CLOUD, FILE, METRES, Brief, Number, Whole, more_option, run_option

if TYPE_CHECKING:
    from ..api.merging import Merged
    from ..base.datatypes import Array

LARGEST_CLOCK = 1e10
"""Clocks differ by no more, seconds: those that count from 1970 and from a start."""

MERGE_SCHEMA = "retropole/merge/1"

COLOURS = "lidar", "intensity", "height"


def _box(context: click.Context, option: click.Parameter, value: str | None) -> Array | None:
    """Turn ``x0,x1,y0,y1,z0,z1`` into two corners; what is left empty has no limit."""
    if value is None:
        return None
    import numpy as np

    try:
        ends = [float(part) if part.strip() else None for part in value.split(",")]
    except ValueError:
        ends = []
    limits = [(-np.inf, np.inf)[k % 2] if end is None else end for k, end in enumerate(ends)]
    box = np.array(limits).reshape(-1, 2).T if len(limits) == 6 else np.zeros((2, 0))
    if box.shape != (2, 3) or not (box[0] < box[1]).all():
        raise click.BadParameter(
            f"{value!r}: expected x0,x1,y0,y1,z0,z1 in metres, the first of each pair less than "
            "the second"
        )
    return box


def _named(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> Any:
    """Turn ``NAME=VALUE``, which may be repeated, into a dictionary."""
    pairs = [text.partition("=")[::2] for text in given]
    for text, (name, value) in zip(given, pairs, strict=True):
        if not (name and value) or sum(name == other for other, _ in pairs) > 1:
            raise click.BadParameter(f"{text!r}: expected NAME=VALUE, once for each LiDAR")
    return dict(pairs)


def _seconds(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> Any:
    """Turn ``NAME=SECONDS``, which may be repeated, into a dictionary."""
    found = _named(context, option, given)
    try:
        seconds = {name: float(value) for name, value in found.items()}
    except ValueError:
        seconds = {"": float("nan")}
    if not all(abs(each) < LARGEST_CLOCK for each in seconds.values()):
        raise click.BadParameter(f"{', '.join(given)}: expected NAME=SECONDS")
    return seconds


@click.command(cls=Brief)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("recordings", type=CLOUD, nargs=-1, metavar="[TARGET SOURCE]")
@click.option("-o", "--out", type=FILE, help="File to write: .ply, .pcd, .las, .laz or .mcap.")
@click.option(
    "--recording",
    "named",
    multiple=True,
    metavar="NAME=PATH",
    callback=_named,
    help="A new recording of a LiDAR of the result, by its name; repeat it for each.",
)
@more_option(
    "--topic",
    "topics",
    multiple=True,
    metavar="NAME=TOPIC",
    callback=_named,
    help="Topic of a LiDAR, if not that of the calibration; repeat it for each.",
)
@click.option(
    "--frame",
    default="",
    show_default=False,
    help="Frame of the coordinates: target, source, the name of a LiDAR, site, map, or ground as "
    "'retropole level' found it.  [default: "
    "target; for a site: map in .las and .laz if it has one, else site]",
)
@more_option(
    "--crs",
    "epsg",
    type=Whole(1024, 1_000_000),
    metavar="EPSG",
    help="Projected system of the map, if not that of the survey.",
)
@run_option(
    "frames", help="Frames of each recording to read, as Python slices: 0:20, ::10.  [default: all]"
)
@click.option(
    "--voxel", type=Number(min=0.001, max=1000), help="One point per cube of this size, m."
)
@click.option(
    "--crop",
    metavar="X0,X1,Y0,Y1,Z0,Z1",
    callback=_box,
    help="Keep only points in a box, m, in the coordinates of the output; empty is no limit.",
)
@click.option("--colour", type=click.Choice(COLOURS), help="Meaning of the colours.")
@click.option(
    "--static", is_flag=True, help="Leave out moving objects. The LiDARs must have been at rest."
)
@click.option(
    "--surfels",
    is_flag=False,
    flag_value=0.3,
    type=METRES,
    metavar="[CELL]",
    help="Make surfels in cells of this size, m (0.3), written as .ply, and report the distances "
    "between the surfaces that two LiDARs see.",
)
@click.option(
    "--live",
    "sources",
    multiple=True,
    metavar="NAME=SOURCE",
    callback=_named,
    help="A live LiDAR, by its name in the result; repeat it for each. Sources are "
    "listed by 'retropole watch --help'. Clouds are published until Ctrl-C.",
)
@more_option(
    "--to-topic",
    metavar="TOPIC",
    help="With --live, the topic to publish on.  [default: /retropole/points, without -o]",
)
@more_option(
    "--clock",
    "clocks",
    multiple=True,
    metavar="NAME=SECONDS",
    callback=_seconds,
    help="With --live, how far the clock of a LiDAR is ahead of that of this computer; repeat it "
    "for each.  [default: from the arrival of its sweeps, if that is a second or more]",
)
@more_option(
    "--no-check", is_flag=True, help="With --live, do not check every minute whether LiDARs moved."
)
@more_option("--domain", type=Whole(0, 232), help="Domain of ROS 2.  [default: ROS_DOMAIN_ID]")
@more_option("--interface", help="Network interface for ROS 2: eth0.  [default: all]")
@click.option("--json", "as_json", is_flag=True, help="Print what was done as JSON, and only that.")
@more_option("-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors.")
def merge(
    result: Path,
    recordings: tuple[Path, ...],
    out: Path | None,
    named: dict[str, str],
    sources: dict[str, str],
    to_topic: str | None,
    clocks: dict[str, float],
    no_check: bool,
    domain: int | None,
    interface: str | None,
    as_json: bool,
    quiet: bool,
    frames: Frames | None,
    **asked: Any,
) -> int:
    """Merge the clouds of all LiDARs of RESULT into one.

    RESULT is result.json, site-result.json or its folder. Its recordings are looked
    for; or give others of the same LiDARs: TARGET and SOURCE of a pair, --recording of a site.
    They are read as the calibration read them, but all frames. Of each point LiDAR, ring, time and
    intensity are kept. Sweeps are not corrected for motion.

    \b
    Examples:
      retropole merge retropole-out -o both.ply --colour lidar
      retropole merge site-result.json -o site.laz --voxel 0.05 --static
      retropole merge out --recording mast-a=a.bag --recording mast-b=b.bag -o day.laz
      retropole merge retropole-out --surfels -o surfels.ply
      retropole merge out --live target=ros2:/front/points --live source=ros2:/rear/points

    \b
    Exit code:
      0    written; with --live, all recordings that were played have ended
      2    a file or an option is wrong
      3    RESULT was refused: it has no pose
      130  interrupted; nothing is written, but with --live all until then
    """
    if sources:
        from ..api.live_merging import CHECK_SECONDS, MERGED, LiveWish
        from .live_merge import merge_until_stopped

        only = [key for key in ("epsg", "colour", "static", "topics") if asked[key]]
        if named or recordings or frames is not None or as_json or only:
            raise click.UsageError(
                "--live takes --to-topic, -o, --frame, --voxel, --crop, --surfels, --clock, "
                "--no-check, --domain and --interface only"
            )
        wish = LiveWish(
            topic=to_topic or (None if out else MERGED),
            out=out,
            clocks=clocks,
            every=None if no_check else CHECK_SECONDS,
            domain=domain,
            interface=interface,
            **{key: asked[key] for key in ("frame", "voxel", "crop", "surfels")},
        )
        return merge_until_stopped(result, sources, wish, quiet)
    if to_topic or clocks or no_check or domain is not None or interface:
        raise click.UsageError("--to-topic, --clock, --no-check and ROS 2 are for --live")
    from ..api.merging import merge as merge_all

    if named and recordings:
        raise click.UsageError("give TARGET and SOURCE, or --recording, not both")
    if out is None and asked["surfels"] is None:
        raise click.UsageError("-o is needed: the file to write")
    given = {name: Path(path) for name, path in named.items()} or recordings
    with listening(quiet, frames, hidden=as_json) as listener:
        merged = merge_all(result, given, out=out, frames=frames, listener=listener, **asked)
    for reason in merged.reasons:
        echo_warning(reason.code, reason.message)
    for note in merged.notes:
        say(f"retropole: {note}")
    if as_json:
        show(json_text(merged_fields(merged, out)))
    elif not quiet:
        show(in_words(merged))
        if out is not None:
            show_written(out)
    return 0


def merged_fields(merged: Merged, out: Path | None) -> dict[str, Any]:
    """Name all that is reported of a merged cloud."""
    names = merged.lidars
    counts = zip(names, merged.sweeps, merged.points, strict=True)
    return {
        "schema": MERGE_SCHEMA,
        "file": None if out is None else str(out),
        "frame": merged.frame,
        "epsg": merged.epsg,
        "lidars": [{"name": name, "sweeps": s, "points": p} for name, s, p in counts],
        "moving": merged.moving,
        "written": merged.written,
        "surfaces": [
            {**each._asdict(), "lidars": [names[k] for k in each.lidars]}
            for each in merged.distances
        ],
        "notes": merged.notes,
        "reasons": merged.reasons,
    }


def in_words(merged: Merged) -> str:
    """Report what was merged, and the distances between surfaces."""
    from ..base.errors import printable
    from ..base.quantities import counted
    from ..report.text import wrapped

    read = ", ".join(
        f"{name} {counted(sweeps, 'sweep')}, {points:,} points"
        for name, sweeps, points in zip(merged.lidars, merged.sweeps, merged.points, strict=True)
    )
    epsg = "" if merged.epsg is None else f" (EPSG:{merged.epsg})"
    lines = [f"read: {read}", f"frame: {merged.frame}{epsg}, metres"]
    if merged.moving:
        lines.append(f"left out: {merged.moving:,} points on moving objects")
    if merged.surfels is None:
        lines.append(f"points written: {merged.written:,}")
    else:
        lines.append(f"surfels: {merged.written:,}")
        lines += merged.surfaces or ["two LiDARs have no surface in common"]
    return "\n".join(part for line in lines for part in wrapped(printable(line), "    "))
