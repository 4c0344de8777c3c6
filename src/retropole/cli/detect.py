"""The command ``retropole detect``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import (
    CLOUD,
    CONTEXT,
    INTENSITY,
    OUT,
    SENSOR_HELP,
    frames_option,
    max_points_option,
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
@click.argument("file", type=CLOUD)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-out"),
    show_default=True,
    help="Folder for detect.png.",
)
@radius_option
@click.option("--sensor", default="auto", show_default=True, help=SENSOR_HELP)
@click.option(
    "--threshold", type=INTENSITY, help="Intensity from which a return is retro-reflective."
)
@topic_option
@frames_option
@max_points_option
@unit_option
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def detect(
    file: Path,
    out: Path,
    radius: float,
    sensor: str,
    threshold: float | None,
    topic: str | None,
    frames: slice | None,
    max_points: int,
    unit: Unit,
    as_json: bool,
    quiet: bool,
) -> int:
    """Show the poles in FILE, and why every other retro-reflective object is rejected.

    Writes a picture, detect.png (needs the extra 'figures').

    \b
    Examples:
      retropole detect front.pcd
      retropole detect front.pcd --threshold 120 --out look
      retropole detect front.pcd --json | jq .poles
      retropole detect drive.bag --topic /front --frames 0:20

    \b
    Exit code:
      0    looked, and found poles or none
      2    the file or an option is wrong
      3    refused: the file has no intensity
    """
    from dataclasses import replace

    from ..api.detection import detect_in
    from ..api.inputs import input_documents
    from ..base.errors import MissingExtraError, printable
    from ..report.figures import draw_detection
    from ..report.text import describe_detection
    from ..result import detection_document, encode

    with progress_on_terminal(quiet) as progress:
        progress("read")
        given = read_input(
            file,
            sensor,
            threshold,
            topic=topic,
            frames=frames,
            max_points=max_points,
            unit=unit,
            quiet=quiet,
            progress=progress,
        )
        progress("extract")
        found = detect_in(given, radius)
        written: list[str] = []
        progress("draw")
        try:
            draw_detection(given.cloud, found, out / "detect.png", title=printable(file.name))
            written.append(str(out / "detect.png"))
        except MissingExtraError as error:
            say(f"retropole: no picture: {error}")
    used = replace(given, threshold=found.threshold)
    result = detection_document(found, input_documents([used])[0])
    if as_json:
        show(encode(result))
    elif not quiet:
        show(describe_detection(result, written))
    return 0
