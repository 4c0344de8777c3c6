"""The command ``retropole view``."""

from __future__ import annotations

import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..result import RunConfig, result_file
from .common import listening, say, show_written
from .options import CLOUD, FILE, Brief, run_option, run_options

if TYPE_CHECKING:
    from ..api.inputs import Listener


@click.command(cls=Brief)
@click.argument("files", type=CLOUD, nargs=-1, required=True)
@run_options("radius_m")
@run_option("sensor_target", "--sensor")
@run_option(
    "threshold_target", "--threshold", help="Initial value of the sliders.  [default: as in detect]"
)
@run_option("target_topic", "--topic")
@run_options("frames", "unit", "intensity", "angles")
@click.option("--out", type=FILE, help="Page to write.  [default: a temporary file]")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def view(files: tuple[Path, ...], out: Path | None, quiet: bool, **options: Any) -> int:
    """Look at FILES in a browser: the clouds, what is bright, and which poles are found.

    FILES are recordings, or one result: result.json, site-result.json or its folder.
    Of recordings the page has a slider for the threshold, the poles as detect finds them, and why
    every other bright cluster is none. Of a result it is the report. The page needs no network.

    \b
    Examples:
      retropole view front.pcd rear.pcd
      retropole view front.pcd --sensor VLP-16 --threshold 120
      retropole view drive.bag --topic /front --frames 0:20 --out front.html
      retropole view retropole-out

    \b
    Exit code:
      0    the page is written, whether a browser showed it or not
      2    a file or an option is wrong
    """
    from ..base.files import write_atomically

    config = RunConfig(**options)
    with listening(quiet, config.frames) as listener:
        result = _result_in(files[0]) if len(files) == 1 else None
        if result is not None:
            from .report import page_of

            page, _, notes = page_of(result, (), listener.progress)
        else:
            page, notes = _recordings(files, config, listener), []
        listener.progress("write")
        if out is None:
            with tempfile.NamedTemporaryFile(
                prefix="retropole-", suffix=".html", delete=False
            ) as file:
                file.write(page.encode())
            out = Path(file.name)
        else:
            write_atomically(out, page.encode())
    for note in notes:
        say(f"retropole: {note}")
    if not quiet:
        show_written(out)
    if not webbrowser.open(out.resolve().as_uri()):
        say("retropole: no browser was found: open the page in a browser")
    return 0


def _result_in(path: Path) -> Path | None:
    """Find the result document that a path names; None if it names a recording."""
    file = result_file(path)
    is_there = file.is_file() or file == path
    return file if file.suffix.lower() == ".json" and is_there else None


def _recordings(files: Sequence[Path], config: RunConfig, listener: Listener) -> str:
    """Make the page of recordings that are searched for poles."""
    from ..api.inputs import read_input
    from ..report import render_recordings

    listener.progress("read")
    inputs = [read_input(file, config.of_target, listener) for file in files]
    listener.progress("extract")
    scans = [each.search(config.radius_m) for each in inputs]
    are_told_apart = len({file.name for file in files}) == len(files)
    return render_recordings([f.name if are_told_apart else str(f) for f in files], scans)
