"""Table IV: which of the paper's order holds, on simulated corridors and on recordings."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.checking.metrics import KERNEL_WIDTH
from retropole.simulation import EXACT, simulate_pair
from studies.paper.comparing import comparing_real
from studies.paper.sharpness import KERNEL_WIDTHS, RELATIONS, sums_of
from tests.paths import SHARED
from tests.studies.paper.exhibits import all_exhibits, number

pytestmark = pytest.mark.full


def test_planes_and_poles_are_sharpest_where_icp_ends_rotated() -> None:
    rows = {row[0]: row for row in all_exhibits()["table4_comparing"].rows}
    planes, poles, icp, wrong = (
        number(rows[name][2]) for name in ("planes", "poles", "ICP", "wrong hypothesis")
    )
    assert min(planes, poles) > max(icp, wrong)
    assert planes == pytest.approx(poles, rel=0.05)


def test_every_relation_is_counted() -> None:
    """One corridor: each count is a comparison of two rows of the list of corridors."""
    exhibits = all_exhibits()
    sums = {row[1]: row[2:4] for row in exhibits["table4_corridors"].rows}
    counted = {row[:2]: row[2:] for row in exhibits["table4_order"].rows}
    assert set(counted) == {(kind, sigma) for kind in ("thinned", "raw") for sigma in KERNEL_WIDTHS}
    for k, kind in enumerate(("thinned", "raw")):
        held = [number(sums[a][k]) > number(sums[b][k]) for a, b in RELATIONS]
        written = [f"{int(each)} of 1" for each in (*held, all(held[:3]))]
        assert list(counted[kind, KERNEL_WIDTH]) == written


def test_a_cloud_on_itself_is_sharper_than_one_next_to_it() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(0), noise=EXACT)
    beside = se3.retract(pair.T_target_source, np.array([0, 0, 0, 0, 0.3, 0.3]))
    for thinned in (True, False):
        sums = sums_of(pair, {"on": pair.T_target_source, "beside": beside}, thinned)
        assert np.all(sums["on"][:3] > sums["beside"][:3])


def test_the_truth_has_no_error() -> None:
    rows = {row[0]: row for row in all_exhibits()["table4_comparing"].rows}
    assert number(rows["truth"][6]) == 0.0


@pytest.mark.nightly
@pytest.mark.skipif(not SHARED.is_dir(), reason="the real recordings of ../shared/data are absent")
def test_the_reference_of_a_real_recording_is_sharper() -> None:
    rows = comparing_real(SHARED).rows
    sums = {row[1]: row[2] for row in rows if row[0] == "pandaset"}
    assert number(sums["reference"]) > number(sums["wrong hypothesis"])
