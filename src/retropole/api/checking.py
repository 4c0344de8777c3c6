"""A stored result against new recordings, as files: of two LiDARs, or of each pair of a site."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_options

from ..base.datatypes import PoseEstimate
from ..base.errors import ReadError, Reason, Refusal
from ..base.files import read_document
from ..base.quantities import step_of
from ..base.reasons import prefixed
from ..base.uncertainty import Uncertainty
from ..checking.drift import check, swap
from ..checking.movement import FALSE_ALARM as FALSE_ALARM
from ..checking.movement import CheckResult as CheckResult
from ..checking.movement import Movement as Movement
from ..checking.movement import Status, compare_poses
from ..checking.tolerance import RequestedTolerance
from ..export import inverted, read_transform
from ..export.documents import result_in
from ..io import sha256_of, topics_of
from ..io.fields import USUAL, Unit, Wanted
from ..result import DEFAULT_CONFIG, SITE_RESULT_FILE, ResultDoc, RunConfig, refusal_of, result_file
from ..result.decoding import decode_site
from ..result.site import SiteDoc
from .calibration import calibrate_with, options_of
from .inputs import SILENT, InputPair, Listener, read_input
from .site_file import LidarTable, SiteFile, read_site_file
from .site_inputs import read_of, site_file_in
from .stored import are_swapped, hashes_of, loaded, with_sensors_from


class Stored(NamedTuple):
    """What a stored result contains: the pose, the options of its run, and what it warned of.

    `uncertainty` is of a result that distinguishes random and systematic errors, `hashes` are
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

    Of a site, radius, sensors, angles and fields of the intensity are those of its run, and other
    options the defaults.

    Parameters
    ----------
    path
        A result document, its folder, or any file that an export writes.
    sigma
        1 σ of its rotation, rad, and of its translation, m, about and along each axis; None takes
        its covariance.
    lidars
        Target and source by their names, of the result of a site or another file with several
        poses: what both have in common cancels in their pose. How much of it errs the same in both
        recordings is not stored: all counts.

    Raises
    ------
    Refusal
        If it was refused, and ``no_covariance`` if the file does not state its uncertainty.
    ReadError
        If it cannot be read, or has no pose, or several, of these LiDARs.
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
            f"{path} does not state how accurate it is: give result.json, or --sigma-deg and "
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
    known = wanted_of(document)
    target, source = (known.get(name, USUAL) for name in lidars)
    config = RunConfig(
        radius_m=document.radius_m,
        radius_sigma_m=document.radius_sigma_m,
        sensor_target=sensor[lidars[0]],
        sensor_source=sensor[lidars[1]],
        intensity=target.intensity,
        intensity_source=source.intensity or "",
        angles=target.angles,
        angles_source=source.angles,
    )
    return Stored(pose, config, warnings, None, hashes_of(document, lidars))


def wanted_of(document: SiteDoc) -> dict[str, Wanted]:
    """Give, by the names of LiDARs, the options for reading their points."""
    return {
        document.lidars[each.lidar].name: Wanted(each.intensity, each.angles)
        for each in document.inputs
    }


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
            f"of SOURCE with --child; it has {', '.join(there)}; 'retropole site check' checks "
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
    intensity: str | None = None,
    intensity_source: str | None = None,
    angles: str | None = None,
    angles_source: str | None = None,
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
        Movement that matters, rad and m; None for the least that the data show.
    target_topic, source_topic, unit, unit_source
        Of the new recordings; None takes those of the stored run. A unit is that of both.
    intensity, intensity_source, angles, angles_source
        The same; those of the stored run are left out if a recording has no use for them: no
        such field, or no packets. A field of the intensity is that of both.
    listener
        Receives each step as it starts, and each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        If one cannot be read.
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
    of_target = Wanted(intensity, angles).or_known(known.of_target.wanted)
    own = intensity if intensity_source is None else intensity_source
    of_source = Wanted(own, angles_source).or_known(known.of_source.wanted)
    if are_swapped(stored.hashes, target, source):
        swapped = swap("RESULT was computed from these files", {"told_by": "hashes"})
        return CheckResult("cannot_tell", (swapped, *stored.warnings))
    if known.map:
        x, y, z = map(float, stored.pose.T_target_source[:3, 3])
        config = replace_options(config, prior_xyz=(x, y, z))
        return check_in_map(
            stored, target, source, config, RequestedTolerance(rotation, translation), listener
        )
    pair = InputPair(
        read_input(target, config.of_target._replace(wanted=of_target), listener),
        read_input(source, config.of_source._replace(wanted=of_source), listener),
    )
    listener.progress("check")
    topics = topics_swapped(known, pair.target.topic, pair.source.topic)
    if topics is not None:
        return CheckResult("cannot_tell", (topics, *stored.warnings))
    return check_pair(stored, pair, config, RequestedTolerance(rotation, translation))


def check_in_map(
    stored: Stored,
    target: Path,
    source: Path,
    config: RunConfig,
    tolerance: RequestedTolerance,
    listener: Listener = SILENT,
) -> CheckResult:
    """Calibrate a new recording to the map of a stored result, and compare both poses.

    Parameters
    ----------
    stored, tolerance
        As of `check_pair`.
    target, source
        The map, which may be another than before, and the recording.
    config
        Of the run, with the position in the map about which it is searched.
    listener
        As of `check_recordings`.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `calibrate`.
    """
    found = calibrate_with(target, source, config, listener)
    own = {*hashes_of(found.document)} & {*stored.hashes}
    reasons = (*((_RECORDINGS_OF_RESULT,) if own else ()), *stored.warnings)
    if found.T_target_source is None or found.covariance is None:
        refusal = refusal_of(found.document.reasons).reason
        return CheckResult("cannot_tell", (refusal, *reasons))
    new = PoseEstimate(found.T_target_source, found.covariance, 0.0)
    parts = stored.uncertainty, found.uncertainty
    return compare_poses(stored.pose, new, "scene", tolerance, reasons, parts)


def check_pair(
    stored: Stored, pair: InputPair, config: RunConfig, tolerance: RequestedTolerance
) -> CheckResult:
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
        options=options_of(pair, config),
        uncertainty=stored.uncertainty,
        tolerance=tolerance,
    )
    known = (_RECORDINGS_OF_RESULT,) if own else ()
    return replace(answer, reasons=(*known, *answer.reasons, *stored.warnings))


_RECORDINGS_OF_RESULT = Reason(
    "recordings_of_result",
    "RESULT was computed from these recordings (their SHA-256 is the same), so that they give "
    "its pose again even if a LiDAR moved since: this is no check; give newer recordings",
    {},
)


def topics_swapped(known: RunConfig, target: str | None, source: str | None) -> Reason | None:
    """Report that the topics of the stored run are read swapped."""
    topics = known.target_topic, known.source_topic
    if None in topics or topics[0] == topics[1] or (source, target) != topics:
        return None
    stated = f"RESULT's target is the topic {topics[0]}, and its source {topics[1]}"
    return swap(stated, {"told_by": "topics"})


def topic_for(path: Path, given: str | None, known: str | None) -> str | None:
    """Use the given topic, else the stored one if the recording is a bag."""
    if given is not None or known is None:
        return given
    return known if topics_of(path) else None


class CheckedPair(NamedTuple):
    """Two LiDARs of a site by their names, and what the check of both answers."""

    target: str
    source: str
    answer: CheckResult


@dataclass(frozen=True, eq=False)
class SiteCheck:
    """Whether the LiDARs of a site have not moved.

    Attributes
    ----------
    status
        ``same`` if unchanged pairs join all LiDARs, ``moved`` if a pair moved, ``cannot_tell``
        otherwise.
    reasons
        Why nothing was checked; empty if pairs were.
    pairs
        Each pair that shared poles when the site was calibrated.
    moved
        LiDARs that moved relative to the largest group of which all are the same; empty
        where no group is the largest: then nobody can determine which of them moved.
    untold
        LiDARs of which no pair shows whether they moved.
    """

    status: Status
    reasons: tuple[Reason, ...] = ()
    pairs: tuple[CheckedPair, ...] = ()
    moved: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()


def check_site(
    result: Path,
    site: Path,
    *,
    rotation: float | None = None,
    translation: float | None = None,
    listener: Listener = SILENT,
) -> SiteCheck:
    """Check new recordings of a site against its stored result, pair by pair.

    Parameters
    ----------
    result
        ``site-result.json``, or its folder.
    site
        The site file of the new recordings, or the folder of ``site.toml``. Its LiDARs have
        the names that they have in the result; those that it leaves out are not checked. Of each
        pair the first decisive placement is used. Angles, and fields of the intensity, that it
        does not say are those of the result.
    rotation, translation
        Movement that matters, rad and m; None for the least that the data show.
    listener
        Receives each step as it starts, and each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        If the result, the site file or a recording cannot be read, and where the site file has
        no two LiDARs that shared poles when the site was calibrated.
    """
    listener.progress("read")
    stored_file = result / SITE_RESULT_FILE if result.is_dir() else result
    document = with_sensors_from(loaded(stored_file, decode_site), stored_file.parent)
    site = site_file_in(site)
    file = read_site_file(site)
    if document.status == "refused":
        return SiteCheck("cannot_tell", (refusal_of(document.reasons).reason.prefixed("stored"),))
    pairs = list(_pairs(document, file))
    if not pairs:
        known = ", ".join(lidar.name for lidar in document.lidars)
        raise ReadError(
            f"{site}: no two of its LiDARs had poles in common when the site was calibrated; the "
            f"result has {known}: use these names"
        )
    exchanged = _exchanged(document, file, site)
    if exchanged is not None:
        return SiteCheck("cannot_tell", (exchanged,))
    tables = {lidar.name: lidar for lidar in file.lidar}
    # Each is read once, of whatever pairs its LiDAR is.
    read = cache(partial(read_of, file, site, listener, known=wanted_of(document)))
    requested = RequestedTolerance(rotation, translation)
    checked = []
    for k, (target, source) in enumerate(pairs, 1):
        listener.progress(step_of(f"check {target} and {source}", k, len(pairs)))
        stored = read_stored(result, lidars=(target, source))
        both = tables[target], tables[source]
        config = pair_config(document, *both)
        answer = CheckResult("cannot_tell", ())
        for n in shared_placements(*both):
            pair = InputPair(*(read(file.lidar.index(table), n) for table in both))
            try:
                answer = check_pair(stored, pair, config, requested)
            except Refusal as refusal:
                answer = CheckResult("cannot_tell", (refusal.reason,))
            if answer.status != "cannot_tell":
                break
        checked.append(CheckedPair(target, source, answer))
    return verdict_of(checked, [lidar.name for lidar in document.lidars])


def verdict_of(pairs: Sequence[CheckedPair], lidars: Sequence[str]) -> SiteCheck:
    """Make one answer of those of all pairs.

    Parameters
    ----------
    pairs
        The pairs that were checked.
    lidars
        Names of all LiDARs of the site.
    """
    groups = {name: {name} for name in lidars}
    for target, source, answer in pairs:
        if answer.status == "same" and groups[target] is not groups[source]:
            joined = groups[target] | groups[source]
            groups |= dict.fromkeys(joined, joined)
    sizes = sorted({id(group): len(group) for group in groups.values()}.values(), reverse=True)
    largest = max(groups.values(), key=len)
    is_decided = len(sizes) == 1 or sizes[0] > sizes[1]
    of_moved = {(a, b) for a, b, answer in pairs if answer.status == "moved"}
    off = {b if a in largest else a for a, b in of_moved if (a in largest) != (b in largest)}
    # Whatever is fixed to one that moved, moved with it.
    moved = {name for name in lidars if groups[name] & off} if is_decided else set()
    decided = largest | moved if is_decided else {name for pair in of_moved for name in pair}
    untold = tuple(name for name in lidars if name not in decided and len(lidars) > 1)
    status: Status = "moved" if of_moved else "cannot_tell" if untold else "same"
    listed = tuple(name for name in lidars if name in moved)
    return SiteCheck(status, (), tuple(pairs), listed, untold)


def _pairs(document: SiteDoc, file: SiteFile) -> Iterator[tuple[str, str]]:
    """Name the pairs that can be checked by the recordings of a site file."""
    tables = {lidar.name: lidar for lidar in file.lidar}
    for target, source in stored_pairs(document):
        if tables.keys() >= {target, source} and shared_placements(tables[target], tables[source]):
            yield target, source


def _exchanged(document: SiteDoc, file: SiteFile, site: Path) -> Reason | None:
    """Report that a recording is, by its hash, that of another LiDAR in the result."""
    owners: dict[str, set[str]] = {}
    for each in document.inputs:
        owners.setdefault(each.sha256, set()).add(document.lidars[each.lidar].name)
    for lidar in file.lidar:
        for recording in filter(None, lidar.recordings):
            place = site.parent / recording
            known = owners.get(sha256_of(place)) if place.is_file() or place.is_dir() else None
            if known and lidar.name not in known:
                owner = ", ".join(sorted(known))
                return Reason(
                    "swapped",
                    f"{place}, given for {lidar.name}, is the file that the result has for "
                    f"{owner}; give each LiDAR a different file",
                    {"told_by": "hashes", "given_for": lidar.name, "of": owner},
                )
    return None


def pair_config(stored: SiteDoc, target: LidarTable, source: LidarTable) -> RunConfig:
    """Choose the options of a check of two LiDARs: those of the poles from the result, others from
    the file.

    If the file says neither angles nor the field of an intensity, they are those of the result.
    """
    known = wanted_of(stored)
    of_target, of_source = (
        Wanted(each.intensity, each.angles).or_known(known.get(each.name, USUAL))
        for each in (target, source)
    )
    return RunConfig(
        radius_m=stored.radius_m,
        radius_sigma_m=stored.radius_sigma_m,
        sensor_target=target.sensor,
        sensor_source=source.sensor,
        threshold_target=target.threshold,
        threshold_source=source.threshold,
        target_topic=target.topic,
        source_topic=source.topic,
        unit=target.unit,
        unit_source=source.unit,
        intensity=of_target.intensity,
        intensity_source=of_source.intensity or "",
        angles=of_target.angles,
        angles_source=of_source.angles,
    )


def shared_placements(target: LidarTable, source: LidarTable) -> list[int]:
    """Give the indices of the placements that both recorded."""
    both = zip(target.recordings, source.recordings, strict=False)
    return [n for n, recordings in enumerate(both) if all(recordings)]


def stored_pairs(document: SiteDoc) -> list[tuple[str, str]]:
    """Name the pairs that shared poles when the site was calibrated: of one carried, all."""
    names = [lidar.name for lidar in document.lidars]
    if document.config.carried:
        return list(combinations(names, 2))
    return [
        (names[each.lidars[0]], names[each.lidars[1]])
        for each in document.pairs
        if each.shared_poles and each.refusal is None
    ]
