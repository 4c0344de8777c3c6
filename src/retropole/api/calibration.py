"""`calibrate`: paths, arrays or clouds in, a result out that can be looked at and saved."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import index

from ..base.datatypes import MAX_RADIUS, Placement, Scan
from ..base.errors import UsageError
from ..base.uncertainty.purpose import DEFAULT_AT, FARTHEST, LARGEST_NEED, USABLE, Need
from ..io.thinning import LEAST_POINTS
from ..io.units import unit_named
from ..matching.prior import rotation_prior
from ..pipeline import calibrate as find_pose
from ..result import DEFAULT_CONFIG, RunConfig, result_document
from ..scene.choice import is_hypothesis_name
from ..verdict import refused
from .inputs import (
    CloudSource,
    Input,
    check_radius,
    input_documents,
    intensity_hint,
    read_placements,
    repeated,
)
from .result import CalibrationResult

MIN_POLES = 2
"""One pole leaves the rotation about it, and the place along it, free."""


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
    poles: int | None = None,
    refine: bool = DEFAULT_CONFIG.refine,
    trust_poles: bool = DEFAULT_CONFIG.trust_poles,
    need: float | None = None,
    at: float | None = None,
    up: bool = DEFAULT_CONFIG.up,
    prior_rpy_deg: Sequence[float] | None = None,
    prior_sigma_deg: float = DEFAULT_CONFIG.prior_sigma_deg,
    hypothesis: str | None = None,
    target_topic: str | None = None,
    source_topic: str | None = None,
    frames: slice | None = None,
    max_points: int = DEFAULT_CONFIG.max_points,
    unit: str = DEFAULT_CONFIG.unit,
    unit_source: str | None = None,
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
    poles
        Exact number of poles that both LiDARs see; None takes any number from two up.
    refine
        Whether the scene refines the pose that the poles give.
    trust_poles
        Whether you vouch for two poles where the scene has too little to confirm them.
    need, at
        How accurate the answer must be: no point up to `at` away, 30 m where it is None, lands
        further than `need` from its true place, metres. The verdict says whether that is 95 % sure.
    up
        Both LiDARs stand roughly upright: hypotheses that contradict it are left out.
    prior_rpy_deg, prior_sigma_deg
        Expected roll, pitch and yaw of the source in the target's frame, degrees, instead of `up`;
        and 1 σ of either.
    hypothesis
        Letter of the hypothesis to take, in the list that the same run gives without it: for where
        you know the place and the scene does not decide. It is refused where the scene denies it;
        the verdict is at best ``warn``.
    target_topic, source_topic, frames
        Of recordings, the topic of a bag and the frames, as `io.read_cloud` takes them.
    max_points
        Of a cloud with more, so many are kept: the brightest, and the others evenly.
    unit, unit_source
        Of the coordinates, ``m``, ``cm`` or ``mm``; of those of the source, where it is another.
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
    try:
        # The result document holds Python's own numbers, also where NumPy's are given.
        config = RunConfig(
            radius_m=float(radius),
            radius_sigma_m=float(radius_sigma),
            up=bool(up),
            prior_rpy_deg=None if prior_rpy_deg is None else _three(prior_rpy_deg),
            prior_sigma_deg=float(prior_sigma_deg),
            hypothesis=hypothesis,
            poles=None if poles is None else index(poles),
            refine=bool(refine),
            trust_poles=bool(trust_poles),
            need_m=None if need is None else float(need),
            at_m=None if at is None else float(at),
            threshold_target=None if threshold_target is None else float(threshold_target),
            threshold_source=None if threshold_source is None else float(threshold_source),
            sensor_target=sensor_target,
            sensor_source=sensor_source,
            target_topic=target_topic,
            source_topic=source_topic,
            frames=None if frames is None else _parts(frames),
            max_points=index(max_points),
            unit=unit_named(unit),
            unit_source=None if unit_source is None else unit_named(unit_source),
        )
    except (TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"an option has a value of the wrong type: {error}") from None
    return calibrate_with(target, source, config, progress=progress)


def calibrate_with(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    *,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
) -> CalibrationResult:
    """Calibrate as `calibrate` does, with the options of a run as the result document holds them.

    Parameters
    ----------
    target, source
        As `calibrate` takes them.
    config
        The options.
    progress
        Called with the name of each step as it starts; while a recording of several frames is read,
        with which of how many.
    on_read
        Called with each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `calibrate`.
    """
    check_options(config)
    progress("read")
    start = time.perf_counter()
    pairs = read_placements(target, source, config, progress)
    inputs = [each for pair in pairs for each in pair]
    for each in inputs:
        on_read(each)
    documents = input_documents(inputs)
    seconds_read = time.perf_counter() - start
    twice = repeated(pairs, documents)
    if twice is not None:
        unsearched = tuple(
            Placement(
                Scan(pair.target.cloud, pair.target.sensor),
                Scan(pair.source.cloud, pair.source.sensor),
            )
            for pair in pairs
        )
        calibration = refused(twice, unsearched, (), {})
    else:
        calibration = find_pose(
            [pair.target.cloud for pair in pairs],
            [pair.source.cloud for pair in pairs],
            radius=config.radius_m,
            radius_sigma=config.radius_sigma_m,
            sensors=(pairs[0].target.sensor, pairs[0].source.sensor),
            thresholds=(config.threshold_target, config.threshold_source),
            poles=config.poles,
            scene=config.refine,
            trust_poles=config.trust_poles,
            need=_need(config),
            by_hand=config.hypothesis,
            prior=rotation_prior(config.up, config.prior_rpy_deg, config.prior_sigma_deg),
            progress=progress,
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
    return CalibrationResult(document, calibration.placements)


def _need(config: RunConfig) -> Need | None:
    """Take how accurate the answer must be; None where that is not said."""
    if config.need_m is None:
        return None
    return Need(config.need_m, DEFAULT_AT if config.at_m is None else config.at_m)


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    roll, pitch, yaw = values
    return float(roll), float(pitch), float(yaw)


def _parts(frames: slice) -> tuple[int | None, int | None, int | None]:
    start, stop, step = (
        None if value is None else index(value)
        for value in (frames.start, frames.stop, frames.step)
    )
    return start, stop, step


def check_options(config: RunConfig) -> None:
    """Refuse options that make no sense, before anything is read.

    Raises
    ------
    UsageError
        Naming the option and what is expected.
    """
    check_radius(config.radius_m)
    if config.at_m is not None and config.need_m is None:
        raise UsageError("at is the distance for need, how accurate the answer must be: give both")
    poles = MIN_POLES if config.poles is None else config.poles
    need = _need(config) or USABLE
    for name, value, allowed, expected in (
        (
            "radius_sigma",
            config.radius_sigma_m,
            0 <= config.radius_sigma_m <= MAX_RADIUS,
            f"from 0 to {MAX_RADIUS:g} m",
        ),
        (
            "prior_sigma_deg",
            config.prior_sigma_deg,
            0 < config.prior_sigma_deg <= 180,
            "above 0, 180 at most",
        ),
        (
            "need",
            need.within,
            0 < need.within <= LARGEST_NEED,
            f"above 0, {LARGEST_NEED:g} m at most",
        ),
        ("at", need.at, 0 < need.at <= FARTHEST, f"above 0, {FARTHEST:g} m at most"),
        ("poles", poles, poles >= MIN_POLES, f"from {MIN_POLES} up"),
        (
            "max_points",
            config.max_points,
            config.max_points >= LEAST_POINTS,
            f"from {LEAST_POINTS} up",
        ),
    ):
        if not (allowed and math.isfinite(value)):
            raise UsageError(f"{name} is {value}, expected a number {expected}")
    if config.hypothesis is not None and not is_hypothesis_name(config.hypothesis):
        raise UsageError(
            f"hypothesis is {config.hypothesis!r}, expected a letter of the list of hypotheses, "
            "such as a"
        )
    rotation_prior(config.up, config.prior_rpy_deg, config.prior_sigma_deg)
