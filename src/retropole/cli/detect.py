"""The command ``retropole detect``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..result import RunConfig
from .common import listening, say, show
from .options import CLOUD, FILE, Brief, more_option, run_option, run_options
from .out import out_folder

PICTURE = "detect.svg"


@click.command(cls=Brief)
@click.argument("file", type=CLOUD)
@out_folder("Folder for detect.svg.", PICTURE)
@run_options("radius_m")
@run_option("sensor_target", "--sensor")
@run_option("threshold_target", "--threshold")
@run_option("target_topic", "--topic")
@run_options("frames", "max_points", "unit", "intensity", "angles")
@click.option("--page", type=FILE, help="Page to write: the cloud, with the threshold as a slider.")
@more_option("--plan", type=CLOUD, help="Plan of the poles: report which are out of place.")
@more_option("--lidar", help="Name of the LiDAR in the plan.  [default: the one that fits]")
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def detect(
    file: Path,
    out: Path,
    page: Path | None,
    plan: Path | None,
    lidar: str | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Show the poles in FILE, and why every other retro-reflective object is rejected.

    Writes a picture, detect.svg, and with --page a page that shows the cloud in any browser, as
    view does.

    \b
    Examples:
      retropole detect front.pcd
      retropole detect front.pcd --page front.html
      retropole detect drive.bag --topic /front --frames 0:20
      retropole detect front.pcd --plan retropole-plan

    \b
    Exit code:
      0    done, whether poles were found or not
      2    the file or an option is wrong
      3    refused: the file has no intensity
    """
    from dataclasses import replace

    from ..api.detection import detect_in
    from ..api.inputs import input_documents, read_input
    from ..base.datatypes import Scan
    from ..base.errors import printable
    from ..base.files import write_atomically
    from ..report import render_recordings
    from ..report.detection import draw_detection
    from ..report.text import describe_detection
    from ..result import encode
    from ..result.contents import detection_document

    wanted = None
    if plan is not None:
        from ..api.plan_checking import load_plan

        # A plan that cannot be read is reported before the work.
        wanted = load_plan(plan, [] if lidar is None else [lidar])
    elif lidar is not None:
        raise click.UsageError("--lidar is a name in the plan: give --plan, too")
    config = RunConfig(**options)
    with listening(quiet, config.frames) as listener:
        listener.progress("read")
        given = read_input(file, config.of_target, listener)
        listener.progress("extract")
        found = detect_in(given, config.radius_m)
        listener.progress("draw")
        draw_detection(given.cloud, found, out / PICTURE, title=printable(file.name))
        written = [str(out / PICTURE)]
        if page is not None:
            scan = Scan(given.cloud, given.sensor, found)
            write_atomically(page, render_recordings([file.name], [scan]).encode())
            written.append(str(page))
    used = replace(given, threshold=found.threshold)
    result = detection_document(found, input_documents([used])[0])
    if as_json:
        show(encode(result))
    elif not quiet:
        show(describe_detection(result, written))
    if wanted is not None and not quiet:
        from ..api.plan_checking import against

        for line in against(wanted, result.poles, lidar):
            say(f"plan: {line}")
    return 0
