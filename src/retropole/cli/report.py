"""The command ``retropole report``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import progress_on_terminal, say, show_written
from .options import CLOUD, FILE


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("clouds", type=CLOUD, nargs=-1, metavar="[TARGET SOURCE]...")
@click.option("--out", type=FILE, help="File to write.  [default: report.html beside RESULT]")
@click.option("--site", help="Where it was calibrated, for the certificate.")
@click.option("--serial-target", help="Serial number of TARGET, for the certificate.")
@click.option("--serial-source", help="The same for SOURCE.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def report(
    result: Path,
    clouds: tuple[Path, ...],
    out: Path | None,
    site: str | None,
    serial_target: str | None,
    serial_source: str | None,
    quiet: bool,
) -> int:
    """Make the report of RESULT, result.json or the folder that holds it, again.

    The page shows the clouds that the result names. They are looked for by their path, from here
    and from the folder of RESULT; give TARGET and SOURCE where they lie elsewhere now (and again
    for each further placement). Files that differ from those of the run are drawn, and both the
    page and this command say that they differ.

    Printed, the page begins with a certificate of one page. --site and the serial numbers are
    written on it; without them it has lines to fill in.

    \b
    Examples:
      retropole report retropole-out/result.json
      retropole report today/result.json front.pcd rear.pcd
      retropole report today/result.json --out share/monday.html
      retropole report today --site "Pier 4, crane 2" --serial-target 11002 --serial-source 11007

    \b
    Exit code:
      0    written
      2    RESULT or a cloud cannot be read
      130  interrupted
    """
    from ..api.result import load_result
    from ..api.stored import placements_of
    from ..report import write_report
    from ..result.folder import REPORT_FILE, result_file

    file = result_file(result)
    document, page = load_result(file).document, out or file.with_name(REPORT_FILE)
    with progress_on_terminal(quiet) as progress:
        stored = placements_of(document, file.parent, clouds, progress)
        progress("write")
        write_report(
            page,
            document,
            stored.placements,
            notes=stored.notes,
            site=site or "",
            serials=(serial_target or "", serial_source or ""),
        )
    for note in stored.notes:
        say(f"retropole: {note}")
    if not quiet:
        show_written(page)
    return 0
