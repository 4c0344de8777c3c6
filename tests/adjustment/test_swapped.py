"""Recordings that are another's: named, and nothing said of those that are not."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.swapped import (
    _share_poles,
    _swapped,
    check_places,
    check_swapped,
    support_of,
)
from retropole.base.description import Site
from retropole.base.errors import Refusal
from retropole.hypotheses.scans import Views
from retropole.pipeline import calibrate_site
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps, made, made_wrong, with_lidar

pytestmark = pytest.mark.full


def swapped(site: Site, one: tuple[int, int], other: tuple[int, int]) -> Site:
    clouds = [list(lidar.clouds) for lidar in site.lidars]
    (i, p), (j, q) = one, other
    clouds[i][p], clouds[j][q] = clouds[j][q], clouds[i][p]
    for lidar, row in enumerate(clouds):
        site = with_lidar(site, lidar, clouds=tuple(row))
    return site


def test_two_lidars_files_of_one_placement_are_named(simulated: SimulatedSite) -> None:
    found = calibrate_site(swapped(simulated.as_site(), (0, 1), (2, 1)))
    assert found.status == "refused"
    (reason,) = found.reasons
    assert reason.code == "recordings_exchanged"
    assert {"posts-1", "posts-3"} <= {str(reason.values[k])[:7] for k in ("first", "second")}
    assert not found.lidars
    assert found.covariance is None


def test_one_lidars_files_of_two_placements_are_named(simulated: SimulatedSite) -> None:
    found = calibrate_site(swapped(simulated.as_site(), (1, 0), (1, 1)))
    assert found.status == "refused"
    (reason,) = found.reasons
    assert reason.code == "recordings_exchanged"
    assert reason.values["first"] == "posts-2 in placement 1"
    assert reason.values["second"] == "posts-2 in placement 2"


@pytest.mark.parametrize("seed", [1])
def test_simulated_exchanges_are_named(seed: int) -> None:
    simulated, blunder = made_wrong("files", seed)
    found = calibrate_site(simulated.as_site())
    (reason,) = found.reasons
    assert reason.code == "recordings_exchanged"
    for lidar in blunder.lidars:
        assert simulated.names[lidar] in reason.message
    for placement in blunder.placements:
        assert f"placement {placement + 1}" in reason.message


def test_a_lidar_that_moved_is_named(simulated: SimulatedSite) -> None:
    site = simulated.as_site()
    other = made(seed=5).as_site().lidars[1].clouds[1]
    found = calibrate_site(with_lidar(site, 1, clouds=(site.lidars[1].clouds[0], other)))
    assert found.status == "refused"
    assert found.reasons[0].code == "lidar_moved"
    assert found.reasons[0].values["lidar"] == "posts-2"


def test_sound_recordings_are_not_conflicting(steps: Steps) -> None:
    check_places(steps.site, steps.views)
    best = steps.choices.best
    check_swapped(steps.site, steps.scans, steps.views, steps.pairs, best, steps.at)
    support = support_of(best, steps.scans, steps.pairs, steps.at)
    assert support.met == support.possible
    assert set(support.possible) == {(i, p) for i in range(3) for p in range(2)}
    assert not support.unsupported()


def test_recordings_in_their_own_place_show_poles_where_others_see_them(steps: Steps) -> None:
    """Even where no pair of LiDARs has scenes that overlap enough to support a recording."""
    one, other = (1, 0), (1, 1)
    changed = replace(steps.scans, by_lidar=_swapped(steps.scans.by_lidar, one, other))
    best, radius = steps.choices.best, steps.site.radius
    assert _share_poles(steps.scans, best, radius, one, other)
    assert not _share_poles(changed, best, radius, one, other)


def test_a_placement_that_shows_another_place_is_reported(steps: Steps) -> None:
    rows = [list(row) for row in steps.views.every]
    rows[0][1] = steps.views.every[2][1]
    with pytest.raises(Refusal) as refused:
        check_places(steps.site, Views(tuple(map(tuple, rows))))
    assert refused.value.code == "lidar_moved"
    assert np.all([word in refused.value.message for word in ("posts-1", "1", "2")])
