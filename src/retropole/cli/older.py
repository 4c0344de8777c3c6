"""An older result is not taken for that of a run that failed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from ..base.errors import RetropoleError, printable, said
from ..base.files import set_aside
from .common import say

DEFAULT_OUT = Path("retropole-out")
"""Where a calibration writes to unless told otherwise."""


@contextmanager
def older_set_aside(folder: Path, *, site: bool = False) -> Iterator[None]:
    """Where what is within fails, rename the results that are in a folder, and say so.

    Parameters
    ----------
    folder
        The folder.
    site
        Whether the results are those of a site.
    """
    try:
        yield
    except (RetropoleError, click.UsageError, OSError, MemoryError):
        set_older_aside(folder, site=site)
        raise


def set_older_aside(folder: Path, *, site: bool = False) -> None:
    """Rename the results that are in a folder, which are not of this run, and say so."""
    from ..result.folder import REPORT_FILE, RESULT_FILE, SITE_REPORT_FILE, SITE_RESULT_FILE

    names = (SITE_RESULT_FILE, SITE_REPORT_FILE) if site else (RESULT_FILE, REPORT_FILE)
    try:
        moved = set_aside([folder / name for name in names])
    except OSError as error:
        say(f"retropole: {printable(str(folder))} may hold an older result: {said(error)}")
    else:
        now = " and ".join(printable(str(path)) for path in moved)
        if moved:
            say(f"retropole: no result of this run; the one before is now {now}")


class SettingAside(click.Command):
    """A command that sets an older result aside also where its options are wrong."""

    of_site = False

    def make_context(
        self, info_name: str | None, args: list[str], *rest: Any, **extra: Any
    ) -> click.Context:
        """Read the options, as any command."""
        with older_set_aside(_out_of(args), site=self.of_site):
            return super().make_context(info_name, args, *rest, **extra)


class SettingSiteAside(SettingAside):
    """The same for the result of a site."""

    of_site = True


def _out_of(words: Sequence[str]) -> Path:
    """Find --out among words that may make no sense otherwise."""
    out, options = DEFAULT_OUT, list(words)
    if "--" in options:
        options = options[: options.index("--")]
    for word, following in zip(options, [*options, ""][1:], strict=True):
        if word == "--out" and following:
            out = Path(following)
        elif word.startswith("--out="):
            out = Path(word.removeprefix("--out="))
    return out
