"""The command ``retropole level``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import BY_OPTIONS, echo_warning, listening, show, show_written
from .options import CLOUD, FILE, Brief, Number, more_option

if TYPE_CHECKING:
    from ..result.level import LevelDoc

CROSSFALL = 0.025
"""Of a road, as it is built to drain: angle that the ground's normal may differ by from the plumb
line."""


@click.command(cls=Brief)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("clouds", type=CLOUD, nargs=-1, metavar="[CLOUD]...")
@click.option("-o", "--out", type=FILE, help="File to write.  [default: level.json by RESULT]")
@click.option(
    "--disc-m",
    type=Number(min=1.0, max=100.0),
    help="Radius of the disc of ground to which the plane is fitted, m.  [default: 10, or as far "
    "as ground is seen]",
)
@click.option(
    "--base-link",
    metavar="X,Y,YAW_DEG",
    help="Where the LiDAR is on the vehicle, measured along the ground: m, m, deg.",
)
@click.option(
    "--lidar", help="The LiDAR that --base-link describes.  [default: target, or the first]"
)
@click.option(
    "--base-link-sigma",
    type=(Number(min=0.0, max=10.0), Number(min=0.0, max=90.0)),
    default=(0.01, 0.5),
    metavar="M DEG",
    help="1 sigma of x and of y, m, and of the yaw, deg.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the document, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def level(
    result: Path,
    clouds: tuple[Path, ...],
    out: Path | None,
    disc_m: float | None,
    base_link: str | None,
    lidar: str | None,
    base_link_sigma: tuple[float, float],
    as_json: bool,
    quiet: bool,
) -> int:
    """Find roll, pitch and height over the ground of the LiDARs of RESULT.

    RESULT is a result.json, a site-result.json, or its folder. Its recordings are
    looked for as 'report' does; give them where they are at another place now. The plane is the
    one that fits the ground best within a disc below the LiDARs.

    --base-link gives the poses in base_footprint too: the frame of the vehicle on the ground.

    \b
    Examples:
      retropole level retropole-out
      retropole level retropole-out --base-link 1.2,0,0.5
      retropole level quay/site-result.json --json | jq '.lidars[] | {name, roll_rad, height_m}'
      retropole level today/result.json front.pcd rear.pcd --disc-m 6

    \b
    Exit code:
      0    found
      2    RESULT or a recording cannot be read, or an option is wrong
      3    refused: too little ground is seen, or ground at two levels; or RESULT has no poses
    """
    from ..api.leveling import BaseLink, level_result

    base = None
    if base_link is not None:
        try:
            x, y, yaw = (float(word) for word in base_link.split(","))
            if not all(map(math.isfinite, (x, y, yaw))):
                raise ValueError
        except ValueError:
            raise click.BadParameter(
                f"{base_link!r}: expected X,Y,YAW_DEG, such as 1.2,0,0.5", param_hint="--base-link"
            ) from None
        sigma, sigma_yaw = base_link_sigma
        base = BaseLink(x, y, math.radians(yaw), sigma, math.radians(sigma_yaw))
    elif lidar is not None:
        raise click.UsageError("--lidar is the LiDAR that --base-link describes: give both")
    with listening(quiet, None, BY_OPTIONS, units=False, hidden=as_json) as listener:
        document, _ = level_result(
            result, clouds, base=base, lidar=lidar, radius=disc_m, listener=listener
        )
    _write(document, result, out, quiet=quiet, as_json=as_json)
    return 0


LEVEL = more_option(
    "--level", "with_level", is_flag=True, help="Find roll, pitch and height over the ground, too."
)


def write_level(result: Path, quiet: bool) -> None:
    """Level the LiDARs of a result that was just written, and write that next to it.

    If that is refused, the calibration stays what it is: the reason is printed.
    """
    from ..api.leveling import level_result
    from ..base.errors import Refusal

    try:
        document, _ = level_result(result)
    except Refusal as refusal:
        echo_warning(refusal.code, f"no level: {refusal.message}")
        return
    _write(document, result, None, quiet=quiet, as_json=False)


def _write(
    document: LevelDoc, result: Path, out: Path | None, *, quiet: bool, as_json: bool
) -> None:
    """Write a document, next to its result if no file is named, and print its summary."""
    from ..base.files import write_atomically
    from ..result import LEVEL_FILE, any_result_file, encode

    out = out or any_result_file(result).with_name(LEVEL_FILE)
    written = encode(document)
    write_atomically(out, written)
    if as_json:
        show(written)
    elif not quiet:
        show(describe(document))
        show_written(out)


def describe(document: LevelDoc) -> str:
    """List the poses of the LiDARs over the ground, and describe the ground."""
    from ..base.quantities import error

    width = max(5, *(len(lidar.name) for lidar in document.lidars))
    lines = [f"{'LiDAR':{width}}  {'roll':>18}  {'pitch':>18}  {'height':>18}   (± 1 σ)"]
    for lidar in document.lidars:
        sigmas = [math.sqrt(lidar.roll_pitch_height[k, k]) for k in range(3)]
        cells = [
            f"{math.degrees(angle):8.3f} ± {math.degrees(sigma):.3f}°"
            for angle, sigma in zip((lidar.roll_rad, lidar.pitch_rad), sigmas[:2], strict=True)
        ]
        cells.append(f"{lidar.height_m:7.3f} ± {sigmas[2]:.3f} m")
        lines.append(f"{lidar.name:{width}}  " + "  ".join(f"{cell:>18}" for cell in cells))
    about = (
        "the foot of the LiDARs"
        if document.about_foot
        else "the ground that is seen, to one side of them"
    )
    lines += [
        f"ground: {document.area_m2:.0f} m² seen of a disc of {document.disc_radius_m:.0f} m "
        f"about {about}; its edge is {abs(1000 * document.bend_m):.0f} ± "
        f"{1000 * document.bend_sigma_m:.0f} mm {'lower' if document.bend_m > 0 else 'higher'} "
        "than its middle in the direction of the largest bend; roughness "
        f"{error(document.roughness_m)}"
    ]
    lines += [
        f"another level: {100 * other.height:+.0f} cm, {other.area:.0f} m²"
        for other in document.other_levels[:3]
    ]
    if document.ceiling_m is not None:
        lines.append(
            f"a plane {document.ceiling_m:.2f} m above is treated as a ceiling; if the LiDAR "
            "is mounted upside down it is the ground"
        )
    for lidar in document.lidars:
        if lidar.T_base_footprint_lidar is not None:
            x, y, z = lidar.T_base_footprint_lidar[:3, 3]
            lines.append(f"{lidar.name} in base_footprint: {x:.3f} {y:.3f} {z:.3f} m")
    lines.append(
        "The tilt is relative to the ground. Relative to the vertical it is uncertain by the "
        f"tilt of the ground: the crossfall of a road, {100 * CROSSFALL:g} %, is "
        f"{math.degrees(math.atan(CROSSFALL)):.1f}°."
    )
    return "\n".join(lines)
