"""The command ``retropole view``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..result import RunConfig
from .common import listening, say, show
from .options import CLOUD, Whole, run_option, run_options


@click.command()
@click.argument("files", type=CLOUD, nargs=-1, required=True)
@run_options("radius_m")
@run_option("sensor_target", "--sensor")
@run_option(
    "threshold_target", "--threshold", help="Where the sliders start.  [default: as in detect]"
)
@run_option("target_topic", "--topic")
@run_options("frames", "unit")
@click.option(
    "--port",
    type=Whole(1, 65535),
    default=8080,
    help="Port on this machine; the next free one where it is in use.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but the address and errors.")
def view(files: tuple[Path, ...], port: int, quiet: bool, **options: Any) -> int:
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
      130  ended by Ctrl-C, the normal end
    """
    import time

    from ..api.detection import finder
    from ..api.inputs import read_input
    from ..report.viewer import Shown, serve

    config = RunConfig(**options)
    with listening(quiet, config.frames) as listener:
        listener.progress("read")
        inputs = [read_input(file, config.of_target, listener) for file in files]
        listener.progress("extract")
        shown = [
            Shown(str(file), given.cloud, finder(given, config.radius_m), given.threshold)
            for file, given in zip(files, inputs, strict=True)
        ]
        viewer = serve(shown, port=port)
    try:
        show(viewer.url)
        if not quiet:
            say("Open the address in a browser; Ctrl-C ends.")
        while True:
            time.sleep(1.0)
    finally:
        viewer.stop()
