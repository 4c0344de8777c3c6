"""The command ``retropole certify``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from ..base.datatypes import MAX_RADIUS
from ..result import DEFAULT_CONFIG
from .calibrate import placed_pairs
from .common import (
    CLOUD,
    CONTEXT,
    EXIT_REFUSED,
    OUT,
    Number,
    echo_doubts,
    echo_left_out,
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
    from ..result.certification import FieldTestDoc

EXIT_FAILED = 4
RESULT_FILE, PAGE_FILE = "field-test.json", "field-test.html"
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
@click.option("--out", type=OUT, help="Folder for field-test.json and field-test.html.")
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
    out: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Test two LiDARs by the distances between poles, without any calibration.

    TARGET and SOURCE are recordings of the same poles, as for 'calibrate'. Each LiDAR measures the
    distances between the poles for itself; where they differ by more than what is stated of both
    LiDARs allows, the pair fails. Four poles, or several placements, are needed. Name the sensors:
    what is stated of them sets the limits. A site file (.toml) alone as TARGET tests every pair of
    its LiDARs.

    \b
    Examples:
      retropole certify front.pcd rear.pcd --sensor-target XT32 --sensor-source VLP-16
      retropole certify front/ rear/
      retropole certify --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
      retropole certify front.pcd rear.pcd --json > field-test.json
      retropole certify site.toml
      retropole certify site.toml --out field-test

    \b
    Exit code:
      0    pass
      2    a file or an option is wrong
      3    refused: too little to tell; the reason is printed
      4    fail
      130  interrupted
    """
    from ..base.errors import printable
    from ..base.files import write_together
    from ..report.field_test import describe_field_test, render_field_test
    from ..result import encode

    with progress_on_terminal(quiet or as_json) as progress:
        if target is not None and target.suffix == ".toml" and source is None and not placements:
            _refuse_options()
            document = _of_site(target, progress, quiet)
        else:
            document = _of_pair(
                placed_pairs(target, source, placements),
                partial(
                    read_input, frames=frames, max_points=max_points, quiet=quiet, progress=progress
                ),
                (
                    (sensor_target, threshold_target, target_topic, unit),
                    (sensor_source, threshold_source, source_topic, unit_source or unit),
                ),
                (radius, radius_sigma),
                progress,
            )
    written = {}
    if out is not None:
        written = {
            out / RESULT_FILE: encode(document),
            out / PAGE_FILE: render_field_test(document).encode(),
        }
        write_together(written)
    if as_json:
        show(encode(document))
    elif not quiet:
        show(in_colour(describe_field_test(document), document.status))
        if written:
            show("\nwritten: " + ", ".join(printable(str(path)) for path in written))
    if document.status == "refused" and (as_json or quiet):
        for reason in document.pairs[0].reasons if document.pairs else ():
            echo_refusal(reason.code, reason.message)
    return EXITS[document.status]


def _refuse_options() -> None:
    """Refuse what a site file says itself: an option that is ignored is a silent error."""
    context = click.get_current_context()
    given = [
        name
        for name in context.params
        if name not in ("target", "out", "as_json", "quiet")
        and context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise click.UsageError(f"{options}: the site file says so itself")


def _of_site(path: Path, progress: Callable[[str], None], quiet: bool) -> FieldTestDoc:
    """Test every pair of LiDARs of a site file."""
    from ..api.site_inputs import read_site
    from ..result.certification import field_test_document
    from ..site.certification import certify_site

    def tell(given: Input) -> None:
        if not quiet:
            echo_left_out(given, None)
            echo_doubts(given)

    read = read_site(path, progress=progress, on_read=tell)
    lidars = read.site.lidars
    tests = {
        (lidars[a].name, lidars[b].name): test for (a, b), test in certify_site(read.site, progress)
    }
    if not tests:
        raise click.UsageError(f"{path}: no two LiDARs recorded the same placement")
    return field_test_document(
        tests, radius=read.site.radius, inputs=list(read.documents().values())
    )


def _of_pair(
    pairs: Sequence[tuple[Path, Path]],
    read: Callable[..., Input],
    options: Sequence[tuple[str, float | None, str | None, Unit]],
    radius: tuple[float, float],
    progress: Callable[[str], None],
) -> FieldTestDoc:
    """Test two LiDARs by their recordings of one placement or several.

    Parameters
    ----------
    pairs
        Paths of the target's and the source's recording of each placement.
    read
        Reads one.
    options
        Of both LiDARs: name of the sensor, threshold, topic, unit.
    radius
        Of the poles, and its 1 σ, metres.
    progress
        Called with the name of each step.
    """
    from ..api.inputs import input_documents
    from ..base.datatypes import Placement
    from ..pipeline import find_poles
    from ..result.certification import field_test_document
    from ..site.certification import certify as run

    given: list[Input] = []
    found = []
    for pair in pairs:
        scans = []
        for path, (sensor, threshold, topic, unit) in zip(pair, options, strict=True):
            progress("read")
            each = read(path, sensor, threshold, topic=topic, unit=unit)
            given.append(each)
            progress("extract")
            scans.append(
                find_poles(
                    each.cloud, sensor=each.sensor, threshold=each.threshold, radius=radius[0]
                )
            )
        found.append(Placement(scans[0], scans[1]))
    progress("certify")
    test = run(found, radius=radius[0], radius_sigma=radius[1])
    return field_test_document(
        {("target", "source"): test}, radius=radius[0], inputs=input_documents(given)
    )
