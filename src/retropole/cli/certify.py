"""The command ``retropole certify``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..datatypes import MAX_RADIUS
from ..result import DEFAULT_CONFIG
from .calibrate import placed_pairs
from .common import (
    CLOUD,
    CONTEXT,
    EXIT_REFUSED,
    Number,
    echo_refusal,
    frames_option,
    in_colour,
    max_points_option,
    progress_on_terminal,
    radius_option,
    read_input,
    sensor_options,
    show,
    topic_options,
    unit_options,
)

if TYPE_CHECKING:
    from ..api.inputs import Input
    from ..io.units import Unit

EXIT_FAILED = 4
EXITS = {"pass": 0, "fail": EXIT_FAILED, "refused": EXIT_REFUSED}


@click.command(context_settings=CONTEXT)
@click.argument("target", type=CLOUD, required=False)
@click.argument("source", type=CLOUD, required=False)
@click.option(
    "--placement",
    "placements",
    type=(CLOUD, CLOUD),
    multiple=True,
    metavar="TARGET SOURCE",
    help="Instead of TARGET and SOURCE: one placement of the poles of several; repeat it.",
)
@radius_option
@click.option(
    "--radius-sigma",
    type=Number(min=0, max=MAX_RADIUS),
    default=DEFAULT_CONFIG.radius_sigma_m,
    show_default=True,
    help="1 sigma of the radius, m; at least 2 % of it is taken.",
)
@sensor_options
@topic_options
@frames_option
@max_points_option
@unit_options
@click.option("--json", "as_json", is_flag=True, help="Print the document, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def certify(
    target: Path | None,
    source: Path | None,
    placements: tuple[tuple[Path, Path], ...],
    radius: float,
    radius_sigma: float,
    sensor_target: str,
    sensor_source: str,
    threshold_target: float | None,
    threshold_source: float | None,
    target_topic: str | None,
    source_topic: str | None,
    frames: slice | None,
    max_points: int,
    unit: Unit,
    unit_source: Unit | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Test two LiDARs by the distances between poles, without any calibration.

    TARGET and SOURCE are recordings of the same poles, as for 'calibrate'. Each LiDAR measures the
    distances between the poles for itself; where they differ by more than what is stated of both
    LiDARs allows, the pair fails. Four poles, or several placements, are needed. Name the sensors:
    what is stated of them sets the limits.

    \b
    Examples:
      retropole certify front.pcd rear.pcd --sensor-target XT32 --sensor-source VLP-16
      retropole certify front/ rear/
      retropole certify --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
      retropole certify front.pcd rear.pcd --json > field-test.json

    \b
    Exit code:
      0    pass
      2    a file or an option is wrong
      3    refused: too little to tell; the reason is printed
      4    fail
      130  interrupted
    """
    from functools import partial

    from ..api.inputs import input_documents
    from ..datatypes import Placement
    from ..pipeline import find_poles
    from ..report.field_test import describe_field_test
    from ..result import encode
    from ..result.certification import field_test_document
    from ..site.certification import certify as run

    pairs = placed_pairs(target, source, placements)
    given: list[Input] = []
    with progress_on_terminal(quiet or as_json) as progress:
        read = partial(
            read_input, frames=frames, max_points=max_points, quiet=quiet, progress=progress
        )
        found = []
        for of_target, of_source in pairs:
            progress("read")
            both = (
                read(of_target, sensor_target, threshold_target, topic=target_topic, unit=unit),
                read(
                    of_source,
                    sensor_source,
                    threshold_source,
                    topic=source_topic,
                    unit=unit_source or unit,
                ),
            )
            given += both
            progress("extract")
            scans = [
                find_poles(each.cloud, sensor=each.sensor, threshold=each.threshold, radius=radius)
                for each in both
            ]
            found.append(Placement(scans[0], scans[1]))
        progress("certify")
        test = run(found, radius=radius, radius_sigma=radius_sigma)
        document = field_test_document(
            {("target", "source"): test}, radius=radius, inputs=input_documents(given)
        )
    if as_json:
        show(encode(document))
    elif not quiet:
        show(in_colour(describe_field_test(document), document.status))
    if document.status == "refused" and (as_json or quiet):
        for reason in test.reasons:
            echo_refusal(reason.code, reason.message)
    return EXITS[document.status]
