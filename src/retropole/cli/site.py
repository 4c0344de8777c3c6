"""The command ``retropole site init``, and the group of all of a site."""

from __future__ import annotations

from pathlib import Path

import click

from .calibrate import site_calibrate
from .check import site_check
from .common import Group, command_line, say, show, show_written
from .options import CLOUD, FILE, Brief


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


site.add_command(site_calibrate)
site.add_command(site_check)


@site.command(cls=Brief)
@click.argument("folder", type=CLOUD)
@click.option("--out", type=FILE, help="The site file to write.  [default: site.toml in FOLDER]")
@click.option("--force", is_flag=True, help="Replace an existing file.")
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
    Comments in the file list what may be added: sensors, surveyed poles, the accuracy needed.

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
        raise UsageError(f"{path} exists already; --force replaces it, --out names another")
    draft = draft_site(folder, path)
    write_atomically(path, draft.text.encode())
    if not quiet:
        for note in draft.notes:
            say(f"retropole: {note}")
        show(draft.summary)
        show_written(path)
        show(f"next: {printable(command_line('site', 'calibrate', path))}")
    return 0
