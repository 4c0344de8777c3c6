"""Our method and its rivals on one pair of clouds, side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..base.datatypes import Array, Calibration, PointCloud
from ..base.errors import Refusal, UsageError
from ..base.quantities import step_of
from ..pipeline import NO_OPTIONS, Options, calibrate
from .methods import ALL_METHODS, OURS, missing_extra
from .metrics import KERNEL_WIDTH, Alignment, Errors, errors_of, evaluate
from .rivals import FUNCTIONS

Status = Literal["ok", "warn", "refused", "missing"]


@dataclass(frozen=True, eq=False)
class Compared:
    """The outcome of one method.

    Attributes
    ----------
    method
        Its name in `methods.ALL_METHODS`.
    status
        ``missing`` where the extra that it needs is not installed.
    codes
        Codes of the reasons of a refusal or warning; of a missing method the name of the extra.
    message
        The first reason in words.
    T_target_source
        (4, 4) or None.
    alignment
        How the clouds lie together under it; None without it.
    errors
        Against the truth; None without either.
    seconds
        Time that it took, with the clouds in memory; None if it did not run.
    """

    method: str
    status: Status
    codes: tuple[str, ...] = ()
    message: str = ""
    T_target_source: Array | None = None
    alignment: Alignment | None = None
    errors: Errors | None = None
    seconds: float | None = None


def compare(
    target: PointCloud,
    source: PointCloud,
    methods: Sequence[str],
    *,
    options: Options = NO_OPTIONS,
    T_true: Array | None = None,
    sigma: float = KERNEL_WIDTH,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> list[Compared]:
    """Run methods one after the other on the same clouds, and score their answers in the same way.

    Parameters
    ----------
    target, source
        Clouds, each in the frame of its LiDAR.
    methods
        Names from `methods.ALL_METHODS`.
    options
        As `pipeline.calibrate`; the rivals do not use these.
    T_true
        (4, 4) truth, where it is known.
    sigma
        Kernel width of the entropy, metres.
    seed
        Of what rivals draw, and of the points on which all are scored.
    progress
        Called with the name of each method as it starts, and which of how many it is.

    Returns
    -------
    list of Compared
        In the order of ``methods``.

    Raises
    ------
    UsageError
        An unknown method.
    """
    unknown = [name for name in methods if name not in ALL_METHODS]
    if unknown:
        raise UsageError(f"no method is named {unknown[0]!r}; there are {', '.join(ALL_METHODS)}")

    ours: Calibration | None = None
    found: list[Compared] = []
    for k, name in enumerate(methods, 1):
        progress(step_of(name, k, len(methods)))
        if name in OURS:
            ours = ours or calibrate(target, source, options=options)
            outcome = _outcome_of_ours(name, ours)
        else:
            outcome = _run_rival(name, target, source, seed)
        T = outcome.T_target_source
        if T is not None:
            # All are scored on the same points, or chance would rank those that are similar.
            rng = np.random.default_rng(seed)
            outcome = replace(
                outcome,
                alignment=evaluate(target, source, T, rng=rng, sigma=sigma),
                errors=None if T_true is None else errors_of(T, T_true),
            )
        found.append(outcome)
    return found


def _outcome_of_ours(name: str, answer: Calibration) -> Compared:
    """Extract the outcome of the poles alone, or with the scene, from one calibration."""
    codes = tuple(reason.code for reason in answer.reasons)
    message = answer.reasons[0].message if answer.reasons else ""
    alone = name == "poles"
    seconds = sum(s for step, s in answer.seconds.items() if not (alone and step == "refine"))
    pose = answer.poles if alone else answer.refined
    if answer.status == "refused":
        return Compared(name, "refused", codes, message, seconds=seconds)
    if pose is None:
        message = "both LiDARs see too few surfaces of the scene to refine the pose of the poles"
        return Compared(name, "refused", ("no_scene",), message, seconds=seconds)
    return Compared(name, answer.status, codes, message, pose.T_target_source, seconds=seconds)


def _run_rival(name: str, target: PointCloud, source: PointCloud, seed: int) -> Compared:
    extra = missing_extra(name)
    if extra is not None:
        return Compared(name, "missing", (extra,), f"pip install 'retropole[{extra}]'")
    rng = np.random.default_rng(seed)
    start = time.perf_counter()
    try:
        pose = FUNCTIONS[name](target, source, rng)
    except Refusal as refusal:
        seconds = time.perf_counter() - start
        return Compared(name, "refused", (refusal.code,), refusal.message, seconds=seconds)
    return Compared(
        name, "ok", T_target_source=pose.T_target_source, seconds=time.perf_counter() - start
    )
