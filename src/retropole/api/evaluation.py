"""`evaluate`: how well a transform aligns two clouds, whatever found it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError
from ..base.se3 import rigid
from ..evaluation.entropy import KERNEL_WIDTH
from ..evaluation.metrics import Alignment
from ..evaluation.metrics import evaluate as score
from ..export import read_transform
from ..extraction.extent import check_coordinates
from ..io.units import unit_named
from .inputs import CloudSource, read_input
from .result import CalibrationResult


def evaluate(
    target: CloudSource,
    source: CloudSource,
    T_target_source: Array | CalibrationResult | str | Path,
    *,
    sigma: float = KERNEL_WIDTH,
    seed: int = 0,
    target_topic: str | None = None,
    source_topic: str | None = None,
    frames: slice | None = None,
    unit: str = "m",
    unit_source: str | None = None,
) -> Alignment:
    """Score a transform by the clouds it aligns; no truth is needed.

    Compare the scores of several transforms of the same two clouds: those of other clouds are on
    another scale.

    Parameters
    ----------
    target, source
        A path that `io.read_cloud` reads, an array, (N, 3) or (N, 4), or a `PointCloud`; each in
        its own sensor's frame.
    T_target_source
        (4, 4) maps source points into the target's frame; or a result; or a file of any format
        that ``retropole export`` writes, or the folder of a result.
    sigma
        Kernel width of the entropy, metres.
    seed
        Of the choice of points for the entropy, where there are too many for all.
    target_topic, source_topic, frames
        Of recordings, the topic of a bag and the frames, as `io.read_cloud` takes them.
    unit, unit_source
        Of the coordinates, ``m``, ``cm`` or ``mm``; of those of the source, where it is another.

    Raises
    ------
    UsageError
        For a matrix that is not a rigid transform, and for arrays of another shape.
    Refusal
        ``too_few_points`` where a cloud is too small, ``far_from_lidar`` where a coordinate is
        none, and where the transform is that of a refused result.
    ReadError, MissingExtraError
        Where a file cannot be read.
    """
    T = _transform(T_target_source)
    given = [
        read_input(cloud, topic=topic, frames=frames, unit=unit_named(each), role=role)
        for cloud, topic, each, role in (
            (target, target_topic, unit, "target"),
            (source, source_topic, unit_source or unit, "source"),
        )
    ]
    for each in given:
        check_coordinates(each.cloud)
    rng = np.random.default_rng(seed)
    return score(given[0].cloud, given[1].cloud, T, rng=rng, sigma=sigma)


def _transform(given: Array | CalibrationResult | str | Path) -> Array:
    if isinstance(given, CalibrationResult):
        return given.required_transform()
    if isinstance(given, str | Path):
        try:
            return read_transform(Path(given)).T_parent_child
        except OSError as error:
            raise ReadError(f"{given}: cannot be read ({error.strerror or error})") from None
    try:
        return rigid(given)
    except (ReadError, TypeError, ValueError) as error:
        raise UsageError(f"T_target_source: {error}") from None
