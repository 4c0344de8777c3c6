"""Poles, survey and scenes of a site in one problem: where it ends, and what its terms are."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.descent import (
    NARROWED,
    NARROWING,
    RefinementProblem,
    converge,
    minimise,
    scene_pairs,
)
from retropole.alignment.network import factor_of
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.se3 import relative_jacobian
from retropole.base.systematic import ErrorModel, sizes_of
from retropole.surfaces.patch_pairs import pair_patches
from tests.adjustment import geodetic
from tests.adjustment.adjusting import Steps
from tests.numeric import numeric_jacobian
from tests.tiers import first_of

pytestmark = pytest.mark.full


def problem_of(steps: Steps) -> RefinementProblem:
    network = steps.adjusted.network
    groups = network.unknowns.groups()
    model = ErrorModel(tuple(sizes_of(each.sensor) for each in steps.site.lidars), 0.0004)
    return RefinementProblem(factor_of(network), tuple(steps.scenes), groups, model.sigmas(groups))


def sigma_of(steps: Steps) -> Array:
    poses = steps.adjusted.network.unknowns.poses
    return np.sqrt(np.diag(steps.adjusted.end.inverse)[:poses]).reshape(-1, 6)


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_it_ends_at_the_same_poses_from_another_start(steps: Steps, seed: int) -> None:
    network, end = steps.adjusted.network, steps.adjusted.end
    rng = np.random.default_rng(seed)
    size = np.r_[np.full(3, 0.003), np.full(3, 0.02)]
    start = np.stack(
        [
            T if not free.any() else se3.retract(T, size * rng.normal(size=6))
            for T, free in zip(end.T, network.free.reshape(-1, 6), strict=True)
        ]
    )
    again = minimise(problem_of(steps), start)
    assert again.converged
    off = np.stack([se3.local(a, b) for a, b in zip(end.T, again.T, strict=True)])
    free = network.free.reshape(-1, 6)
    assert np.abs(off[free] / sigma_of(steps)[free]).max() < 0.1
    assert not off[~free].any()


def test_it_rests_only_where_the_search_has_narrowed(steps: Steps) -> None:
    problem, end = problem_of(steps), steps.adjusted.end
    covariance = 1e4 * end.inverse[: end.search.shape[0], : end.search.shape[0]]
    begun = converge(problem, replace(end, search=covariance, iterations=0), covariance)
    assert begun.converged
    # From its end the first step is small at once.
    least = 1 + np.log(NARROWED / 1e4) / np.log(NARROWING)
    assert least <= begun.iterations < least + 3
    free = steps.adjusted.network.free.reshape(-1, 6)
    off = np.stack([se3.local(a, b) for a, b in zip(end.T, begun.T, strict=True)])
    assert np.abs(off[free] / sigma_of(steps)[free]).max() < 0.1


def test_what_the_datum_holds_stays(steps: Steps, surveyed: Steps) -> None:
    np.testing.assert_array_equal(steps.adjusted.end.T[0], steps.adjusted.network.state.T[0])
    assert not steps.adjusted.end.inverse[:6].any()
    assert np.diag(surveyed.adjusted.end.inverse).min() > 0


def test_it_ends_where_nothing_slopes(surveyed: Steps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("retropole.adjustment.descent.STEP", 0.001)
    adjusted = surveyed.again(surveyed.datum)
    network, end = adjusted.network, adjusted.end
    poses = network.unknowns.poses
    factor = factor_of(network)
    steps = [se3.local(a, b) for a, b in zip(network.state.T, end.T, strict=True)]
    here = np.r_[np.concatenate(steps), end.errors]
    slope = factor.vector - factor.information @ here
    slope[poses:] -= end.precision * end.errors
    for term in end.scene:
        np.add.at(slope, term.place, term.slope(here, poses))
    # One step more would go by a thousandth of what each unknown is unsure of, or less.
    assert np.abs(end.inverse @ slope / np.sqrt(np.diag(end.inverse))).max() < 1e-3
    assert end.converged


def test_without_scenes_poles_and_survey_alone_decide() -> None:
    network = geodetic.network()
    rng = np.random.default_rng(1)
    network = geodetic.with_errors(network, geodetic.drawn_errors(network, rng))
    end, at = geodetic.adjusted(network)
    information, gradient = network.total()
    index = np.arange(network.unknowns.poses, network.unknowns.kept)
    information[index, index] += end.precision
    best = np.linalg.solve(information, gradient)
    poses = network.unknowns.poses
    found = np.concatenate([se3.local(a, b) for a, b in zip(network.state.T, end.T, strict=True)])
    np.testing.assert_allclose(found, best[:poses], atol=1e-8)
    # There the poses are steps from the answer.
    np.testing.assert_allclose(at.values, np.r_[np.zeros(poses), best[poses:]], atol=1e-8)
    assert not end.scene


def test_every_two_lidars_with_surfaces_are_compared(steps: Steps) -> None:
    assert [each.lidars for each in steps.scenes] == [(0, 1), (0, 2), (1, 2)]
    assert [term.lidars for term in steps.adjusted.end.scene] == [(0, 1), (0, 2), (1, 2)]
    some = [steps.patches[0], None, steps.patches[2]]
    assert [each.lidars for each in scene_pairs(some, range(3))] == [(0, 2)]
    assert not scene_pairs(steps.patches, [1])


def test_terms_are_derivatives_by_both_poses(steps: Steps) -> None:
    """Of the distances between patches, as far as the scene holds them."""
    end = steps.adjusted.end
    unknowns = steps.adjusted.network.unknowns
    for term, scene in zip(end.scene, steps.scenes, strict=True):
        i, j = term.lidars
        np.testing.assert_array_equal(
            term.place,
            np.r_[
                unknowns.pose(i), unknowns.pose(j), unknowns.of_layout(scene.sets.layout, (i, j))
            ],
        )
        T_i, T_j = end.about[i], end.about[j]
        tight = 1e-12 * np.eye(6)

        def residuals(step: Array, T_i: Array = T_i, T_j: Array = T_j) -> Array:
            moved = se3.inverse(se3.retract(T_i, step[:6])) @ se3.retract(T_j, step[6:])
            found = pair_patches(scene.sets, moved, tight, False)  # noqa: B023
            assert found is not None
            return found.residuals

        here = pair_patches(scene.sets, se3.inverse(T_i) @ T_j, tight, False)
        assert here is not None
        J = here.jacobian @ relative_jacobian(T_i, T_j)
        error = np.abs(numeric_jacobian(residuals, 12, 1e-8) - J)[np.abs(here.residuals) < 0.005]
        assert np.all(np.median(error, axis=0) < 2e-2 * np.abs(J).max(axis=0).clip(1.0))
        # Moved alike, both LiDARs see what they saw: the rows say nothing of that.
        arm = T_j[:3, 3] - T_i[:3, 3]
        shift = np.r_[np.zeros(3), 1.0, 2.0, 3.0]
        turn = np.array([0.1, -0.2, 0.3])
        alike = np.r_[shift + np.r_[turn, 0, 0, 0], shift + np.r_[turn, np.cross(turn, arm)]]
        np.testing.assert_allclose(
            term.by_step(np.r_[alike, np.zeros(len(term.place) - 12)]), 0.0, atol=1e-4
        )
        rows = term.by_step(np.eye(len(term.place)))
        np.testing.assert_allclose(term.information, rows.T @ rows, rtol=1e-6, atol=1.0)
