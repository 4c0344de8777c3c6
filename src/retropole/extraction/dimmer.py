"""Poles whose tape is too dim for the threshold: old, far, or met at its edges.

By a low threshold much else is bright, so that what is found there is doubtful
(docs/detection.md, Candidate poles).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..base.datatypes import Detection, PointCloud, Pole
from ..base.sensors import Sensor, Threshold, lower_thresholds
from .candidates import with_candidates, without_repeats
from .poles import MAX_POLES, extract_poles, is_too_low


def with_dimmer_candidates(
    cloud: PointCloud, detection: Detection, radius: float, sensor: Sensor | None = None
) -> Detection:
    """Add the poles whose tape is too dim for the threshold, each at the highest that shows it.

    By a low threshold much else is bright, so that these are doubtful too.

    Parameters
    ----------
    cloud
        The cloud of the detection.
    detection
        As `extract_poles` or `with_candidates` gives it.
    radius
        Of the poles, metres.
    sensor
        What recorded it; None where it is not known.

    Returns
    -------
    Detection
        The same, with more `candidates`, those it has first; at most `MAX_POLES`. Itself
        where its threshold was given.
    """
    assert cloud.intensity is not None
    chosen = Threshold(detection.threshold, detection.threshold_source)
    found: list[Pole] = []
    less: list[Pole] = []
    for lower in lower_thresholds(cloud.intensity, chosen):
        if is_too_low(cloud.intensity, lower.value):
            continue
        there = extract_poles(cloud, sensor=sensor, threshold=lower.value, radius=radius)
        found += _apart_from((*detection.poles, *found), there.poles, len(cloud))
        less += with_candidates(cloud, there, radius, sensor).candidates
    # Of one that is doubtful at the threshold too, a lower one shows more.
    kept = _apart_from(found, detection.candidates, len(cloud))
    doubtful = without_repeats(kept, len(cloud)) + without_repeats(found, len(cloud))
    # Much is bright by a low threshold: of what is doubtful there, only what shares nothing.
    for pole in without_repeats(less, len(cloud)):
        doubtful += _apart_from((*detection.poles, *doubtful), (pole,), len(cloud))
    return replace(detection, candidates=tuple(doubtful[:MAX_POLES]))


def _apart_from(known: Sequence[Pole], poles: Sequence[Pole], count: int) -> list[Pole]:
    """Those of some poles that share no return with the known ones."""
    taken = np.zeros(count, dtype=bool)
    for pole in known:
        taken[pole.index] = True
    return [pole for pole in poles if not taken[pole.index].any()]
