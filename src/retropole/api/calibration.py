"""`calibrate` and `calibrate_site`: recordings in, a result out to look at and to save."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import pipeline
from ..adjustment.answer import SiteCalibration
from ..base.datatypes import Placement, Scan
from ..base.description import Site
from ..base.errors import Refusal
from ..hypotheses.prior import PosePrior, pose_prior
from ..hypotheses.scans import SiteScans
from ..pipeline import Options
from ..result import DEFAULT_CONFIG, RunConfig, result_document
from ..result.site import site_document
from ..verdict.statement import state_refusal, state_site_refusal
from .inputs import (
    SILENT,
    CloudSource,
    Input,
    InputPair,
    Listener,
    input_documents,
    intensity_hint,
    read_placements,
    refuse_repeated,
    warn_repeated,
)
from .options import checked_options, with_keywords
from .result import CalibrationResult, SiteResult
from .site_inputs import inputs_of, read_site, repeated

if TYPE_CHECKING:
    from .carried import SeenWalk


def calibrate(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    *,
    radius: float | None = None,
    sensor: str | Sequence[str] | None = None,
    threshold: float | Sequence[float | None] | None = None,
    topic: str | Sequence[str | None] | None = None,
    frames: slice | None = None,
    unit: str | Sequence[str] | None = None,
    poles: int | None = None,
    need: float | None = None,
    at: float | None = None,
    up: bool | None = None,
    options: RunConfig = DEFAULT_CONFIG,
    progress: Callable[[str], None] = lambda step: None,
    **older: Any,
) -> CalibrationResult:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    What is None is taken of `options`. `sensor`, `threshold`, `topic` and `unit` have one value for
    both LiDARs, or those of target and source: ``sensor=("VLP-16", "XT32")``.

    Parameters
    ----------
    target, source
        A path that `io.read_cloud` reads; an array, (N, 4) of x, y, z in metres and intensity; or
        a `PointCloud`. Each in the frame of its sensor. Or a list of these, one for each placement
        of the poles, target and source in the same order: one pose is found for all.
    radius
        Radius of the poles, metres, 0.02 unless it is given.
    sensor
        Names of sensors, or ``auto``.
    threshold
        Intensity from which a return is treated as retro-reflective; None takes that of the
        sensor, or else of the cloud.
    topic, frames
        Of recordings, the topic of a bag and the frames, as `io.read_cloud` takes them.
    unit
        Of the coordinates: ``m``, ``cm``, ``mm``, ``ft`` or ``in``.
    poles
        Exact number of poles that both LiDARs see; 0 finds the pose from the surroundings alone.
    need, at
        How accurate the answer must be: no point up to `at` away, 30 m where it is None, lands
        further than `need` from its true place, metres. The verdict says whether its probability is
        95 %.
    up
        Both LiDARs are roughly upright: hypotheses that contradict it are left out.
    options
        All options by their names in the result document, the rarer ones too, such as
        ``RunConfig(refine=False, max_points=10**6)``.
    progress
        Called with the name of each step as it starts; while a recording of several frames is read,
        with which of how many.
    older
        Keywords of the release before: they still work, with a `DeprecationWarning`.

    Returns
    -------
    CalibrationResult
        With `status` ``refused``, the reasons and no transform where the data carry no answer.

    Raises
    ------
    UsageError
        For arrays of another shape, options that make no sense, and a letter that no hypothesis
        which fits the poles has.
    ReadError, MissingExtraError
        If a file cannot be read.
    """
    keywords: dict[str, object] = {
        "radius": radius,
        "sensor": sensor,
        "threshold": threshold,
        "topic": topic,
    }
    keywords |= {"frames": frames, "unit": unit, "poles": poles, "need": need, "at": at, "up": up}
    config = with_keywords(options, keywords, older)
    return calibrate_with(target, source, config, Listener(progress))


def calibrate_with(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener = SILENT,
    walk: Callable[[], SeenWalk] | None = None,
) -> CalibrationResult:
    """Calibrate as `calibrate` does, with the options of a run as in the result document.

    Parameters
    ----------
    target, source
        As `calibrate` takes them.
    config
        The options.
    listener
        Receives each step as it starts, and each cloud once it is read.
    walk
        As `carried.calibrate_walk` takes it.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `calibrate`.
    """
    config = checked_options(config)
    listener.progress("read")
    if config.carried:
        from .carried import calibrate_walk

        found, recorded = calibrate_walk(target, source, config, listener, walk)
        return CalibrationResult(found, placements=recorded)
    start = time.perf_counter()
    pairs = read_placements(target, source, config, listener)
    inputs = [each for pair in pairs for each in pair]
    documents = input_documents(inputs)
    seconds_read = time.perf_counter() - start
    twice = refuse_repeated(inputs, documents, partial(warn_repeated, inputs))
    if twice is not None:
        scans = [[Scan(each.cloud, each.sensor) for each in pair] for pair in pairs]
        unsearched = tuple(Placement(target, source) for target, source in scans)
        calibration = state_refusal(twice, unsearched, (), {})
    else:
        calibration = pipeline.calibrate(
            [pair.target.cloud for pair in pairs],
            [pair.source.cloud for pair in pairs],
            options=replace(
                options_of(pairs[0], config),
                poles=0 if config.map and config.poles is None else config.poles,
                scene=config.refine,
                prior=prior_of(config),
                by_hand=config.hypothesis,
                trust_poles=config.trust_poles,
                deceiving=config.deceiving_share,
                need=config.need,
            ),
            progress=listener.progress,
        )
    reasons = tuple(
        replace(reason, message=reason.message + intensity_hint(reason.code, inputs))
        for reason in calibration.reasons
    )
    document = result_document(
        replace(calibration, reasons=reasons),
        inputs=documents,
        config=config,
        seconds={"read": seconds_read, **calibration.seconds},
    )
    return CalibrationResult(document, placements=calibration.placements)


def prior_of(config: RunConfig) -> PosePrior | None:
    """Make the prior on the pose: for a map, the position of the source in it."""
    distance = None if config.prior_xyz is None else config.prior_sigma_m
    return pose_prior(config.up, config.prior_rpy_deg, config.prior_sigma_deg, distance)


def options_of(pair: InputPair, config: RunConfig) -> Options:
    """Describe two LiDARs and their poles, in the form used by the method."""
    return Options(
        radius=config.radius_m,
        radius_sigma=config.radius_sigma_m,
        sensors=(pair.target.sensor, pair.source.sensor),
        thresholds=(config.threshold_target, config.threshold_source),
        mast_sway=config.mast_sway,
    )


def calibrate_site(
    site: str | Path | Site,
    *,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
) -> SiteResult:
    """Find the poses of all LiDARs of a site in one frame.

    Parameters
    ----------
    site
        A site file, or the folder of ``site.toml``; or a `base.description.Site` that was
        put together in Python.
    progress
        Called with the name of each step as it starts, and with which recording of how many is
        read.
    on_read
        Called with each cloud once it is read.

    Returns
    -------
    SiteResult
        With ``status`` ``refused``, the reasons and no poses where the data carry no answer.

    Raises
    ------
    ReadError, MissingExtraError
        If the site file or a recording cannot be read; names the key.
    UsageError
        If a site that was put together in Python makes no sense.
    """
    progress("read")
    start = time.perf_counter()
    if isinstance(site, Site):
        read = inputs_of(site)
    else:
        read = read_site(Path(site), Listener(progress, on_read))
    documents = read.documents()
    seconds = time.perf_counter() - start
    twice = repeated(read, documents)
    if twice:
        calibration = refused(read.site, twice)
    elif read.site.carried:
        from .carried import calibrate_site_walk

        calibration, documents = calibrate_site_walk(read, documents, Listener(progress, on_read))
    else:
        calibration = pipeline.calibrate_site(read.site, progress=progress)
    document = site_document(
        calibration,
        inputs=documents,
        config=read.config,
        seconds={"read": seconds, **calibration.seconds},
    )
    return SiteResult(document, calibration=calibration)


def refused(site: Site, refusal: Refusal) -> SiteCalibration:
    """State a refusal before anything was looked for."""
    scans = tuple(
        tuple(None if cloud is None else Scan(cloud, lidar.sensor) for cloud in lidar.clouds)
        for lidar in site.lidars
    )
    unsearched = SiteScans(scans, np.zeros((len(scans), 3)))
    return state_site_refusal(site, unsearched, (), (), refusal, (), {})
