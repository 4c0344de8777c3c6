"""The command ``retropole view``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import (
    CLOUD,
    CONTEXT,
    INTENSITY,
    SENSOR_HELP,
    frames_option,
    progress_on_terminal,
    radius_option,
    read_input,
    say,
    show,
    topic_option,
    unit_option,
)

if TYPE_CHECKING:
    from ..io.units import Unit


@click.command(context_settings=CONTEXT)
@click.argument("files", type=CLOUD, nargs=-1, required=True)
@radius_option
@click.option("--sensor", default="auto", show_default=True, help=SENSOR_HELP)
@click.option(
    "--threshold", type=INTENSITY, help="Where the sliders start.  [default: as in detect]"
)
@topic_option
@frames_option
@unit_option
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    default=8080,
    show_default=True,
    help="Port on this machine; the next free one where it is in use.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but the address and errors.")
def view(
    files: tuple[Path, ...],
    radius: float,
    sensor: str,
    threshold: float | None,
    topic: str | None,
    frames: slice | None,
    unit: Unit,
    port: int,
    quiet: bool,
) -> int:
    """Look at FILES live in a browser: move the threshold, see which poles are found.

    Every rejected cluster is marked with its reason. The page is for this machine alone
    (127.0.0.1). Needs the extra 'view'.

    \b
    Examples:
      retropole view front.pcd rear.pcd
      retropole view front.pcd --sensor VLP-16 --threshold 120
      retropole view drive.bag --topic /front --frames 0:20
      retropole view front.pcd --port 9000

    \b
    Exit code:
      2    a file or an option is wrong
      3    refused: a file has no intensity
      130  ended by Ctrl-C, as it is meant to
    """
    import time

    from ..report.viewer import Shown, serve

    with progress_on_terminal(quiet) as progress:
        progress("read")
        inputs = [
            read_input(file, sensor, threshold, topic=topic, frames=frames, unit=unit, quiet=quiet)
            for file in files
        ]
        progress("extract")
        shown = [
            Shown(str(file), given.cloud, given.sensor, threshold)
            for file, given in zip(files, inputs, strict=True)
        ]
        viewer = serve(shown, radius=radius, port=port)
    try:
        show(viewer.url)
        if not quiet:
            say("Open the address in a browser; Ctrl-C ends.")
        while True:
            time.sleep(1.0)
    finally:
        viewer.stop()
