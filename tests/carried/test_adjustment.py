"""Exact walks: the adjustment ends at the truth, with the derivatives of its rows."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.systematic import Sizes
from retropole.base.uncertainty import predicted_error
from retropole.carried import linear
from retropole.carried.adjustment import Adjusted, adjust, moved_by
from retropole.carried.linear import Seen
from retropole.carried.rows import rows_of
from retropole.carried.start import Start
from retropole.carried.track import Track
from tests.carried.walks import RADIUS, REST, SeenWalk, seen_walk


def adjusted(walk: SeenWalk, start: Start) -> Adjusted:
    seen = [Seen(rows_of(track, None, RADIUS), Sizes()) for track in walk.tracks]
    return adjust(start.poses, walk.tracks, seen, RADIUS)


def test_an_exact_walk_ends_at_the_truth() -> None:
    walk = seen_walk()
    near = se3.retract(walk.T_target_source, np.array([0.01, -0.01, 0.02, 0.03, 0.02, -0.03]))
    found = adjusted(walk, Start(near, walk.offset + 0.01, 0.01, False))
    step = se3.local(found.T_target_source, walk.T_target_source)
    sigma = np.sqrt(np.diag(found.covariance))
    assert found.converged
    # Derivatives at measured points, not at those of the model, would pull it by 2 σ.
    assert np.all(np.abs(step) < sigma[:6])
    assert abs(found.offset - walk.offset) < 1e-3
    assert found.left_out < 0.01


@pytest.mark.full
def test_a_pole_at_rest_adds_to_the_estimate() -> None:
    """Not as often as it is seen: at rest beams leave the same open in every sweep."""
    walk = seen_walk(rests=True)
    start = Start(walk.T_target_source, walk.offset, 0.01, False)
    found = adjusted(walk, start)
    moving = tuple(
        without_rests(track, ahead)
        for track, ahead in zip(walk.tracks, (0.0, walk.offset), strict=True)
    )
    without = adjusted(walk._replace(tracks=(moving[0], moving[1])), start)
    stated, more = (
        predicted_error(each.covariance[:6, :6], (30.0,))[0].sigma_m for each in (found, without)
    )
    assert 0.5 * more < stated < 0.97 * more
    step = se3.local(found.T_target_source, walk.T_target_source)
    assert step @ np.linalg.solve(found.covariance[:6, :6], step) < 12.6


def without_rests(track: Track, ahead: float) -> Track:
    """Leave out the sweeps in which the pole rests."""
    moves = np.abs((track.times - ahead + 2.0) % 4.0 - 2.0) > REST / 2
    of = moves[track.sweep]
    returns = {name: getattr(track, name)[of] for name in ("xyz", "stamps", "rings", "is_whole")}
    sweeps = {name: getattr(track, name)[moves] for name in ("times", "points", "directions")}
    return replace(track, **sweeps, **returns, sweep=(np.cumsum(moves) - 1)[track.sweep[of]])


def test_derivatives_are_those_of_the_residuals() -> None:
    """The depth of the cylinder hardly changes by the pose and is not differentiated."""
    walk = seen_walk(4.0)
    seen = [Seen(rows_of(track, None, RADIUS), Sizes()) for track in walk.tracks]
    start = Start(walk.T_target_source, walk.offset, 0.01, False)
    poses = start.poses
    frame = linear.frame_of(poses, walk.tracks, seen, RADIUS)
    rng = np.random.default_rng(1)
    coefs = linear.first_coefs(frame, poses, walk.tracks)
    clocks = np.stack([poses.offsets, np.zeros(2)], axis=1)
    state = linear.State(coefs, poses.T, clocks, np.zeros(len(frame.sigma)))
    scale = np.ones((2, 2))
    system = linear.linearised(frame, state, scale)
    prior = np.diag(frame.precision) ** -0.5
    step = 1e-4 * np.minimum(prior, 1.0) * rng.normal(size=len(prior))
    moved = 1e-6 * rng.normal(size=coefs.shape)

    def residuals(sign: float) -> np.ndarray:
        at = moved_by(frame, state, sign * moved, sign * step)
        return linear.linearised(frame, at, scale).residuals.ravel()

    change = (residuals(1.0) - residuals(-1.0)) / 2
    by_lidar = np.einsum("nrk,nk->nr", system.by_lidar, step[system.columns[system.lidar]])
    expected = system.by_coefs @ moved.ravel() + by_lidar.ravel() + system.by_rings @ step
    assert np.median(np.abs(change - expected)) < 0.02 * np.median(np.abs(expected))


@pytest.mark.full
def test_an_upright_pole_leaves_the_tilt_open() -> None:
    walk = seen_walk(lean=0.0)
    found = adjusted(walk, Start(walk.T_target_source, walk.offset, 0.01, False))
    assert np.sqrt(found.covariance[5, 5]) > 10 * np.sqrt(found.covariance[0, 0])
