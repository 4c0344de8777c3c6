import numpy as np
import pytest

from retropole.adjustment.masts import with_masts
from retropole.base import se3
from retropole.hypotheses.scans import SiteScans
from tests.surfaces.swaying import scan_on_mast, swaying

pytestmark = pytest.mark.full

SIGMA = float(np.radians(0.1))


def test_those_that_hang_on_one_mast_rest_as_one_and_others_stay() -> None:
    rng = np.random.default_rng(0)
    masts = swaying(10, SIGMA, 0.3, rng), swaying(10, SIGMA, 0.3, rng)
    poses = {k: se3.random(rng, 1.0) for k in range(4)}
    hang = (0, 1, 0, 0)
    scans = [scan_on_mast(masts[hang[k]], T, rng) for k, T in poses.items()]
    # Of the second placement only one is there.
    rows = tuple((scan, scan if k == 1 else None) for k, scan in enumerate(scans))
    found = with_masts(SiteScans(rows, np.zeros((4, 3))), poses).by_lidar
    for k, (first, second) in enumerate(found):
        assert first is not None
        assert first.sway is not None
        assert first.sway.is_shared == (hang[k] == 0)
        assert (first is scans[k]) == (hang[k] == 1)
        assert second is rows[k][1]
    again = with_masts(SiteScans(rows, np.zeros((4, 3))), {1: poses[1]}).by_lidar
    assert again == rows
