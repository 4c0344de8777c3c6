"""What the files of a result are called, and which of them a folder holds."""

from __future__ import annotations

from pathlib import Path

from ..base.errors import UsageError

RESULT_FILE, SITE_RESULT_FILE = "result.json", "site-result.json"
"""What the result document of two LiDARs, and that of a site, is called in its folder."""

REPORT_FILE, SITE_REPORT_FILE = "report.html", "site-report.html"
"""What the reports of both are called there."""

CERTIFICATE = "certificate.json", "certificate.html"
"""What the field test of two LiDARs is called there that were watched."""

PLAN_FILE, PLAN_PAGE = "plan.json", "plan.html"
"""What a plan of poles and its page are called there."""


def result_file(path: Path) -> Path:
    """Take the result document in a folder, that of a site where it is alone; a file as it is."""
    if not path.is_dir():
        return path
    own, of_site = path / RESULT_FILE, path / SITE_RESULT_FILE
    return of_site if of_site.exists() and not own.exists() else own


def any_result_file(path: Path) -> Path:
    """Take the result document in a folder, that of two LiDARs or of a site, and a file as it is.

    Raises
    ------
    UsageError
        Where the folder holds both.
    """
    if not path.is_dir() or not (path / SITE_RESULT_FILE).exists():
        return result_file(path)
    if (path / RESULT_FILE).exists():
        raise UsageError(f"{path} holds {RESULT_FILE} and {SITE_RESULT_FILE}; name one of them")
    return path / SITE_RESULT_FILE
