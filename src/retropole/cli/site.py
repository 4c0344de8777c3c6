"""The commands ``retropole site init`` and ``site calibrate``, and the group of all of a site."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from ..result import SITE_REPORT_FILE, SITE_RESULT_FILE
from .check import site_check
from .common import (
    BY_SITE_FILE,
    Group,
    command_line,
    listening,
    result_told,
    say,
    show,
    show_written,
)
from .options import CLOUD, FILE, verdict_options
from .out import out_folder


@click.group(cls=Group)
def site() -> None:
    """Calibrate many LiDARs of one site in one frame.

    Put taped poles where two LiDARs or more see them, and record a moment on each LiDAR. Move the
    poles and record again: that is another placement. A site file says which file is whose.

    \b
    Examples:
      retropole site init recordings
      retropole site calibrate recordings/site.toml
      retropole site check retropole-out tonight/site.toml
    """


site.add_command(site_check)


@site.command()
@click.argument("folder", type=CLOUD)
@click.option("--out", type=FILE, help="The site file to write.  [default: site.toml in FOLDER]")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def init(folder: Path, out: Path | None, force: bool, quiet: bool) -> int:
    """Write a site file from the recordings in FOLDER.

    \b
    Names say which recording is whose:
      FOLDER/mast-a/1.pcd    a folder for each LiDAR, a file for each placement
      FOLDER/1/mast-a.pcd    a folder for each placement, a file for each LiDAR
      FOLDER/mast-a_1.pcd    all in one folder
      FOLDER/mast-a.pcd      one placement only; lidar_1.pcd, lidar_2.pcd as well

    Placements have numbers, or a word and a number (1, p2, placement-3); LiDARs any names.
    Comments in the file say what may be added: sensors, surveyed poles, the accuracy needed.

    \b
    Examples:
      retropole site init recordings
      retropole site init recordings --out quay.toml
    """
    from ..api.site_draft import draft_site
    from ..api.site_file import SITE_FILE as NAME
    from ..base.errors import UsageError, printable
    from ..base.files import write_atomically

    path = folder / NAME if out is None else out
    if path.exists() and not force:
        raise UsageError(f"{path}: is there already; --force replaces it, --out names another")
    draft = draft_site(folder, path)
    write_atomically(path, draft.text.encode())
    if not quiet:
        for note in draft.notes:
            say(f"retropole: {note}")
        show(draft.summary)
        show_written(path)
        show(f"next: {printable(command_line('site', 'calibrate', path))}")
    return 0


@site.command()
@click.argument("site_file", metavar="SITE.toml", type=CLOUD)
@out_folder("Folder for site-result.json and site-report.html.", SITE_RESULT_FILE, SITE_REPORT_FILE)
@verdict_options("every pair and test, what was read and the time of each step")
def calibrate(
    site_file: Path, out: Path, strict: bool, as_json: bool, verbose: bool, quiet: bool
) -> int:
    """Find the poses of all LiDARs of a site in one frame.

    SITE.toml says which LiDARs there are, what each recorded in each placement of the poles, and
    what was surveyed; 'retropole site init' writes one. A folder stands for its site.toml.

    \b
    Examples:
      retropole site calibrate site.toml
      retropole site calibrate quay/site.toml --out today --strict
      retropole site calibrate site.toml --json | jq '.lidars[] | {name, T_site_lidar}'

    \b
    Exit code:
      0    calibrated: the verdict is ok or warn
      1    with --strict: the verdict is warn
      2    a file or an option is wrong; an older result in --out is renamed
      3    refused: no poses; the reason is printed and in site-result.json
      130  interrupted
    """
    from ..api.calibration import calibrate_site
    from ..report.text import describe_result

    asked = "as the site file says"
    with listening(quiet, asked, BY_SITE_FILE) as listener:
        result = calibrate_site(site_file, **listener._asdict())
        listener.progress("report")
        written = result.save(out)
    following = {
        "next": command_line("export", written[0], "--to", "urdf", "--out", out / "site.urdf"),
        "field test of the LiDARs": command_line("certify", site_file, "--out", out),
        "later, with new recordings": command_line("site", "check", out, "SITE"),
    }
    describe = partial(describe_result, result.document, following=following, verbose=verbose)
    return result_told(result, written, describe, as_json=as_json, quiet=quiet, strict=strict)
