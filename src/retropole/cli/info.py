"""The command ``retropole info``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import CLOUD, CONTEXT, frames_option, progress_on_terminal, show, unit_option

if TYPE_CHECKING:
    from ..io.units import Unit


@click.command(context_settings=CONTEXT)
@click.argument("file", type=CLOUD)
@click.option("--topic", metavar="NAME", help="Topic of a bag.  [default: all of point clouds]")
@frames_option
@unit_option
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON, and only that.")
def info(file: Path, topic: str | None, frames: slice | None, unit: Unit, as_json: bool) -> int:
    """Say what FILE holds: topics, frames, fields, intensities, and which sensor it may be of.

    FILE is whatever calibrate reads: a point cloud, a folder of them, a bag, or packets.

    \b
    Examples:
      retropole info front.pcd
      retropole info drive.bag
      retropole info drive.mcap --topic /front --frames 0:50
      retropole info front.pcap --json | jq .clouds[0].fields

    \b
    Exit code:
      0    looked
      2    the file or an option is wrong
    """
    from ..io.contents import describe
    from ..report.contents_text import describe_info
    from ..result import encode

    with progress_on_terminal(as_json) as progress:
        progress("read")
        document = describe(file, topic=topic, frames=frames, unit=unit)
    show(encode(document) if as_json else describe_info(document))
    return 0
