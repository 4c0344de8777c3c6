"""The command ``retropole certify``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ..result import RunConfig
from .calibrate import placed
from .common import (
    EXIT_REFUSED,
    EXIT_WARNED,
    echo_refusal,
    in_colour,
    listening,
    show,
    show_written,
)
from .options import READING, SENSORS, TOPICS, Brief, placement_arguments, run_options
from .out import out_folder

EXIT_FAILED = 4
RESULT_FILE, PAGE_FILE = "field-test.json", "field-test.html"
EXITS = {"pass": 0, "partial": EXIT_WARNED, "fail": EXIT_FAILED, "refused": EXIT_REFUSED}


@click.command(cls=Brief)
@placement_arguments
@run_options("radius_m", "radius_sigma_m", *SENSORS, *TOPICS, "frames", "max_points")
@run_options(*READING)
@out_folder("Folder for field-test.json and field-test.html.", RESULT_FILE, PAGE_FILE, default=None)
@click.option("--json", "as_json", is_flag=True, help="Print the document, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def certify(
    target: Path | None,
    source: Path | None,
    placements: tuple[tuple[Path, Path], ...],
    out: Path | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Test two LiDARs by the distances between poles, without any calibration.

    TARGET and SOURCE are recordings of the same poles, as for 'calibrate'. Each LiDAR measures the
    distances between the poles for itself. If they differ by more than the stated errors of both
    LiDARs allow, the pair fails. Four poles, or several placements, are needed. Name the sensors:
    their stated errors set the limits. A site file (.toml), or the folder of site.toml,
    alone as TARGET tests every pair of its LiDARs.

    \b
    Examples:
      retropole certify front.pcd rear.pcd --sensor XT32 --sensor VLP-16
      retropole certify --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
      retropole certify front.pcd rear.pcd --json > field-test.json
      retropole certify site.toml

    \b
    Exit code:
      0    pass
      1    partial: what was tested passes, some LiDARs of a site could not be tested
      2    a file or an option is wrong
      3    refused: too few data; the reason is printed
      4    fail
    """
    from ..api import certification
    from ..base.files import write_together
    from ..report.field_test import describe_field_test, render_field_test
    from ..result import encode

    config = RunConfig(**options)
    with listening(quiet, config.frames, hidden=as_json) as listener:
        if target is not None and _is_site(target) and source is None and not placements:
            _refuse_options()
            document = certification.certify_site(target, listener)
        else:
            document = certification.certify(*placed(target, source, placements), config, listener)
    files = {}
    if out is not None:
        page = render_field_test(document).encode()
        files = {out / RESULT_FILE: encode(document), out / PAGE_FILE: page}
        write_together(files)
    if as_json:
        show(encode(document))
    elif not quiet:
        show(in_colour(describe_field_test(document), document.status))
        if files:
            show("")
            show_written(*files)
    if document.status == "refused" and (as_json or quiet):
        for reason in document.pairs[0].reasons if document.pairs else ():
            echo_refusal(reason.code, reason.message)
    return EXITS[document.status]


def _is_site(path: Path) -> bool:
    """Whether what is given alone is a site: its file, or a folder."""
    return path.suffix == ".toml" or path.is_dir()


def _refuse_options() -> None:
    """Refuse options that a site file states: an option that is ignored is a silent error."""
    context = click.get_current_context()
    given = [
        param.opts[0]
        for param in context.command.params
        if param.name not in ("target", "out", "as_json", "quiet")
        and context.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE
    ]
    if given:
        raise click.UsageError(f"{', '.join(given)}: the site file already gives it")
