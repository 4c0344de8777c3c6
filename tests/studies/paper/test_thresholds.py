"""Table I: the paper's thresholds are ours, but for named exceptions."""

import pytest

from retropole.base.sensors import SENSORS
from studies.paper.thresholds import thresholds

pytestmark = pytest.mark.full


def test_thresholds_of_the_paper_are_ours_but_for_named_exceptions() -> None:
    rows = thresholds().rows
    assert [row[1] for row in rows] == list(SENSORS)
    assert {row[1] for row in rows if row[2] not in (None, row[3])} == {"VLS-128"}
