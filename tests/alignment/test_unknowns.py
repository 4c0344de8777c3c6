"""The order of the unknowns: everything has one place, and of a pair's layout the right one."""

from dataclasses import fields

import numpy as np
import pytest

from retropole.alignment.unknowns import Unknowns
from retropole.base.systematic import (
    DEVICE,
    DEVICE_KINDS,
    MIN_ERROR_SIGMA,
    RADIUS,
    RING,
    ErrorModel,
    Layout,
    Sizes,
)

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


def test_among_more_bands_everything_keeps_its_name() -> None:
    more = tuple(np.union1d(bands, [-7, 2]) for bands in BANDS)
    others = Unknowns(more, 0, 0)
    place = UNKNOWNS.places_in(others)
    assert len(place) == len(np.unique(place)) == UNKNOWNS.kept
    for lidar, bands in enumerate(BANDS):
        np.testing.assert_array_equal(place[UNKNOWNS.pose(lidar)], others.pose(lidar))
        np.testing.assert_array_equal(place[UNKNOWNS.device(lidar)], others.device(lidar))
        for kind in range(RING):
            np.testing.assert_array_equal(
                place[UNKNOWNS.rings(lidar, kind, bands)], others.rings(lidar, kind, bands)
            )
    assert place[UNKNOWNS.radius] == others.radius
    np.testing.assert_array_equal(UNKNOWNS.places_in(UNKNOWNS), np.arange(UNKNOWNS.kept))


def test_groups_have_one_kind_of_one_lidar() -> None:
    groups = UNKNOWNS.groups()
    assert len(groups.label) == UNKNOWNS.errors
    np.testing.assert_array_equal(
        np.unique(groups.label[UNKNOWNS.device(0) - UNKNOWNS.poses]),
        np.arange(len({kind.field for kind in DEVICE_KINDS})),
    )
    for lidar, bands in enumerate(BANDS):
        for own, kind in zip(UNKNOWNS.device(lidar), DEVICE_KINDS, strict=True):
            group = groups.label[own - UNKNOWNS.poses]
            assert (groups.kinds[group], groups.sensors[group]) == (kind, lidar)
        for k, field in enumerate(("ring_range", "ring_elevation", "ring_azimuth")):
            group_of = np.unique(groups.label[UNKNOWNS.rings(lidar, k, bands) - UNKNOWNS.poses])
            assert len(group_of) == min(len(bands), 1)
            for group in group_of:
                assert (groups.kinds[group].field, groups.sensors[group]) == (field, lidar)
    assert groups.sensors[groups.label[UNKNOWNS.radius - UNKNOWNS.poses]] is None
    # Cosines and sines of one error have one size; nothing else of a LiDAR shares one.
    assert len(groups.kinds) == 3 * (len({kind.field for kind in DEVICE_KINDS}) + RING) + 1
    assert {kind.field for kind in groups.kinds} == {"radius", *(f.name for f in fields(Sizes))}


def test_sizes_known_beforehand_are_those_of_each_lidar() -> None:
    groups = UNKNOWNS.groups()
    sizes = [Sizes(zero=0.001), Sizes(zero=0.002), Sizes(zero=0.003, tape=0.0)]
    known = ErrorModel(tuple(sizes), 0.0007).sigmas(groups)
    own = zip(groups.kinds, groups.sensors, known, strict=True)
    by = {(kind.field, lidar): sigma for kind, lidar, sigma in own}
    assert [by["zero", i] for i in range(3)] == [0.001, 0.002, 0.003]
    assert by["radius", None] == 0.0007
    assert by["tape", 2] == MIN_ERROR_SIGMA
    assert len(UNKNOWNS.device(0)) == DEVICE
