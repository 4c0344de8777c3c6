"""The scene moves a hypothesis as far as the poles allow, and no further."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from retropole.alignment.point_to_line import point_line_residuals
from retropole.base import se3
from retropole.base.datatypes import Array, Hypothesis, Match, Pole, Scan
from retropole.hypotheses import icp_refinement
from retropole.hypotheses.correspondence import EXACT_RMS, match_poles
from retropole.hypotheses.icp_refinement import MOST_REFINED, refine_by_icp, rms_after
from retropole.simulation import simulate_pair
from retropole.surfaces.scans import find_poles

OFF = np.array([0.03, -0.02, 0.04, 0.15, -0.1, 0.1])
"""2 to 3° and 0.2 m: what poles of few returns leave open."""


@dataclass(frozen=True)
class Recorded:
    target: Scan
    source: Scan
    right: Match
    truth: Array


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    pair = simulate_pair("harbor", np.random.default_rng(3))
    target, source = (
        find_poles(cloud, sensor=sensor, threshold=None, radius=0.02)
        for cloud, sensor in zip((pair.target, pair.source), pair.sensors, strict=True)
    )
    matches = match_poles(target.poles, source.poles)
    truth = pair.T_target_source
    right = min(matches, key=lambda m: se3.difference(truth, m.T_target_source).translation)
    return Recorded(target, source, right, truth)


def settled(of: Recorded, *matches: Match) -> list[Match]:
    hypotheses = [Hypothesis(match, None, None, 0.5, 0.0, 0.5) for match in matches]
    return refine_by_icp(
        of.target.cloud, of.source.cloud, hypotheses, of.target.poles, of.source.poles
    )


def turned(match: Match, T: Array, certainty: float) -> Match:
    """Turn a match away from a pose, as poles would have it that are so much surer of theirs."""
    information = certainty**2 * match.information
    return replace(match, T_target_source=se3.retract(T, OFF), information=information)


def test_a_hypothesis_settles_where_its_poles_allow_it(recorded: Recorded) -> None:
    (found,) = settled(recorded, turned(recorded.right, recorded.truth, 0.02))
    assert found.icp_refined
    apart = se3.difference(recorded.truth, found.T_target_source)
    assert apart.rotation < np.radians(0.3)
    assert apart.translation < 0.05


def test_what_is_out_of_reach_hardly_counts(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    match = turned(recorded.right, recorded.truth, 0.02)
    (found,) = settled(recorded, match)
    monkeypatch.setattr(icp_refinement, "ICP_REACH", np.inf)
    (by_all,) = settled(recorded, match)
    apart = se3.difference(found.T_target_source, by_all.T_target_source)
    # A registration ends where a step is shorter than this.
    assert apart.rotation < np.radians(0.1)
    assert apart.translation < 1e-3


def test_poles_that_are_sure_of_their_pose_hold_it(recorded: Recorded) -> None:
    match = turned(recorded.right, recorded.truth, 1.0)
    (found,) = settled(recorded, match)
    assert found is match


def test_where_there_is_no_scene_nothing_settles(recorded: Recorded) -> None:
    far = recorded.truth.copy()
    far[:3, 3] += 500.0
    match = replace(recorded.right, T_target_source=far)
    assert settled(recorded, match) == [match]


def test_hypotheses_that_end_in_one_pose_are_one(recorded: Recorded) -> None:
    one = turned(recorded.right, recorded.truth, 0.02)
    other = replace(one, T_target_source=se3.retract(recorded.truth, -OFF))
    assert len(settled(recorded, one, other)) == 1


def test_inexact_matches_and_the_worst_stay_as_they_are(recorded: Recorded) -> None:
    weak = turned(recorded.right, recorded.truth, 0.02)
    inexact = [replace(weak, exact=False) for _ in range(MOST_REFINED)]
    found = settled(recorded, *inexact, weak)
    assert not any(match.icp_refined for match in found)
    assert len(found) == MOST_REFINED + 1


def test_the_residual_after_a_step_is_that_of_the_returns(recorded: Recorded) -> None:
    T = se3.retract(recorded.right.T_target_source, 0.3 * OFF)
    squares, count = 0.0, 0
    for i, j in recorded.right.pairs:
        line: Pole = recorded.target.poles[i]
        xyz = recorded.source.poles[j].xyz
        q, n = (np.repeat(part[None], len(xyz), axis=0) for part in (line.point, line.direction))
        squares += float(np.sum(point_line_residuals(T, xyz, q, n).residuals ** 2))
        count += len(xyz)
    actual = np.sqrt(squares / count)
    assert actual > 1.2 * recorded.right.pole_rms, "a step that is seen"
    assert rms_after(recorded.right, T, count) == pytest.approx(actual, rel=0.03)
    assert rms_after(recorded.right, recorded.truth, count) < EXACT_RMS
