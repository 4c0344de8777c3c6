"""Planar surfaces: laws of the whole method, refusals, corridors and a recording."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.io import read_cloud
from retropole.simulation import SimulatedPair, simulate_pair
from studies.planes import poses
from studies.planes.planes import planar_surfaces
from tests.paths import SHARED
from tests.studies.planes.staged import ROOM, assert_close, box
from tests.tiers import first_of

pytestmark = pytest.mark.full

DATA = SHARED / "planes_top_front"


@pytest.fixture(scope="module")
def corridor() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(1))


@pytest.mark.parametrize("faces", first_of(["x", "xz"]))
@pytest.mark.parametrize("side", first_of([0, 1]))
def test_fewer_than_three_independent_planes_are_refused(faces: str, side: int) -> None:
    rng = np.random.default_rng(5)
    clouds = [box(rng, ROOM, "xyz"), box(rng, ROOM, "xyz")]
    clouds[side] = box(rng, ROOM, faces)
    with pytest.raises(Refusal) as refusal:
        planar_surfaces(clouds[0], clouds[1], rng)
    assert refusal.value.code == "unmatched"
    assert refusal.value.values["lidar"] == ("target", "source")[side]


def test_planes_with_other_angles_are_refused() -> None:
    rng = np.random.default_rng(6)
    room = box(rng, ROOM, "xyz")
    skew = np.array([[1.0, 0.3, 0], [0, 1, 0.4], [0.3, 0, 1]])
    with pytest.raises(Refusal) as refusal:
        planar_surfaces(room, PointCloud(room.xyz @ skew.T), rng)
    assert refusal.value.code == "unmatched"


def test_a_room_that_a_rotation_maps_onto_itself_is_refused() -> None:
    rng = np.random.default_rng(7)
    clouds = [box(rng, ROOM, "xyz") for _ in range(2)]
    with pytest.raises(Refusal) as refusal:
        planar_surfaces(clouds[0], clouds[1], rng)
    assert refusal.value.code == "ambiguous"


def test_a_refinement_that_still_moves_is_refused(
    corridor: SimulatedPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses, "SMALL_REFINE_STEP", 0.0)
    with pytest.raises(Refusal) as refusal:
        planar_surfaces(corridor.target, corridor.source, np.random.default_rng(0))
    assert refusal.value.code == "not_converged"


def test_no_points_are_refused() -> None:
    empty = PointCloud(np.zeros((0, 3)))
    with pytest.raises(Refusal) as refusal:
        planar_surfaces(empty, empty, np.random.default_rng(0))
    assert refusal.value.code == "unmatched"


def test_transforming_both_clouds_transforms_the_answer(corridor: SimulatedPair) -> None:
    rng = np.random.default_rng(8)
    A, B = se3.random(rng), se3.random(rng)
    target, source = corridor.target.transformed(A), corridor.source.transformed(B)
    found = planar_surfaces(target, source, rng)
    T = se3.inverse(A) @ found.T_target_source @ B
    assert_close(T, corridor.T_target_source, 0.3, 0.03)
    assert found.covariance is None
    assert 0 < found.rms < 0.05


def test_swapping_the_clouds_inverts_the_answer(corridor: SimulatedPair) -> None:
    there = planar_surfaces(corridor.target, corridor.source, np.random.default_rng(0))
    back = planar_surfaces(corridor.source, corridor.target, np.random.default_rng(1))
    # Each draws its own planes, so they agree as well as planes that are drawn again.
    assert_close(back.T_target_source @ there.T_target_source, np.eye(4), 0.2, 0.02)


def test_equal_generators_give_equal_answers(corridor: SimulatedPair) -> None:
    one, two = (
        planar_surfaces(corridor.target, corridor.source, np.random.default_rng(3))
        for _ in range(2)
    )
    np.testing.assert_array_equal(one.T_target_source, two.T_target_source)


@pytest.mark.parametrize("seed", first_of([0, 2, 9]))
def test_corridors_are_found(seed: int) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(seed))
    found = planar_surfaces(pair.target, pair.source, np.random.default_rng(seed))
    assert_close(found.T_target_source, pair.T_target_source, 1.0, 0.1)


@pytest.mark.nightly
def test_corridors_are_found_or_refused_but_never_wrong() -> None:
    refused = 0
    for seed in range(100, 130):
        pair = simulate_pair("corridor", np.random.default_rng(seed))
        try:
            found = planar_surfaces(pair.target, pair.source, np.random.default_rng(seed))
        except Refusal:
            refused += 1
            continue
        assert_close(found.T_target_source, pair.T_target_source, 1.0, 0.1)
    assert refused <= 6


@pytest.mark.skipif(not DATA.exists(), reason="no folder ../shared/data")
@pytest.mark.parametrize("swapped", [False, True])
def test_the_example_pair_of_the_method_itself(swapped: bool) -> None:
    """Its reference, eps_opt.csv, holds two matrices: the reference's own, and data to reference;
    it is good to 0.8° and 8 cm.
    """
    T = np.loadtxt(DATA / "eps_opt.csv", delimiter=",")[4:]
    target, source = (read_cloud(DATA / f"{name}_filter.pcd") for name in ("ref", "data"))
    if swapped:
        target, source, T = source, target, se3.inverse(T)
    for seed in range(3):
        found = planar_surfaces(target, source, np.random.default_rng(seed))
        assert_close(found.T_target_source, T, 1.5, 0.15)
