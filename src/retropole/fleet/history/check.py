"""The drift check of one site as a row. Nothing that can be wrong with it ends more than itself."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import __version__
from ...datatypes import PoseEstimate
from ...errors import ReadError, Refusal, quoting
from ...export import read_transform
from ...export.documents import RESULT_FILE, result_file
from ...files import LARGEST_DOCUMENT, read_document
from ...monitoring.tolerance import Asked
from ...result import RunConfig
from ..dataset import Row
from ..local import LocalFiles
from ..sites import FleetSite
from ..storage import below, exists, folder_of, is_folder, is_url, read_bytes, written
from ..work import Hashed, code_of
from .rows import CheckRow, plain
from .task import Check

if TYPE_CHECKING:
    from ...api.checking import Stored


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
    time = datetime.fromisoformat(site.time) if site.time else check.tried
    tried = CheckRow(site.id, time, "cannot_tell", version=__version__)
    with tempfile.TemporaryDirectory(prefix="retropole-") as folder:
        try:
            local = LocalFiles(site, Path(folder))
            stored = _stored(site, check, Path(folder))
            tried = _hashed(tried, site, local, stored, tell)
            if tried.key in check.known:
                return None
            tried = _checked(site, check, local, stored, tried)
        except Refusal as refusal:
            tried = replace(tried, codes=(refusal.code,), message=quoting(refusal.message))
        except Exception as error:
            code, words = code_of(error)
            tried = replace(tried, status="error", codes=(code,), message=words)
        if tried.message is not None:
            tried = replace(tried, message=_named(tried.message, site, check, Path(folder)))
    return plain(tried)


def _place(site: FleetSite) -> str:
    """Name the place of the stored result."""
    return site.result or below(folder_of(site.target), RESULT_FILE)


def _named(words: str, site: FleetSite, check: Check, folder: Path) -> str:
    """Call copies in a folder of our own as they were given."""
    stored = RESULT_FILE if check.document is not None else _place(site)
    for role, place in (("target", site.target), ("source", site.source), ("stored", stored)):
        copy = folder / role / place.rstrip("/").rpartition("/")[2]
        words = words.replace(quoting(f"{copy}"), quoting(place))
    return words


def lost_check(site: FleetSite, check: Check, row: Row) -> CheckRow:
    """Make the row of a check whose process or worker never answered, of what is known of it."""
    hashes = [each.sha256 or "" for each in row.inputs] or ["", ""]
    return CheckRow(
        site.id,
        datetime.fromisoformat(site.time) if site.time else check.tried,
        "error",
        codes=tuple(row.codes),
        message=row.messages[0] if row.messages else None,
        stored_sha256=row.site_sha256 or "",
        target_sha256=hashes[0],
        source_sha256=hashes[-1],
        version=__version__,
    )


def _stored(site: FleetSite, check: Check, folder: Path) -> Path:
    """Bring the stored result to this machine."""
    if check.document is not None:
        data, path = check.document.encode(), folder / "stored" / RESULT_FILE
    else:
        place = _place(site)
        if not exists(place):
            raise ReadError(
                f"{place}: there is no stored result; name it in a column result, or give the "
                "answers of 'fleet calibrate'"
            )
        if not is_url(place):
            return result_file(Path(place))
        data = read_bytes(
            below(place, RESULT_FILE) if is_folder(place) else place, LARGEST_DOCUMENT
        )
        path = folder / "stored" / place.rstrip("/").rpartition("/")[2]
    path.parent.mkdir()
    path.write_bytes(data)
    return path


def _hashed(
    tried: CheckRow,
    site: FleetSite,
    local: LocalFiles,
    stored: Path,
    tell: Callable[[Hashed], None],
) -> CheckRow:
    """Add the hashes, and when the later recording was written where the list has no time."""
    inputs = local.inputs()
    sha256 = hashlib.sha256(read_document(stored)).hexdigest()
    if not site.time:
        tried = replace(tried, time=max(written(site.target), written(site.source)))
    target, source = (each.sha256 or "" for each in inputs)
    tried = replace(tried, stored_sha256=sha256, target_sha256=target, source_sha256=source)
    tell(Hashed(tried.key, inputs, sha256))
    return tried


def _checked(
    site: FleetSite, check: Check, local: LocalFiles, result: Path, tried: CheckRow
) -> CheckRow:
    from ...api.checking import checked, read_stored, topic_for
    from ...api.inputs import read_input

    if check.lidars is None:
        stored = read_stored(result)
    else:
        stored = _of_site(result, check.lidars, site.config)
    config = stored.config
    target, source = local.pair
    answer = checked(
        stored,
        read_input(
            target,
            sensor=config.sensor_target,
            threshold=config.threshold_target,
            topic=topic_for(target, None, config.target_topic),
            unit=config.unit,
        ),
        read_input(
            source,
            sensor=config.sensor_source,
            threshold=config.threshold_source,
            topic=topic_for(source, None, config.source_topic),
            unit=config.source_unit,
        ),
        Asked(*check.tolerance),
    )
    words = [reason.message for reason in answer.reasons]
    return replace(
        tried,
        status=answer.status,
        used=answer.used,
        codes=tuple(reason.code for reason in answer.reasons),
        message=quoting(words[0]) if words else None,
        step=answer.step,
        covariance=answer.covariance,
        random=answer.random,
        chi2=answer.chi2,
        power=answer.power,
    )


def _of_site(result: Path, lidars: tuple[str, str], config: RunConfig) -> Stored:
    """Take the pose between two LiDARs of a site; what both have in common cancels in it.

    How much of it errs alike in both recordings is not stored of a site: all of it counts.
    """
    from ...api.checking import Stored

    target, source = lidars
    transform = read_transform(result, parent=target, child=source)
    if transform.covariance is None:
        raise Refusal("no_covariance", f"{result} does not say how certain {source} is to {target}")
    return Stored(PoseEstimate(transform.T_parent_child, transform.covariance, 0.0), config, ())
