"""Which of two poses the surfaces prefer."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from retropole.adjustment.refinement import Refinement
from retropole.alignment.adjustment import BeamAlignment
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from retropole.base.errors import Refusal
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.patches import Patches, surface_patches
from retropole.verdict.preference import MIN_SIGMAS, check_near_poles, preferences
from tests.tiers import first_of

TILT = np.r_[np.radians(0.3), 0.0, 0, 0, 0, 0]
LIFT = np.r_[0.0, 0, 0, 0, 0, 0.03]


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.mark.parametrize("off", [TILT, LIFT])
@pytest.mark.full
def test_the_truth_is_preferred_to_a_movement_that_matters(
    street: SimulatedPair, off: Array
) -> None:
    T = street.T_target_source
    there, back = (se3.retract(T, sign * off) for sign in (1.0, -1.0))
    found = preferences(street.target, street.source, T, (there, back))
    assert min(found) > 4.0
    assert preferences(street.target, street.source, there, (T,))[0] == pytest.approx(-found[0])


@pytest.mark.full
def test_what_is_below_the_noise_is_not_preferred(street: SimulatedPair) -> None:
    T = street.T_target_source
    near = se3.retract(T, 0.01 * LIFT)
    assert abs(preferences(street.target, street.source, T, (near,))[0]) < 4.0
    assert preferences(street.target, street.source, T, (T,)) == (0.0,)


def test_clouds_without_surfaces_do_not_tell() -> None:
    cloud = PointCloud(np.random.default_rng(0).normal(size=(8, 3)))
    assert preferences(cloud, cloud, np.eye(4), (se3.retract(np.eye(4), LIFT),)) == (0.0,)


def answers(
    T: Array,
    T_poles: Array,
    pair: SimulatedPair,
    corrected: tuple[Patches, Patches] | None = None,
) -> tuple[BeamAlignment, Refinement]:
    """What `check_near_poles` asks of an answer: both poses, and where the poles stand."""
    centres = np.array([pole.centre for pole in pair.poles])
    poles = se3.apply(se3.inverse(pair.T_world_target), centres)
    aligned = SimpleNamespace(pose=PoseEstimate(T_poles, None, 0.0), axis_points=poles)
    surfaces = surface_patches(pair.target), surface_patches(pair.source)
    refined = SimpleNamespace(
        pose=PoseEstimate(T, None, 0.0), surfaces=surfaces, corrected=corrected or surfaces
    )
    return cast(BeamAlignment, aligned), cast(Refinement, refined)


@pytest.mark.parametrize("scene", first_of(["street", "square", "kerb"]))
@pytest.mark.full
def test_surfaces_near_the_poles_deny_a_pose_that_lifts_them(scene: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(1))
    T = pair.T_target_source
    off = se3.retract(T, np.array([0.008, 0.006, 0.0, 0.0, 0.0, 0.06]))
    slightly = se3.retract(T, np.array([0.0002, 0.0002, 0.0, 0.0, 0.0, 0.002]))
    with pytest.raises(Refusal) as refused:
        check_near_poles(*answers(off, slightly, pair))
    assert refused.value.code == "scene_contradicts"
    assert float(refused.value.values["sigmas"]) > MIN_SIGMAS
    check_near_poles(*answers(T, off, pair))
    check_near_poles(*answers(slightly, T, pair))
    check_near_poles(answers(T, T, pair)[0], None)
    # What the errors of the LiDARs explain conflicts with nothing.
    target, source = surface_patches(pair.target), surface_patches(pair.source)
    lowered = se3.apply(se3.inverse(off), se3.apply(slightly, source.centres))
    explained = target, replace(source, centres=lowered)
    check_near_poles(*answers(off, slightly, pair, explained))
