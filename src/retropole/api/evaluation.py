"""`evaluate`: how well a transform aligns two clouds, whatever found it."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError, readable, said
from ..base.se3 import rigid
from ..checking.comparison import Compared as Compared
from ..checking.comparison import compare as compare_clouds
from ..checking.drift import swap
from ..checking.metrics import KERNEL_WIDTH
from ..checking.metrics import Alignment as Alignment
from ..checking.metrics import Errors as Errors
from ..checking.metrics import errors_of as errors_of
from ..checking.metrics import evaluate as score
from ..export import read_result, read_transform
from ..extraction.extent import check_coordinates
from ..result import DEFAULT_CONFIG, ResultDoc, RunConfig
from .calibration import options_of
from .inputs import SILENT, CloudSource, Input, Listener, read_pair
from .options import with_keywords
from .result import CalibrationResult
from .stored import are_swapped, hashes_of


def evaluate(
    target: CloudSource,
    source: CloudSource,
    T_target_source: Array | CalibrationResult | str | Path,
    *,
    sigma: float = KERNEL_WIDTH,
    seed: int = 0,
    options: RunConfig = DEFAULT_CONFIG,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
    **older: Any,
) -> Alignment:
    """Score a transform by the clouds it aligns; no truth is needed.

    Compare the scores of several transforms of the same two clouds: those of other clouds are on
    another scale.

    Parameters
    ----------
    target, source
        A path that `io.read_cloud` reads, an array, (N, 3) or (N, 4), or a `PointCloud`; each in
        the frame of its sensor.
    T_target_source
        (4, 4) maps source points into the target's frame; or a result; or a file of any format
        that ``retropole export`` writes, or the folder of a result. The poles of a result are
        left out of the objects in the scene, as they were when it was calibrated.
    sigma
        Kernel width of the entropy, metres.
    seed
        Of the choice of points for the entropy, where there are too many for all.
    options, older
        As `calibrate` takes them: how the recordings are read.
    progress, on_read
        Called with the name of each step as it starts, and with each cloud once it is read.

    Raises
    ------
    UsageError
        For a matrix that is not a rigid transform, for arrays of another shape, and where the
        files are those of the result swapped, or the seed is no number from 0 up.
    Refusal
        ``too_few_points`` if a cloud is too small, ``far_from_lidar`` if a coordinate is not one of
        a LiDAR, or if the transform is that of a refused result.
    ReadError, MissingExtraError
        If a file cannot be read.
    """
    config, rng = with_keywords(options, {}, older), _generator(seed)
    T, document = _transform(T_target_source), _result_of(T_target_source)
    _refuse_swapped(target, source, document)
    progress("read")
    pair = read_pair(target, source, config, Listener(progress, on_read))
    for each in pair:
        check_coordinates(each.cloud)
    progress("evaluate")
    poles = _poles(document)
    return score(pair.target.cloud, pair.source.cloud, T, rng=rng, sigma=sigma, poles=poles)


def compare(
    target: CloudSource,
    source: CloudSource,
    config: RunConfig,
    methods: Sequence[str],
    T_true: Array | None = None,
    listener: Listener = SILENT,
    *,
    sigma: float = KERNEL_WIDTH,
    seed: int = 0,
) -> list[Compared]:
    """Run our method and its rivals on the same clouds, and score their answers in the same way.

    Parameters
    ----------
    target, source
        As `evaluate` takes them.
    config
        The options: what is read, and radius, sensors and thresholds of our method.
    methods, T_true, sigma, seed
        As `checking.comparison.compare` takes them.
    listener
        Receives each step as it starts, and each cloud once it is read.

    Raises
    ------
    UsageError
        For an unknown method, and as `api.inputs.read_input`.
    ReadError, MissingExtraError
        If a file cannot be read.
    """
    listener.progress("read")
    pair = read_pair(target, source, config, listener)
    return compare_clouds(
        pair.target.cloud,
        pair.source.cloud,
        methods,
        options=options_of(pair, config),
        T_true=T_true,
        sigma=sigma,
        seed=seed,
        progress=listener.progress,
    )


def _generator(seed: int) -> np.random.Generator:
    try:
        return np.random.default_rng(operator.index(seed))
    except (TypeError, ValueError):
        raise UsageError(f"seed is {seed!r}, expected a number from 0 up") from None


def _result_of(given: Array | CalibrationResult | str | Path) -> ResultDoc | None:
    """Give the result document that a transform is from; None if it has another source."""
    if isinstance(given, CalibrationResult):
        return given.document
    found = read_result(Path(given)) if isinstance(given, str | Path) else None
    return found if isinstance(found, ResultDoc) else None


class _Line(NamedTuple):
    """Where a pole is, as a result document says it."""

    point: Array
    direction: Array
    length: float


def _poles(document: ResultDoc | None) -> tuple[list[_Line], list[_Line]]:
    """Read the poles of the target and of the source that a result lists."""
    if document is None:
        return [], []
    target, source = (
        [_Line(pole.point_m, pole.direction, pole.length_m) for pole in of_lidar]
        for of_lidar in (document.poles.target, document.poles.source)
    )
    return target, source


def _refuse_swapped(target: CloudSource, source: CloudSource, document: ResultDoc | None) -> None:
    """Refuse the files of a result swapped, before they are read."""
    if not isinstance(target, str | Path) or not isinstance(source, str | Path):
        return
    if document is not None and are_swapped(hashes_of(document), target, source):
        raise UsageError(swap("the result was computed from these files", {}).message)


def _transform(given: Array | CalibrationResult | str | Path) -> Array:
    if isinstance(given, CalibrationResult):
        return given.required_transform()
    if isinstance(given, str | Path):
        with readable(given):
            return read_transform(Path(given)).T_parent_child
    try:
        return rigid(given)
    except (ReadError, TypeError, ValueError) as error:
        raise UsageError(f"T_target_source: {said(error)}") from None
