"""`calibrate` and `calibrate_site`: recordings in, a result out to look at and to save."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from .. import pipeline
from ..adjustment.answer import SiteCalibration
from ..base.datatypes import Placement, Scan
from ..base.description import Site
from ..base.errors import Refusal
from ..hypotheses.prior import rotation_prior
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
    tell_repeated,
)
from .options import checked_options, run_config
from .result import CalibrationResult, SiteResult
from .site_inputs import inputs_of, read_site, repeated


def calibrate(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    *,
    radius: float = DEFAULT_CONFIG.radius_m,
    radius_sigma: float = DEFAULT_CONFIG.radius_sigma_m,
    sensor_target: str = DEFAULT_CONFIG.sensor_target,
    sensor_source: str = DEFAULT_CONFIG.sensor_source,
    threshold_target: float | None = None,
    threshold_source: float | None = None,
    carried: bool = False,
    poles: int | None = None,
    refine: bool = DEFAULT_CONFIG.refine,
    trust_poles: bool = DEFAULT_CONFIG.trust_poles,
    deceiving_share: float | None = None,
    need: float | None = None,
    at: float | None = None,
    up: bool = DEFAULT_CONFIG.up,
    prior_rpy_deg: Sequence[float] | None = None,
    prior_sigma_deg: float = DEFAULT_CONFIG.prior_sigma_deg,
    mast_sway_deg: float | None = None,
    hypothesis: str | None = None,
    target_topic: str | None = None,
    source_topic: str | None = None,
    frames: slice | None = None,
    max_points: int = DEFAULT_CONFIG.max_points,
    unit: str = DEFAULT_CONFIG.unit,
    unit_source: str | None = None,
    intensity: str | None = None,
    intensity_source: str | None = None,
    angles: str | None = None,
    angles_source: str | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> CalibrationResult:
    """Find the rigid transform between two LiDARs that see the same taped poles.

    Parameters
    ----------
    target, source
        A path that `io.read_cloud` reads; an array, (N, 4) of x, y, z in metres and intensity; or
        a `PointCloud`. Each in its own sensor's frame. Or a list of these, one for each placement
        of the poles, target and source in the same order: one pose is found for all.
    radius, radius_sigma
        Radius of the poles and its 1 σ, metres, at least 2 % of it: the prior of an estimate.
    sensor_target, sensor_source
        Names of sensors, or ``auto``.
    threshold_target, threshold_source
        Intensity from which a return counts as retro-reflective; None asks the sensor, or else the
        cloud.
    carried
        A person carries one pole, and both recordings are of the whole walk, with a time for each
        point. The answer has the offset of the clocks, `CalibrationResult.walk`. What follows up to
        `hypothesis`, but for `refine`, `need` and `at`, is of standing poles alone.
    poles
        Exact number of poles that both LiDARs see; None takes any number from one up.
    refine
        Whether the scene refines the pose that the poles give.
    trust_poles
        Whether you trust two poles where the scene has too little to confirm them.
    deceiving_share
        Share of recordings like yours that deceive, since poles were moved between them or other
        objects taken for poles: ``probability_wrong`` is stated for it. None takes that of the
        simulations behind the figure, or less where both LiDARs recorded at the same time.
    need, at
        How accurate the answer must be: no point up to `at` away, 30 m where it is None, lands
        further than `need` from its true place, metres. The verdict says whether that is 95 % sure.
    up
        Both LiDARs stand roughly upright: hypotheses that contradict it are left out.
    prior_rpy_deg, prior_sigma_deg
        Expected roll, pitch and yaw of the source in the target's frame, degrees, instead of `up`;
        and 1 σ of either.
    mast_sway_deg
        1 σ of the angle that the masts of both LiDARs sway by, degrees: recordings of one or two
        sweeps do not show it. None takes what the sweeps show.
    hypothesis
        Letter of the hypothesis to take, in the list that the same run gives without it: for where
        you know the place and the scene does not decide. It is refused where the scene conflicts
        with it; the verdict is at best ``warn``.
    target_topic, source_topic, frames
        Of recordings, the topic of a bag and the frames, as `io.read_cloud` takes them.
    max_points
        Of a cloud with more, so many are kept: the brightest, and the others evenly.
    unit, unit_source
        Of the coordinates, ``m``, ``cm``, ``mm``, ``ft`` or ``in``; of those of the source, where
        it is another.
    intensity, intensity_source
        Field of a file that the intensity is read from, where several may be one; of the source,
        where it is another. None takes the usual one.
    angles, angles_source
        Of packets, the file of the unit's own angles; None takes those of the table.
    progress
        Called with the name of each step as it starts; while a recording of several frames is read,
        with which of how many.

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
        Where a file cannot be read.
    """
    return calibrate_with(target, source, run_config(locals()), Listener(progress))


def calibrate_with(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener = SILENT,
) -> CalibrationResult:
    """Calibrate as `calibrate` does, with the options of a run as the result document holds them.

    Parameters
    ----------
    target, source
        As `calibrate` takes them.
    config
        The options.
    listener
        Told of each step as it starts, and of each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `calibrate`.
    """
    config = checked_options(config)
    listener.progress("read")
    if config.carried:
        from .carried import calibrate_walk

        walk, recorded = calibrate_walk(target, source, config, listener)
        return CalibrationResult(walk, placements=recorded)
    start = time.perf_counter()
    pairs = read_placements(target, source, config, listener)
    inputs = [each for pair in pairs for each in pair]
    documents = input_documents(inputs)
    seconds_read = time.perf_counter() - start
    twice = refuse_repeated(inputs, documents, partial(tell_repeated, inputs))
    if twice is not None:
        scans = [[Scan(each.cloud, each.sensor) for each in pair] for pair in pairs]
        unsearched = tuple(Placement(target, source) for target, source in scans)
        calibration = state_refusal(twice, unsearched, (), {})
    else:
        calibration = pipeline.calibrate(
            [pair.target.cloud for pair in pairs],
            [pair.source.cloud for pair in pairs],
            options=replace(
                known_of(pairs[0], config),
                poles=config.poles,
                scene=config.refine,
                prior=rotation_prior(config.up, config.prior_rpy_deg, config.prior_sigma_deg),
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


def known_of(pair: InputPair, config: RunConfig) -> Options:
    """Say what is known of two LiDARs and their poles, as the method takes it."""
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
        A site file, or the folder that holds ``site.toml``; or a `base.description.Site` that was
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
        Where the site file or a recording cannot be read; names the key.
    UsageError
        Where a site that was put together in Python makes no sense.
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
    calibration = (
        refused(read.site, twice)
        if twice
        else pipeline.calibrate_site(read.site, progress=progress)
    )
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
