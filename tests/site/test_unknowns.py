"""The order of the unknowns: everything has one place, and of a pair's layout the right one."""

import numpy as np
import pytest

from retropole.base.systematic import (
    DEVICE,
    MIN_ERROR_SIGMA,
    RADIUS,
    RING,
    Layout,
    Sizes,
    groups_of,
)
from retropole.site.unknowns import Unknowns, known_sigmas

BANDS = (np.array([-9, -3, 0, 4]), np.array([], dtype=np.int64), np.array([-3, 2]))
UNKNOWNS = Unknowns(BANDS, axes=5, control=2)


def test_every_unknown_has_one_place() -> None:
    places = [UNKNOWNS.pose(i) for i in range(3)]
    places += [UNKNOWNS.device(i) for i in range(3)]
    places += [UNKNOWNS.rings(i, kind, BANDS[i]) for i in range(3) for kind in range(RING)]
    places += [np.array([UNKNOWNS.radius]), UNKNOWNS.axis(np.arange(5))]
    places += [UNKNOWNS.control_point(q) for q in range(2)]
    np.testing.assert_array_equal(np.sort(np.concatenate(places)), np.arange(UNKNOWNS.size))
    assert UNKNOWNS.kept == UNKNOWNS.poses + UNKNOWNS.errors
    assert UNKNOWNS.axis(np.array([0]))[0] == UNKNOWNS.kept


def test_single_bands_and_axes_are_where_they_are_among_all() -> None:
    whole = UNKNOWNS.rings(0, 1, BANDS[0])
    np.testing.assert_array_equal(UNKNOWNS.rings(0, 1, np.array([-3, 4])), whole[[1, 3]])
    whole = UNKNOWNS.axis(np.arange(5)).reshape(5, 4)
    np.testing.assert_array_equal(UNKNOWNS.axis(np.array([4, 1])), whole[[4, 1]].reshape(-1))


@pytest.mark.parametrize("lidars", [(0, 2), (2, 0), (None, 2)])
def test_a_pairs_errors_go_to_those_of_its_lidars(lidars: tuple[int | None, int]) -> None:
    target = np.array([], dtype=np.int64) if lidars[0] is None else np.array([-3])
    layout = Layout((target, np.array([-3])))
    place = UNKNOWNS.of_layout(layout, lidars)
    for side, lidar in enumerate(lidars):
        if lidar is None:
            assert set(place[layout.device(side)]) == {-1}
            continue
        np.testing.assert_array_equal(place[layout.device(side)], UNKNOWNS.device(lidar))
        for kind in range(RING):
            np.testing.assert_array_equal(
                place[layout.rings(side, kind)], UNKNOWNS.rings(lidar, kind, np.array([-3]))
            )
    assert place[RADIUS] == UNKNOWNS.radius
    used = place[place >= 0]
    assert len(np.unique(used)) == len(used)


def test_groups_are_those_of_a_pair_where_there_are_two_lidars() -> None:
    """Equal kinds have one size, and each LiDAR its own."""
    bands = (np.array([-2, 1]), np.array([0, 3, 5]))
    site, pair = Unknowns(bands, 0, 0), groups_of(Layout(bands))
    groups = site.groups()
    place = site.of_layout(Layout(bands), (0, 1)) - site.poses
    assert len(groups.kinds) == len(pair.kinds)
    for here, there in zip(groups.label[place], pair.label, strict=True):
        assert groups.kinds[here] == pair.kinds[there]
        assert groups.sensors[here] == pair.sensors[there]
    # One group here is one there.
    assert len(set(zip(groups.label[place], pair.label, strict=True))) == len(pair.kinds)


def test_sizes_known_beforehand_are_those_of_each_lidar() -> None:
    groups = UNKNOWNS.groups()
    sizes = [Sizes(zero=0.001), Sizes(zero=0.002), Sizes(zero=0.003, tape=0.0)]
    known = known_sigmas(groups, sizes, 0.0007)
    own = zip(groups.kinds, groups.sensors, known, strict=True)
    by = {(kind.field, lidar): sigma for kind, lidar, sigma in own}
    assert [by["zero", i] for i in range(3)] == [0.001, 0.002, 0.003]
    assert by["radius", None] == 0.0007
    assert by["tape", 2] == MIN_ERROR_SIGMA
    assert len(UNKNOWNS.device(0)) == DEVICE
