"""The command ``retropole export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..api import transforms
from ..api.transforms import FORMATS, TREE_FORMATS
from ..base.files import write_atomically
from .common import echo_warning, fill_in, say, show
from .options import CLOUD, FILE, Brief

if TYPE_CHECKING:
    from ..api.inputs import Input

MCAP = "mcap"
"""The one with the clouds too; it is written to a file, and no transform is read from it."""

TITLES = {name: each.title for name, each in FORMATS.items()}
TITLES[MCAP] = "ROS 2 recording for Foxglove, RViz: both clouds and /tf_static"
TREE_TITLES = {name: each.title for name, each in TREE_FORMATS.items()}
TREE_TITLES[MCAP] = "ROS 2 recording: /tf_static of all frames, no clouds"


@click.command(cls=Brief)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("clouds", type=CLOUD, nargs=-1, metavar="[TARGET SOURCE]")
@click.option("--to", "fmt", type=click.Choice(list(TITLES | TREE_TITLES)), help="Format to write.")
@click.option(
    "--from",
    "source_format",
    type=click.Choice(["auto", *FORMATS]),
    default="auto",
    help="Format of RESULT.",
)
@click.option("--out", type=FILE, help="File to write.  [default: print]")
@click.option(
    "--parent", help="Frame of the target's LiDAR itself.  [default: as in RESULT, or target]"
)
@click.option(
    "--child", help="Frame of the source's LiDAR itself.  [default: as in RESULT, or source]"
)
@click.option(
    "--mounting",
    type=FILE,
    help="Where the target's LiDAR is mounted: a transform base_link -> target, in any format "
    "that is read. The output is base_link -> source.",
)
@click.option("--invert", is_flag=True, help="Write the inverse: parent and child are exchanged.")
@click.option(
    "--into",
    type=FILE,
    help="URDF to write the pose into: the joint that leads to the source's link is written, "
    "from its parent link. The rest of the file stays unchanged; --out writes to "
    "another file. Needs the extra 'urdf'.",
)
def export(
    result: Path,
    clouds: tuple[Path, ...],
    fmt: str | None,
    source_format: str,
    out: Path | None,
    parent: str | None,
    child: str | None,
    mounting: Path | None,
    invert: bool,
    into: Path | None,
) -> int:
    """Write the transform of RESULT, or all of a site, in the format of another program.

    RESULT is result.json, its folder, or any file that this command wrote. The
    target is the parent frame, the source the child: the transform maps points of the child into
    the parent, and is the pose of the child in the parent. Every output states this. --parent
    and --child name the frames of the LiDARs, never a robot's base: for the pose in base_link give
    --mounting or --into.

    \b
    --to mcap writes the clouds with it, those that RESULT names; give TARGET and SOURCE if they
    have been moved, or if RESULT is no result.json.

    \b
    Formats:
      FORMATS

    Of a site, RESULT is site-result.json. All its frames are written as one tree: map (where the
    survey has separate coordinates) over site over every LiDAR. Where level.json is
    next to it, site has ground too, and that base_footprint, as 'level' found them. With --parent
    and --child, which name two LiDARs, site or map, the transform between these is written, in any
    format above, with the covariance of both together.

    \b
    Formats of a whole site:
      FORMATS_OF_A_SITE

    \b
    Examples:
      retropole export retropole-out --to ros2 --parent front_lidar --child rear_lidar
      retropole export result.json --to matrix --invert
      retropole export result.json --into robot.urdf --parent front_lidar --child rear_lidar
      retropole export result.json --to launch --mounting base_to_front.yaml --child rear_lidar
      retropole export sensors_calibration.yaml --to urdf --parent front --child rear
      retropole export retropole-out --to mcap --out aligned.mcap
      retropole export site-result.json --to geojson --out lidars.geojson
      retropole export site-result.json --to ros2 --parent mast-a --child mast-b

    \b
    Exit code:
      0    written
      2    a file or an option is wrong
      3    RESULT was refused: it has no transform
    """
    if fmt is None and into is None:
        raise click.UsageError(f"--to is needed: one of {', '.join(TITLES | TREE_TITLES)}")
    if into is not None and fmt not in (None, "urdf"):
        raise click.UsageError(f"--into writes a joint, --to urdf, not --to {fmt}")
    if clouds and fmt != MCAP:
        raise click.UsageError(f"only --to {MCAP} takes clouds")
    if fmt == MCAP and out is None:
        raise click.UsageError(f"--to {MCAP} needs --out: it cannot be printed")
    if mounting is not None and (into is not None or fmt == MCAP):
        why = f"--to {MCAP} has only the LiDARs" if into is None else "the robot file has it"
        raise click.UsageError(f"--mounting does not apply: {why}")
    base = None if mounting is None else transforms.read_mounting(mounting, parent)
    parent = base.child if base else parent
    if parent is None or child is None:
        tree = transforms.read_tree(result) if source_format in ("auto", "json") else None
        if tree is not None:
            if parent or child or invert or clouds or into is not None or mounting is not None:
                raise click.UsageError(
                    f"{result} is of a site: --parent and --child together name two of its frames; "
                    "without both, all of them are written, and --invert, --into, --mounting and "
                    "clouds do not apply"
                )
            _warn(result)
            if fmt not in TREE_TITLES:
                raise click.UsageError(
                    f"--to {fmt} has one transform; name two frames of the site with --parent "
                    f"and --child, or write all frames: --to {', '.join(TREE_TITLES)}"
                )
            if fmt == MCAP:
                _write(transforms.write_transforms(tree.edges, tree.verdict), out)
            else:
                _write(TREE_FORMATS[fmt].write(tree), out)
            return 0
    if fmt not in (None, *TITLES):
        raise click.UsageError(f"--to {fmt} takes all of a site: site-result.json")
    transform = transforms.read_transform(result, fmt=source_format, parent=parent, child=child)
    _warn(result)
    if base is not None:
        transform = transforms.mounted(transform, base)
    if invert:
        transform = transforms.inverted(transform)
    if into is not None:
        robot, change = transforms.put_into_robot(into, transform)
        _write(robot, out or into)
        _note(change)
    elif fmt == MCAP:
        if set(transform.roles) != {"target", "source"}:
            raise click.UsageError(
                f"{result} is no transform from LiDAR to LiDAR: --to {MCAP} aligns their clouds by "
                "one"
            )
        from ..api.inputs import Listener
        from ..api.stored import recording_of

        listener = Listener(on_read=_report_origin)
        _write(recording_of(transform, result, clouds, _note, listener), out)
    else:
        _write(FORMATS[fmt or "urdf"].write(transform), out)
    return 0


fill_in(export, "FORMATS_OF_A_SITE", TREE_TITLES, width=12)
fill_in(export, "FORMATS", TITLES, width=12)


def _write(text: str | bytes, out: Path | None) -> None:
    """Write to a file, or print."""
    if out is None:
        show(text)
    else:
        write_atomically(out, text if isinstance(text, bytes) else text.encode())


def _warn(path: Path) -> None:
    """Print on stderr the warnings of a result; other files have no verdict."""
    for reason in transforms.read_verdict(path):
        echo_warning(reason.code, reason.message)


def _note(text: str) -> None:
    say(f"retropole: {text}")


def _report_origin(given: Input) -> None:
    """Print on stderr the beam origin of a cloud if it is not the origin."""
    if given.cloud.origin.any():
        _note(
            f"{given.name}: its beams start at {given.cloud.origin.tolist()}, which a PointCloud2 "
            "cannot store: use the copy for viewing only, and calibrate from the original"
        )
