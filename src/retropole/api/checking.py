"""A stored result against new recordings, as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_options

from ..base.datatypes import PoseEstimate
from ..base.errors import ReadError, Reason, Refusal
from ..base.files import read_document
from ..base.reasons import prefixed
from ..base.uncertainty import Uncertainty
from ..checking.drift import check, swap
from ..checking.movement import FALSE_ALARM as FALSE_ALARM
from ..checking.movement import CheckResult as CheckResult
from ..checking.movement import Movement as Movement
from ..checking.tolerance import Asked
from ..export import inverted, read_transform
from ..export.documents import result_in
from ..io import topics_of
from ..io.fields import Unit
from ..result import DEFAULT_CONFIG, ResultDoc, RunConfig, result_file
from ..result.site import SiteDoc
from .calibration import known_of
from .inputs import SILENT, InputPair, Listener, read_pair
from .stored import are_swapped, hashes_of, with_sensors_from


class Stored(NamedTuple):
    """What a stored result holds: the pose, the options of its run, and what it warned of.

    `uncertainty` is of a result that tells random and systematic errors apart, `hashes` are
    those of target and source of each placement.
    """

    pose: PoseEstimate
    config: RunConfig
    warnings: tuple[Reason, ...]
    uncertainty: Uncertainty | None = None
    hashes: tuple[tuple[str, str], ...] = ()


def read_stored(
    path: Path, sigma: tuple[float, float] | None = None, lidars: tuple[str, str] | None = None
) -> Stored:
    """Read a stored result; of a file that is not a result document, the options are the defaults.

    Of a site, radius and sensors are those of its run, and other options the defaults.

    Parameters
    ----------
    path
        A result document, the folder that holds it, or any file that an export writes.
    sigma
        1 σ of its rotation, rad, and of its translation, m, about and along each axis; None takes
        its covariance.
    lidars
        Target and source by their names, of the result of a site or another file that holds several
        poses: what both have in common cancels in their pose. How much of it errs alike in both
        recordings is not stored: all counts.

    Raises
    ------
    Refusal
        Where it was refused, and ``no_covariance`` where the file does not say how certain it is.
    ReadError
        Where it cannot be read, or holds no pose, or several, of these LiDARs.
    """
    file = result_file(path)
    document = result_in(read_document(file))
    if isinstance(document, SiteDoc) and document.status != "refused":
        check_lidars(path, [lidar.name for lidar in document.lidars], lidars)
    parent, child = lidars or (None, None)
    transform = read_transform(path, parent=parent, child=child)
    if transform.roles == ("source", "target"):
        transform = inverted(transform)
    covariance = transform.covariance
    if sigma is not None:
        covariance = np.diag(np.repeat(sigma, 3) ** 2)
    if covariance is None:
        raise Refusal(
            "no_covariance",
            f"{path} does not say how certain it is: give result.json, or --sigma-deg and "
            "--sigma-m",
        )
    pose = PoseEstimate(transform.T_parent_child, covariance, 0.0)
    if document is None:
        return Stored(pose, DEFAULT_CONFIG, ())
    warnings = tuple(
        Reason(prefixed("stored", reason.code), reason.message, reason.values)
        for reason in document.reasons
    )
    if isinstance(document, ResultDoc):
        parts = None if sigma is not None else document.whole_uncertainty
        config = with_sensors_from(document, file.parent).config
        return Stored(pose, config, warnings, parts, hashes_of(document))
    assert lidars is not None
    document = with_sensors_from(document, file.parent)
    sensor = {lidar.name: lidar.sensor for lidar in document.lidars}
    config = RunConfig(
        radius_m=document.radius_m,
        radius_sigma_m=document.radius_sigma_m,
        sensor_target=sensor[lidars[0]],
        sensor_source=sensor[lidars[1]],
    )
    return Stored(pose, config, warnings, None, hashes_of(document, lidars))


def check_lidars(path: Path, there: Sequence[str], named: tuple[str, str] | None) -> None:
    """Refuse names that are not those of two LiDARs of a site, or none; says which there are.

    Raises
    ------
    ReadError
        Naming the LiDARs of the site.
    """
    if named is None or named[0] == named[1] or not {*named} <= {*there}:
        raise ReadError(
            f"{path} is of a site: name two of its LiDARs, that of TARGET with --parent and that "
            f"of SOURCE with --child; there are {', '.join(there)}; 'retropole site check' checks "
            "them all"
        )


def check_recordings(
    stored: Stored,
    target: Path,
    source: Path,
    *,
    rotation: float | None = None,
    translation: float | None = None,
    target_topic: str | None = None,
    source_topic: str | None = None,
    unit: Unit | None = None,
    unit_source: Unit | None = None,
    listener: Listener = SILENT,
) -> CheckResult:
    """Read new recordings with the options of the stored run, and check them against it.

    Parameters
    ----------
    stored
        As `read_stored` gives it.
    target, source
        What `io.read_cloud` reads.
    rotation, translation
        Movement that matters, rad and m; None for as little as the data tell.
    target_topic, source_topic, unit, unit_source
        Of the new recordings; None takes those of the stored run. A unit is that of both.
    listener
        Told of each step as it starts, and of each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        Where one cannot be read.
    Refusal
        As `checking.drift.check`.
    """
    known = stored.config
    config = replace_options(
        known,
        target_topic=topic_for(target, target_topic, known.target_topic),
        source_topic=topic_for(source, source_topic, known.source_topic),
        frames=None,
        max_points=DEFAULT_CONFIG.max_points,
        unit=unit or known.unit,
        unit_source=unit_source or unit or known.source_unit,
    )
    if are_swapped(stored.hashes, target, source):
        swapped = swap("RESULT was made of these very files", {"told_by": "hashes"})
        return CheckResult("cannot_tell", (swapped, *stored.warnings))
    pair = read_pair(target, source, config, listener)
    listener.progress("check")
    topics = topics_swapped(known, pair.target.topic, pair.source.topic)
    if topics is not None:
        return CheckResult("cannot_tell", (topics, *stored.warnings))
    return check_pair(stored, pair, config, Asked(rotation, translation))


def check_pair(stored: Stored, pair: InputPair, config: RunConfig, tolerance: Asked) -> CheckResult:
    """Check recordings that were read against a stored result.

    Parameters
    ----------
    stored
        As `read_stored` gives it.
    pair
        The new recordings.
    config
        Radius, thresholds, and how the masts sway.
    tolerance
        The movement that matters.

    Raises
    ------
    Refusal
        As `checking.drift.check`.
    """
    own = (pair.target.sha256, pair.source.sha256) in stored.hashes
    answer = check(
        stored.pose,
        pair.target.cloud,
        pair.source.cloud,
        options=known_of(pair, config),
        uncertainty=stored.uncertainty,
        tolerance=tolerance,
    )
    known = (_RECORDINGS_OF_RESULT,) if own else ()
    return replace(answer, reasons=(*known, *answer.reasons, *stored.warnings))


_RECORDINGS_OF_RESULT = Reason(
    "recordings_of_result",
    "RESULT was made of these very recordings (their SHA-256 is the same), so that they give its "
    "pose again whatever moved since: this proves nothing; give recordings that are newer",
    {},
)


def topics_swapped(known: RunConfig, target: str | None, source: str | None) -> Reason | None:
    """Say that the topics of the stored run are read the other way round."""
    topics = known.target_topic, known.source_topic
    if None in topics or topics[0] == topics[1] or (source, target) != topics:
        return None
    words = f"RESULT's target is the topic {topics[0]}, and its source {topics[1]}"
    return swap(words, {"told_by": "topics"})


def topic_for(path: Path, given: str | None, known: str | None) -> str | None:
    """Take the topic that is given, else the stored one where there is a bag to look for it in."""
    if given is not None or known is None:
        return given
    return known if topics_of(path) else None
