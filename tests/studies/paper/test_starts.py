"""Fig. 4: of the eight starts, four end in exact matches, 180° apart; the others where they may."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from studies.paper.starts import NAMES, SAME_RMS, different, eight_ends
from tests.studies.paper.exhibits import all_exhibits, number

pytestmark = pytest.mark.full


def test_the_exact_ends_are_180_degrees_apart_and_the_others_worse() -> None:
    rows = all_exhibits()["fig4_hypotheses"].rows
    assert [row[0] for row in rows] == list(NAMES)
    assert [row[3] for row in rows] == ["yes"] * 4 + ["no"] * 4
    assert [number(row[4]) for row in rows[:4]] == pytest.approx([0, 180, 180, 180], abs=1.0)
    rms = [number(row[2]) for row in rows]
    assert rms[:4] == pytest.approx([rms[0]] * 4, rel=1e-3)
    assert min(rms[4:]) > 2 * rms[0]


def test_other_starts_may_run_on_into_exact_matches() -> None:
    found = eight_ends(7)
    assert found is not None
    assert all(end.exact and end.rms < SAME_RMS * found[1][0].rms for end in found[1])
    assert different(found[1]) == 4


def test_ends_are_different_beyond_a_limit() -> None:
    found = eight_ends(1)
    assert found is not None
    end = found[1][0]
    for step, count in ((0.02, 1), (0.2, 2)):
        T = se3.retract(end.T_target_source, np.array([step, 0, 0, 0, 0, 0]))
        assert different([end, replace(end, T_target_source=T)]) == count
