"""Table IV: the paper's order, on simulated corridors and on recordings."""

import pytest

from retropole.evaluation.paper.comparing import RIVAL_NAMES
from retropole.evaluation.rivals import RIVALS
from tests.evaluation.paper.exhibits import all_exhibits, number
from tests.paths import SHARED


def test_the_order_is_the_papers() -> None:
    rows = {row[0]: row for row in all_exhibits()["table4_comparing"].rows}
    planes, poles, icp, wrong = (
        number(rows[name][2]) for name in ("planes", "poles", "ICP", "wrong hypothesis")
    )
    assert min(planes, poles) > max(icp, wrong)
    assert planes == pytest.approx(poles, rel=0.05)


def test_the_truth_has_no_error() -> None:
    rows = {row[0]: row for row in all_exhibits()["table4_comparing"].rows}
    assert number(rows["truth"][6]) == 0.0


def test_every_rival_of_the_table_is_registered() -> None:
    assert set(RIVAL_NAMES.values()) <= set(RIVALS)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real recordings of ../shared/data are absent")
def test_the_reference_of_a_real_recording_is_sharper() -> None:
    rows = all_exhibits()["table4_recorded"].rows
    sums = {row[1]: row[2] for row in rows if row[0] == "pandaset"}
    assert number(sums["reference"]) > number(sums["wrong hypothesis"])
