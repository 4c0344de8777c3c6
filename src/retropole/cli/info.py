"""The command ``retropole info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..result import RunConfig
from .common import progress_on_terminal, show, show_written
from .options import CLOUD, FILE, Brief, run_option, run_options


@click.command(cls=Brief)
@click.argument("file", type=CLOUD)
@run_option("target_topic", "--topic", help="Topic of a bag.  [default: all with point clouds]")
@run_options("frames", "unit", "intensity", "angles")
@click.option("--page", type=FILE, help="Page to write: the cloud, with the threshold as a slider.")
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON, and only that.")
def info(file: Path, page: Path | None, as_json: bool, **options: Any) -> int:
    """Describe FILE: topics, frames, fields, intensities, and which sensor it may be of.

    FILE is whatever calibrate reads: a point cloud, a folder of clouds, a bag, or packets.

    \b
    Examples:
      retropole info front.pcd
      retropole info drive.mcap --topic /front --frames 0:50
      retropole info front.pcd --page front.html
      retropole info front.pcap --json | jq .clouds[0].fields

    \b
    Exit code:
      0    looked
      2    the file or an option is wrong
    """
    from ..api.contents import look_into
    from ..base.datatypes import Scan
    from ..base.files import write_atomically
    from ..report import render_recordings
    from ..report.text import describe_cloud, describe_info
    from ..result import encode

    how = RunConfig(**options).of_target
    with progress_on_terminal(as_json) as progress:
        progress("read")
        document, clouds = look_into(file, how)
        if page is not None:
            progress("write")
            names = [each.topic or file.name for each in document.clouds]
            texts = [describe_cloud(each) for each in document.clouds]
            scans = [Scan(cloud) for cloud in clouds]
            write_atomically(page, render_recordings(names, scans, texts).encode())
    show(encode(document) if as_json else describe_info(document))
    if page is not None and not as_json:
        show_written(page)
    return 0
