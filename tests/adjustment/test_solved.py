"""What each placement does: as leaving it out really does, to first order."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.datum import without_poles
from retropole.adjustment.descent import SceneTerm
from retropole.adjustment.solved import (
    labels_of_places,
    parts_of_surfaces,
    residuals_of,
    without_placements,
)
from retropole.alignment.certainty import FLOOR, Part, budget_of, joint_covariance
from retropole.alignment.survey import Surveyed, SurveyedEnd
from retropole.base import se3
from retropole.base.datatypes import Array, IntArray
from retropole.base.se3 import joint_of, relative
from retropole.base.uncertainty import predicted_error
from retropole.pipeline import Options, calibrate
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps


@pytest.mark.full
def test_it_is_what_leaving_a_placement_out_does(steps: Steps) -> None:
    adjusted = steps.adjusted
    found = list(without_placements(adjusted.network, adjusted.end, 2))
    assert [one.placement for one in found] == [0, 1]
    sigma = np.sqrt(np.diag(adjusted.covariance)).reshape(-1, 6)[1:]
    for one in found:
        gone = {k for k, p in enumerate(steps.datum.poles) if p.placement == one.placement}
        left = steps.again(without_poles(steps.datum, gone))
        moved = [se3.local(a, b) for a, b in zip(adjusted.end.T, left.end.T, strict=True)]
        turned, shifted = (
            max(float(np.linalg.norm(step[part])) for step in moved)
            for part in (slice(3), slice(3, 6))
        )
        assert one.rotation is not None
        assert one.translation is not None
        # Noise and weights change too: by less than half of what poses are unsure of.
        assert abs(one.rotation - turned) < 0.5 * sigma[:, :3].max()
        assert abs(one.translation - shifted) < 0.5 * sigma[:, 3:].max()


@pytest.mark.full
def test_a_site_with_one_placement_has_none_to_leave_out(pair_steps: Steps) -> None:
    adjusted = pair_steps.adjusted
    assert not list(without_placements(adjusted.network, adjusted.end, 1))


@pytest.mark.full
def test_what_rests_on_one_placement_alone_is_reported(steps: Steps) -> None:
    """Without it there is no pose: neither scenes nor other poles hold it."""
    poles = [k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1]
    alone = without_poles(steps.datum, set(poles))
    bare = replace(steps, scenes=[]).again(alone)
    first, second = without_placements(bare.network, bare.end, 2)
    assert first.rotation is None
    assert first.lidar is None
    assert second.translation == pytest.approx(0.0, abs=1e-4)


@pytest.mark.full
def test_one_surveyed_end_of_a_pole_that_no_return_is_left_of(steps: Steps) -> None:
    """A line of which one point alone is known keeps the equations solvable."""
    k = next(k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1)
    end = SurveyedEnd("foot", k, steps.datum.poles[k].extent[0], 0.05)
    known = replace(steps.datum, surveyed=Surveyed(ends=(end,)))
    adjusted = steps.again(known)
    first, second = without_placements(adjusted.network, adjusted.end, 2)
    assert first.placement == 0
    assert second.placement == 1


@pytest.mark.full
def test_it_is_the_sum_of_all_parts(steps: Steps) -> None:
    adjusted = steps.adjusted
    found = joint_covariance(adjusted.parts)
    np.testing.assert_array_equal(found, adjusted.covariance)
    np.testing.assert_allclose(found, found.T)
    assert not found[:6].any()
    assert np.linalg.eigvalsh(found[6:, 6:])[0] > 0
    assert np.linalg.eigvalsh(found)[0] > -1e-15


@pytest.mark.full
def test_shares_of_a_budget_are_those_of_the_variance(surveyed: Steps) -> None:
    names = [each.name for each in surveyed.site.lidars]
    for lidar in range(3):
        budget = budget_of(surveyed.adjusted.parts, lidar, names)
        shares = [entry.share_at_30m for entry in budget]
        assert shares == sorted(shares, reverse=True)
        assert sum(shares) == pytest.approx(1.0)
        assert len({entry.name for entry in budget}) == len(budget)
        others = [entry.share_at_30m for entry in budget if names[lidar - 1] in entry.name]
        assert any(share > 0 for share in others)


@pytest.mark.full
def test_the_lidar_whose_frame_it_is_has_no_budget(steps: Steps) -> None:
    names = [each.name for each in steps.site.lidars]
    assert budget_of(steps.adjusted.parts, 0, names) == ()


def part_at(parts: Sequence[Part], name: str, lidar: int | None) -> float:
    """1 σ at 30 m that a part leaves in the pose of the second of two LiDARs."""
    root = np.concatenate(
        [part.root[6:] for part in parts if part.name == name and part.lidar == lidar], axis=1
    )
    return predicted_error(root @ root.T, (30.0,))[0].sigma_m


@pytest.mark.full
def test_parts_of_two_lidars_are_those_of_the_pair(
    pair_site: SimulatedSite, pair_steps: Steps
) -> None:
    (target,), (source,) = pair_site.clouds
    assert target is not None
    assert source is not None
    sensors = (pair_site.sensors[0], pair_site.sensors[1])
    alone = calibrate(target, source, options=Options(sensors=sensors))
    assert alone.uncertainty is not None
    assert alone.covariance is not None
    parts = pair_steps.adjusted.parts
    whole = predicted_error(alone.covariance, (30.0,))[0].sigma_m
    checked = 0
    for entry in alone.uncertainty.budget:
        name = entry.name
        if name == "scatter of the poles' returns":
            name += " and of the survey"
        lidar = None if entry.sensor is None else ("target", "source").index(entry.sensor)
        expected = np.sqrt(entry.share_at_30m) * whole
        assert part_at(parts, name, lidar) == pytest.approx(expected, rel=5e-2, abs=1e-5), name
        checked += 1
    assert checked > 20


def jackknife(rows: Array, weights: Array, residuals: Array, label: IntArray) -> Array:
    """How far a weighted mean of a model goes without each place in turn."""
    moves = []
    for place in range(int(label.max()) + 1):
        left = label != place
        H = rows[left].T @ (weights[left, None] * rows[left])
        g = rows[left].T @ (weights * residuals)[left]
        moves.append(-np.linalg.solve(H, g))
    return np.array(moves)


@pytest.mark.full
def test_the_jackknife_is_that_of_leaving_out_each_place(steps: Steps) -> None:
    """Where scenes alone decide, and no error of a LiDAR has a part in them."""
    adjusted = steps.adjusted
    end = replace(adjusted.end, scene=tuple(map(holding_all, adjusted.end.scene)))
    poses = adjusted.network.unknowns.poses
    information = np.zeros_like(end.inverse)
    for term in end.scene:
        own = np.flatnonzero(term.place < poses)
        by = term.information[np.ix_(own, own)]
        information[np.ix_(term.place[own], term.place[own])] += by
    # The first LiDAR is held, errors have no part.
    inverse = np.zeros_like(information)
    inverse[6:poses, 6:poses] = np.linalg.inv(information[6:poses, 6:poses])
    rows = np.zeros((sum(len(term.weighed.weights) for term in end.scene), poses))
    first = 0
    residuals = []
    for term in end.scene:
        rows[first : first + len(term.weighed.weights), term.place[:12]] = of_poses(term)
        first += len(term.weighed.weights)
        residuals.append(term.weighed.residuals / root_weights(term))
    weights = np.concatenate([term.weighed.weights for term in end.scene])
    # Freed of what they would move all poses by.
    joined = np.concatenate(residuals)
    best = inverse[6:poses, 6:poses] @ rows[:, 6:].T @ (weights * joined)
    freed = joined - rows[:, 6:] @ best
    at = [np.asarray(each) for each in np.split(freed, np.cumsum([len(r) for r in residuals])[:-1])]
    fixed = [replace_residuals(term, values) for term, values in zip(end.scene, at, strict=True)]
    bare = replace(end, errors=np.zeros_like(end.errors), inverse=inverse, scene=tuple(fixed))
    found = parts_of_surfaces(bare)[0].root
    expected = jackknife(rows[:, 6:], weights, freed, np.concatenate(labels_of_places(end)))
    scale = np.linalg.norm(found[6:]) / np.linalg.norm(expected)
    assert 1.0 <= scale < 1.5
    np.testing.assert_allclose(found[6:].T / scale, expected, rtol=1e-3, atol=1e-9)


def holding_all(term: SceneTerm) -> SceneTerm:
    """A term of which nothing is left to the poles."""
    whole = term.weighed
    return replace(term, weighed=replace(whole, left=np.zeros_like(whole.left)))


def replace_residuals(term: SceneTerm, residuals: Array) -> SceneTerm:
    pairs = replace(term.pairs, residuals=residuals)
    return replace(term, weighed=replace(term.weighed, pairs=pairs))


def of_poses(term: SceneTerm) -> Array:
    """(P, 12) derivative of the residuals, metres, by both poses."""
    rows = term.by_step(np.eye(len(term.place))[:, :12])
    return rows / root_weights(term)[:, None]


def root_weights(term: SceneTerm) -> Array:
    return np.sqrt(np.maximum(term.weighed.weights, 1e-300))


@pytest.mark.full
def test_residuals_are_freed_of_the_errors_that_were_found(steps: Steps) -> None:
    end = steps.adjusted.end
    before = after = 0.0
    for term in end.scene:
        before += float(term.weighed.weights @ term.pairs.residuals**2)
        after += float(np.sum(residuals_of(term, end) ** 2))
    assert after < before


@pytest.mark.full
def test_what_no_model_names_is_each_lidars_own(steps: Steps, surveyed: Steps) -> None:
    """Between two LiDARs it is that of a pair, whatever the datum is."""
    own = [
        joint_covariance([part for part in each.adjusted.parts if part.name == FLOOR])
        for each in (steps, surveyed)
    ]
    T = [each.adjusted.end.T for each in (steps, surveyed)]
    for i, j in ((0, 1), (1, 2)):
        one, other = (
            relative(poses[i], poses[j], joint_of(floors, i, j)).covariance
            for poses, floors in zip(T, own, strict=True)
        )
        np.testing.assert_allclose(one, other, rtol=0.02, atol=1e-12)
        turned = np.diag(one)[:3]
        np.testing.assert_allclose(turned, np.radians(0.003) ** 2)


@pytest.mark.full
def test_two_lidars_are_surer_of_each_other_than_of_the_site(surveyed: Steps) -> None:
    """What they have in common cancels: the frame is shifted by the survey's errors as a whole."""
    adjusted = surveyed.adjusted
    found = relative(adjusted.end.T[1], adjusted.end.T[2], joint_of(adjusted.covariance, 1, 2))
    independent = adjusted.covariance.copy()
    independent[6:12, 12:18] = independent[12:18, 6:12] = 0.0
    alone = relative(adjusted.end.T[1], adjusted.end.T[2], joint_of(independent, 1, 2))
    for ranges in (10.0, 30.0):
        joint = predicted_error(found.covariance, (ranges,))[0].sigma_m
        assert joint < predicted_error(alone.covariance, (ranges,))[0].sigma_m
    assert se3.difference(found.T_i_j, alone.T_i_j).translation == 0.0
