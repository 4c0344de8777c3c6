"""Pairs: their truth is true, both LiDARs see every pole, and equal generators give equal pairs."""

import click
import numpy as np
import pytest

import retropole as rp
from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.errors import UsageError
from retropole.cli.simulate import simulate
from retropole.simulation import (
    EXACT,
    FIELD,
    NOISE_MODELS,
    SCENES,
    TYPICAL,
    NoiseModel,
    SimulatedPair,
    SimulationError,
    place_again,
    simulate_pair,
)
from retropole.simulation.pairs import MIN_RETURNS
from retropole.simulation.scenes import SURROUNDINGS
from tests.simulation.surfaces import distance_from
from tests.tiers import first_of

pytestmark = pytest.mark.full


def assert_exact(pair: SimulatedPair) -> None:
    """Check that the points of an exact pair lie on the surfaces of their labels."""
    for cloud, labels, T in (
        (pair.target, pair.labels[0], pair.T_world_target),
        (pair.source, pair.labels[1], pair.T_world_source),
    ):
        world = se3.apply(T, cloud.xyz)
        for k, surface in enumerate(pair.surfaces):
            assert distance_from(surface, world[labels == k]).max(initial=0.0) < 1e-8
    np.testing.assert_allclose(
        pair.T_world_target @ pair.T_target_source, pair.T_world_source, atol=1e-12
    )


@pytest.mark.parametrize("scene", SCENES)
def test_exact_scans_lie_on_their_surfaces(scene: str) -> None:
    assert_exact(simulate_pair(scene, np.random.default_rng(2), noise=EXACT))


@pytest.mark.parametrize("scene", sorted(SURROUNDINGS))
def test_scenes_are_what_was_requested(scene: str) -> None:
    for seed in range(5):
        pair = simulate_pair(scene, np.random.default_rng(seed), poles=3)
        axes = np.array([pole.axis for pole in pair.poles])
        i, j = np.triu_indices(3, 1)
        angles = np.arccos(np.abs(np.sum(axes[i] * axes[j], axis=1)))
        assert angles.min() >= np.radians(15)
        assert min(min(counts) for counts in pair.returns_on_poles) >= MIN_RETURNS
        assert pair.sees_every_pole
        assert pair.surfaces == (*pair.surroundings, *pair.poles)


def test_equal_generators_give_equal_pairs() -> None:
    one, two = (simulate_pair("street", np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(one.target.xyz, two.target.xyz)
    np.testing.assert_array_equal(one.T_target_source, two.T_target_source)
    other = simulate_pair("street", np.random.default_rng(5))
    assert not np.array_equal(one.T_target_source, other.T_target_source)


@pytest.mark.parametrize("scene", first_of(SCENES))
def test_the_arrangement_of_a_seed_is_the_same_under_every_noise(scene: str) -> None:
    for seed in range(2):
        one, *others = (
            simulate_pair(scene, np.random.default_rng(seed), noise=noise)
            for noise in NOISE_MODELS.values()
        )
        for other in others:
            np.testing.assert_array_equal(other.T_world_target, one.T_world_target)
            np.testing.assert_array_equal(other.T_world_source, one.T_world_source)
            for ours, theirs in zip(one.surfaces, other.surfaces, strict=True):
                np.testing.assert_array_equal(ours.centre, theirs.centre)


def test_the_field_is_simulated_with_all_its_poles_in_view() -> None:
    pair = simulate_pair("street", np.random.default_rng(3), noise=FIELD)
    assert pair.sees_every_pole
    assert pair.noise == FIELD
    assert np.any(pair.labels[0] == -1)
    again = record_again(pair, np.random.default_rng(4))
    assert (again.noise, again.devices) == (FIELD, pair.devices)
    calm = record_again(pair, np.random.default_rng(4), noise=EXACT)
    assert calm.devices == pair.devices
    assert calm.labels[0].min() >= 0


def test_noise_that_hides_every_pole_is_named() -> None:
    with pytest.raises(SimulationError, match="hides"):
        simulate_pair("bare", np.random.default_rng(0), noise=NoiseModel(dropout=0.999))


def test_nuisances_have_names() -> None:
    plain, field = (rp.simulate("bare", 1, nuisances=name) for name in ("none", "field"))
    assert (plain.noise, field.noise) == (EXACT, FIELD)
    assert rp.simulate("bare", 1).noise == TYPICAL
    with pytest.raises(UsageError, match="typical"):
        rp.simulate("bare", 1, nuisances="rain")
    offered = next(each.type for each in simulate.params if each.name == "nuisances")
    assert isinstance(offered, click.Choice)
    assert set(offered.choices) == set(NOISE_MODELS)


def test_every_frame_is_labelled() -> None:
    pair = simulate_pair("street", np.random.default_rng(1), frames=3)
    assert pair.target.frame is not None
    assert np.unique(pair.target.frame).tolist() == [0, 1, 2]
    assert len(pair.labels[0]) == len(pair.target)


def test_wide_beams_return_from_the_edges_of_poles() -> None:
    counts = [
        simulate_pair(
            "paper",
            np.random.default_rng(6),
            noise=NoiseModel(0, 0, 0, beam_width=wide, ring_bias=0, retro_bias=0),
        ).returns_on_poles
        for wide in (False, True)
    ]
    assert np.all(np.array(counts[1]) > np.array(counts[0]))


def test_a_rosette_has_no_rings() -> None:
    pair = simulate_pair("bare", np.random.default_rng(1), sensor_source="Mid-360", frames=20)
    assert pair.source.ring is None
    assert pair.target.ring is not None


@pytest.mark.parametrize("scene", ["corridor", "paper"])
def test_poles_in_other_places_leave_all_else_as_it_was(scene: str) -> None:
    rng = np.random.default_rng(7)
    pair = simulate_pair(scene, rng, noise=EXACT)
    again = place_again(pair, rng, noise=EXACT)
    assert_exact(again)
    assert again.sees_every_pole
    assert again.surroundings == pair.surroundings
    np.testing.assert_array_equal(again.T_target_source, pair.T_target_source)
    for pole, other in zip(pair.poles, again.poles, strict=True):
        assert np.linalg.norm(pole.centre - other.centre) > 1e-3
        assert pole.radius == other.radius


def test_a_second_recording_is_of_the_same_place() -> None:
    rng, step = np.random.default_rng(8), np.array([0.01, 0.0, 0.02, 0.1, 0.0, -0.05])
    pair = simulate_pair("harbor", rng, noise=EXACT)
    still = record_again(pair, rng, noise=EXACT)
    np.testing.assert_allclose(still.T_target_source, pair.T_target_source, atol=1e-12)
    assert still.poles == pair.poles
    moved = record_again(pair, rng, moved=step, poles=False, noise=EXACT)
    assert_exact(moved)
    assert moved.surfaces == pair.surroundings
    np.testing.assert_allclose(
        se3.local(pair.T_target_source, moved.T_target_source), step, atol=1e-9
    )


def test_impossible_demands_are_named() -> None:
    with pytest.raises(UsageError, match="street"):
        simulate_pair("moon", np.random.default_rng(0))
    with pytest.raises(UsageError, match="no sensor"):
        simulate_pair("street", np.random.default_rng(0), sensor_target="eye")
    with pytest.raises(SimulationError, match="2 poles"):
        simulate_pair("street", np.random.default_rng(0), min_pole_angle=float(np.radians(80)))


def test_the_command_offers_every_scene() -> None:
    offered = next(each.type for each in simulate.params if each.name == "scene")
    assert isinstance(offered, click.Choice)
    assert set(offered.choices) == set(SCENES)
