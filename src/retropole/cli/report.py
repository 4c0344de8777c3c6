"""The command ``retropole report``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

import click

from .common import progress_on_terminal, say, show_written
from .options import CLOUD, FILE, Brief
from .out import locked_folder


@click.command(cls=Brief)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("clouds", type=CLOUD, nargs=-1, metavar="[TARGET SOURCE]...")
@click.option(
    "--out", type=FILE, help="File to write.  [default: report.html or site-report.html by RESULT]"
)
@click.option("--site", help="Place of the calibration, for the certificate.")
@click.option(
    "--serial",
    "serials",
    multiple=True,
    nargs=2,
    metavar="LIDAR NUMBER",
    help="Serial number of a LiDAR, for the certificate, by its name in RESULT: target or source, "
    "or its name in the site; repeat it.",
)
@click.option("--serial-target", hidden=True, help="As --serial target.")
@click.option("--serial-source", hidden=True, help="As --serial source.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def report(
    result: Path,
    clouds: tuple[Path, ...],
    out: Path | None,
    site: str | None,
    serial_target: str | None,
    serial_source: str | None,
    serials: tuple[tuple[str, str], ...],
    quiet: bool,
) -> int:
    """Make the report of RESULT, result.json, site-result.json or its folder, again.

    The page shows the clouds that the result names. They are looked for by their path, from here
    and from the folder of RESULT; give TARGET and SOURCE where they are at another place now (and
    again for each further placement). Files that differ from those of the run are drawn, and both
    the page and this command report that they differ.

    Of a site, recordings that are not found, or differ from those of the run, are left out of the
    page, and it says so. Give those that are at another place now, in any order: each is
    recognised by its SHA-256.

    Printed, the page begins with a certificate. --site and the serial numbers are written on it;
    those of a site are taken from its site file. Without them it has lines to fill in.

    \b
    Examples:
      retropole report retropole-out/result.json
      retropole report today/result.json front.pcd rear.pcd
      retropole report today --site "Pier 4, crane 2" --serial target 11002 --serial source 11007
      retropole report quay/site-result.json moved/*.pcd --serial mast-a 11002

    \b
    Exit code:
      0    written
      2    RESULT or a cloud cannot be read
    """
    from ..base.files import write_atomically
    from ..result import result_file

    file = result_file(result)
    lock = nullcontext() if out else locked_folder(file)
    with lock, progress_on_terminal(quiet) as progress:
        older = {"target": serial_target, "source": serial_source}
        named = {lidar: number for lidar, number in older.items() if number} | dict(serials)
        page, name, notes = page_of(file, clouds, progress, site or "", named)
        progress("write")
        out = out or file.with_name(name)
        write_atomically(out, page.encode())
    for note in notes:
        say(f"retropole: {note}")
    if not quiet:
        show_written(out)
    return 0


def page_of(
    file: Path,
    clouds: Sequence[Path],
    progress: Callable[[str], None],
    site: str = "",
    serials: Mapping[str, str] | None = None,
) -> tuple[str, str, Sequence[str]]:
    """Make the report of a result document: the page, what its file is called, and notes on it."""
    from ..api.stored import decode_any, loaded, scans_of
    from ..report import render_report
    from ..result import REPORT_FILE, SITE_REPORT_FILE, ResultDoc

    document = loaded(file, decode_any)
    is_pair = isinstance(document, ResultDoc)
    read = scans_of(document, file.parent, clouds, progress)
    page = render_report(document, read.scans, notes=read.notes, site=site, serials=serials)
    return page, REPORT_FILE if is_pair else SITE_REPORT_FILE, read.notes
