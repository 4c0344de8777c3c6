"""`detect`: the poles in one recording, and why every other bright cluster is not one."""

from __future__ import annotations

from ..base.datatypes import Detection
from ..base.errors import Refusal
from ..extraction.poles import extract_poles
from ..result import DEFAULT_CONFIG
from .inputs import CloudSource, Input, intensity_hint, read_input
from .options import run_config


def detect(
    cloud: CloudSource,
    *,
    radius: float = DEFAULT_CONFIG.radius_m,
    sensor: str = "auto",
    threshold: float | None = None,
    topic: str | None = None,
    frames: slice | None = None,
    max_points: int = DEFAULT_CONFIG.max_points,
    unit: str = DEFAULT_CONFIG.unit,
    intensity: str | None = None,
    angles: str | None = None,
) -> Detection:
    """Find the poles in a recording.

    Parameters
    ----------
    cloud
        A path that `io.read_cloud` reads; an array, (N, 4) of x, y, z in metres and intensity; or
        a `PointCloud`.
    radius
        Of the poles, metres.
    sensor
        Name of the sensor, or ``auto``.
    threshold
        Intensity from which a return is treated as retro-reflective; None takes that of the sensor,
        or else of the cloud.
    topic, frames
        Of a recording, the topic of a bag and the frames, as `io.read_cloud` takes them.
    max_points
        Of a cloud with more, this many are kept: the brightest, and the others evenly.
    unit
        Of the coordinates: ``m``, ``cm``, ``mm``, ``ft`` or ``in``.
    intensity
        Field of a file that the intensity is read from; None takes the usual one.
    angles
        Of packets, the file of the unit; None takes those of the table.

    Returns
    -------
    Detection
        The poles, the best supported first, and each rejected cluster with its reason.

    Raises
    ------
    Refusal
        ``no_intensity`` where the cloud has none.
    UsageError
        For arrays of another shape, unknown sensors and a radius that no pole has.
    ReadError, MissingExtraError
        If the file cannot be read.
    """
    of_target = {"sensor_target": sensor, "threshold_target": threshold, "target_topic": topic}
    config = run_config({**locals(), **of_target})
    return detect_in(read_input(cloud, config.of_target), config.radius_m)


def detect_in(given: Input, radius: float) -> Detection:
    """Find the poles of a radius, metres, in a cloud that has been read.

    Raises
    ------
    Refusal
        ``no_intensity`` where the cloud has none.
    """
    try:
        return extract_poles(
            given.cloud, sensor=given.sensor, threshold=given.threshold, radius=radius
        )
    except Refusal as refusal:
        hint = intensity_hint(refusal.code, [given])
        raise Refusal(refusal.code, refusal.message + hint, refusal.values) from None
