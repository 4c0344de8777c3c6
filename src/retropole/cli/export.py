"""The command ``retropole export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..export import FORMATS
from .common import CONTEXT, echo_warning, show

if TYPE_CHECKING:
    from ..export import Transform

FILE = click.Path(path_type=Path, dir_okay=False)
FORMAT_HELP = "\n".join(f"      {name:<14}{each.title}" for name, each in FORMATS.items())


@click.command(
    context_settings=CONTEXT,
    help=f"""Write the transform of RESULT in the format of another program.

    RESULT is result.json, the folder that holds it, or any file that this command wrote. The
    target is the parent frame, the source the child: the transform maps points of the child into
    the parent, and is the pose of the child in the parent. Every output says so in words.

    \b
    Formats:
{FORMAT_HELP}

    \b
    Examples:
      retropole export retropole-out --to ros2 --parent base_link --child rear_lidar
      retropole export result.json --to json --out calibration.json
      retropole export result.json --to matrix --invert
      retropole export result.json --into robot.urdf --parent front_lidar --child rear_lidar
      retropole export sensors_calibration.yaml --to urdf --parent front --child rear

    \b
    Exit code:
      0    written
      2    a file or an option is wrong
      3    RESULT was refused: it holds no transform
    """,
)
@click.argument("result", type=click.Path(path_type=Path))
@click.option("--to", "fmt", type=click.Choice(list(FORMATS)), help="Format to write.")
@click.option(
    "--from",
    "source_format",
    type=click.Choice(["auto", *FORMATS]),
    default="auto",
    show_default=True,
    help="Format of RESULT.",
)
@click.option("--out", type=FILE, help="File to write.  [default: print]")
@click.option("--parent", help="Name of the target's frame.  [default: as in RESULT, or target]")
@click.option("--child", help="Name of the source's frame.  [default: as in RESULT, or source]")
@click.option("--invert", is_flag=True, help="Write the inverse: parent and child change places.")
@click.option(
    "--into",
    type=FILE,
    help="URDF to put the joint into, all else in it byte for byte as it was; --out writes the "
    "outcome elsewhere.",
)
def export(
    result: Path,
    fmt: str | None,
    source_format: str,
    out: Path | None,
    parent: str | None,
    child: str | None,
    invert: bool,
    into: Path | None,
) -> int:
    """Read the transform, invert it where asked, write it."""
    from ..export import inverted, read_transform
    from ..files import write_atomically

    if fmt is None and into is None:
        raise click.UsageError(f"--to is needed: one of {', '.join(FORMATS)}")
    if into is not None and fmt not in (None, "urdf"):
        raise click.UsageError(f"--into takes a joint, --to urdf, not --to {fmt}")
    transform = read_transform(result, fmt=source_format, parent=parent, child=child)
    _warn(result)
    if invert:
        transform = inverted(transform)
    if into is not None:
        _put_into(into, transform, out)
        return 0
    text = FORMATS[fmt or "urdf"].write(transform)
    if out is None:
        show(text)
    else:
        write_atomically(out, text.encode())
    return 0


def _warn(path: Path) -> None:
    """Say on stderr what a result warns of; other files hold no verdict."""
    from ..export import read_verdict

    for reason in read_verdict(path):
        echo_warning(reason.code, reason.message)


def _put_into(robot: Path, transform: Transform, out: Path | None) -> None:
    """Edit a URDF, in place through links and with its permissions, or write it elsewhere."""
    from ..errors import ReadError, UsageError
    from ..export import put_into_urdf
    from ..files import read_document, write_atomically

    try:
        data = put_into_urdf(read_document(robot), transform)
    except (ReadError, UsageError) as error:
        raise type(error)(f"{robot}: {error}") from None
    write_atomically(robot if out is None else out, data)
