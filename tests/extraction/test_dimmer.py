"""Dim tape is found by a lower threshold, few returns of it too, and as doubtful only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.sensors import find_sensor
from retropole.extraction.candidates import with_dimmer_candidates
from retropole.extraction.poles import extract_poles
from tests.extraction.scenes import Y, labels_of, pole, seen

VLP = find_sensor("VLP-16")


@pytest.mark.parametrize(("count", "is_found"), [(3, True), (5, True), (2, False)])
def test_few_dim_returns_are_doubtful(count: int, is_found: bool) -> None:
    cloud, labels = seen([pole((6, 0)), pole((3.4, -1.6), 0.25 * Y)], "VLP-16", seed=3)
    assert cloud.ring is not None
    assert cloud.intensity is not None
    on_it = np.flatnonzero(labels == 0)
    rings = np.unique(cloud.ring[on_it])[:count]
    few = [on_it[cloud.ring[on_it] == ring][0] for ring in rings]
    dim = cloud.intensity.copy()
    dim[few] = 0.8 * VLP.threshold
    kept = np.sort(np.array([*np.flatnonzero(labels != 0), *few]))
    cloud, labels = replace(cloud, intensity=dim).select(kept), labels[kept]
    before = extract_poles(cloud, sensor=VLP)
    after = with_dimmer_candidates(cloud, before, 0.02, VLP)
    assert labels_of(before, labels) == labels_of(after, labels) == [1]
    assert labels_of(replace(after, poles=after.candidates), labels) == ([0] if is_found else [])
    given = extract_poles(cloud, sensor=VLP, threshold=VLP.threshold)
    assert not with_dimmer_candidates(cloud, given, 0.02, VLP).candidates
