"""Wide beams widen what is seen of a pole, and with it the limits; ordinary ones change nothing."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.sensors import find_sensor
from retropole.extraction.certainty import doubt_of
from retropole.extraction.lines import fit_line
from retropole.extraction.sensor_pattern import Beams, beam_scatter, beams_by, returns_per_ring
from tests.extraction.synthetic import UP, code_of, on_pole


@pytest.mark.parametrize("name", [None, "VLP-16", "Pandar64"])
def test_ordinary_and_unknown_beams_widen_nothing(name: str | None) -> None:
    beams = beams_by(None if name is None else find_sensor(name))
    assert beam_scatter(9.0, 0.02, beams) == 0.0


def test_wide_beams_add_the_scatter_of_a_pole_seen_wider() -> None:
    beams = beams_by(find_sensor("PandarQT"))
    near, far = (beam_scatter(d, 0.02, beams) for d in (3.0, 9.0))
    assert near < far
    seen, ordinary = 0.02 + 9.0 * 0.004, 0.02 + 9.0 * 0.0015
    across = np.random.default_rng(0).uniform(-1, 1, 200_000)
    added = np.sqrt(np.var(seen * across) - np.var(ordinary * across))
    assert far == pytest.approx(added, rel=0.1)


def test_returns_of_a_ring_on_a_pole_are_counted_where_the_step_is_known() -> None:
    assert returns_per_ring(5.0, 0.02, Beams()) == np.inf
    assert returns_per_ring(5.0, 0.02, Beams(0.008, 0.01)) == pytest.approx(0.08 / 0.05)


@pytest.mark.parametrize(("name", "code"), [(None, "too_wide"), ("VLP-16", "too_wide"),
    ("PandarQT", "")])  # fmt: skip
def test_a_pole_is_sure_by_wide_beams_where_it_is_doubtful_by_others(
    name: str | None, code: str
) -> None:
    xyz = on_pole(1.8, 16, 2, width=0.08)
    xyz += np.array([9.0, 0, 0]) - xyz.mean(axis=0)
    cloud = PointCloud(xyz, np.ones(len(xyz)))
    beams = beams_by(None if name is None else find_sensor(name))
    line = fit_line(cloud, np.arange(len(xyz)), xyz.mean(axis=0), UP, 0.02, beams)
    assert code_of(doubt_of(cloud, line, 0.02, False)) == code
