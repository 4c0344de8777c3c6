"""The drift check of one site as a row. Nothing that can be wrong with it ends more than itself."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from ...base.errors import ReadError, Refusal, quoting
from ...base.files import LARGEST_DOCUMENT, read_document
from ...base.version import __version__
from ...result.folder import RESULT_FILE, result_file
from ..dataset import Row
from ..local import LocalFiles, local_files
from ..sites import FleetSite
from ..storage import below, exists, folder_of, is_folder, is_url, read_bytes, written
from ..work import Hashed, code_of
from .rows import CheckRow, plain
from .task import Check


def check_site(
    site: FleetSite, check: Check, tell: Callable[[Hashed], None] = lambda hashed: None
) -> dict[str, Any] | None:
    """Check one site, unless the history has this very check.

    Parameters
    ----------
    site
        A pair, and the place of its stored result: ``result.json`` beside the target where it
        names none.
    check
        What to hold it against.
    tell
        Called with the hashes of its files before anything is read of what is in them.

    Returns
    -------
    dict or None
        Columns of the row, whatever happens; None where the history has it without an error: the
        same recordings and stored result, at the same time.
    """
    tried = _tried(site, check)
    try:
        with local_files(site) as local:
            stored, inputs = _stored(site, check, local), local.inputs()
            target, source = (each.sha256 or "" for each in inputs)
            tried = replace(
                tried,
                # Where the list has no time, it is when the later recording was written.
                time=tried.time if site.time else max(written(site.target), written(site.source)),
                stored_sha256=hashlib.sha256(read_document(stored)).hexdigest(),
                target_sha256=target,
                source_sha256=source,
            )
            tell(Hashed(tried.key, inputs, tried.stored_sha256))
            if tried.key in check.known:
                return None
            tried = _checked(site, check, local, stored, tried)
    except Refusal as refusal:
        tried = replace(tried, codes=(refusal.code,), message=quoting(refusal.message))
    except Exception as error:
        code, words = code_of(error)
        tried = replace(tried, status="error", codes=(code,), message=words)
    return plain(tried)


def lost_check(site: FleetSite, check: Check, row: Row) -> CheckRow:
    """Make the row of a check whose process or worker never answered, of what is known of it."""
    hashes = [each.sha256 or "" for each in row.inputs] or ["", ""]
    return replace(
        _tried(site, check),
        status="error",
        codes=tuple(row.codes),
        message=row.messages[0] if row.messages else None,
        stored_sha256=row.site_sha256 or "",
        target_sha256=hashes[0],
        source_sha256=hashes[-1],
    )


def _tried(site: FleetSite, check: Check) -> CheckRow:
    """Begin the row of a check that has not told anything yet."""
    time = datetime.fromisoformat(site.time) if site.time else check.tried
    return CheckRow(site.id, time, "cannot_tell", version=__version__)


def _stored(site: FleetSite, check: Check, local: LocalFiles) -> Path:
    """Bring the stored result to this machine."""
    if check.document is not None:
        return local.keep(check.document.encode(), RESULT_FILE)
    place = site.result or below(folder_of(site.target), RESULT_FILE)
    if not exists(place):
        raise ReadError(
            f"{place}: there is no stored result; name it in a column result, or give the "
            "answers of 'fleet calibrate'"
        )
    if not is_url(place):
        return result_file(Path(place))
    inside = below(place, RESULT_FILE) if is_folder(place) else place
    return local.keep(read_bytes(inside, LARGEST_DOCUMENT), place)


def _checked(
    site: FleetSite, check: Check, local: LocalFiles, result: Path, tried: CheckRow
) -> CheckRow:
    from ...api.checking import check_recordings, read_stored

    stored = read_stored(result, lidars=check.lidars)
    if check.lidars is not None:
        stored = stored._replace(config=site.config)
    rotation, translation = check.tolerance
    answer = check_recordings(stored, *local.pair, rotation=rotation, translation=translation)
    names = ("status", "used", "step", "covariance", "random", "chi2", "power")
    return replace(
        tried,
        codes=tuple(reason.code for reason in answer.reasons),
        message=quoting(answer.reasons[0].message) if answer.reasons else None,
        **{name: getattr(answer, name) for name in names},
    )
