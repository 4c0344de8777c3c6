"""A walk before many LiDARs: one answer, whatever their order and what each sees of it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from retropole.adjustment.answer import SiteCalibration
from retropole.alignment.certainty import chi2_limit
from retropole.base import se3
from retropole.base.datatypes import Array, BoolArray, Placement, PointCloud, Scan
from retropole.base.description import Site, SiteLidar
from retropole.base.errors import Refusal
from retropole.base.systematic import Sizes
from retropole.carried.adjustment import adjust
from retropole.carried.linear import Seen
from retropole.carried.rows import rows_of
from retropole.carried.site import from_reference, state_walk_of_site
from retropole.carried.start import Poses, Start
from retropole.carried.statement import state_walk
from retropole.carried.track import Track
from retropole.carried.verdict import chosen
from retropole.carried.walk import _chained, calibrate_tracks, solve_tracks
from retropole.hypotheses.scans import SiteScans
from tests.carried.walks import RADIUS, seen_by_all

AHEAD = np.array([0.0, 0.731, -0.42])
NAMES = "a", "b", "c"
NOISE = 0.015
"""1 σ of a range, metres, as it is stated of a LiDAR that is not known."""


@cache
def all_tracks() -> tuple[list[Track], Array]:
    return seen_by_all(12.0)


def stated(tracks: Sequence[Track], reference: int = 0) -> SiteCalibration:
    """Answer a walk in empty space."""
    nothing = Scan(PointCloud(np.ones((1, 3)), np.ones(1)))
    lidars = tuple(SiteLidar(name, (nothing.cloud,)) for name in NAMES[: len(tracks)])
    site = Site("walk", lidars, ("walk",), reference=reference, carried=True)
    order = from_reference(site)
    own = [tracks[k] for k in order]
    names = [NAMES[k] for k in order]
    solved = solve_tracks(own, len(own) * (None,), RADIUS, None, names)
    scans = SiteScans(len(own) * ((nothing,),), np.zeros((len(own), 3)))
    return state_walk_of_site(site, scans, solved, {})


def relative(answer: SiteCalibration, a: int, b: int) -> tuple[Array, Array]:
    """Pose of b in the frame of a, and its covariance."""
    assert answer.covariance is not None
    joint = se3.joint_of(answer.covariance, a, b)
    return se3.relative(answer.lidars[a].T_site_lidar, answer.lidars[b].T_site_lidar, joint)


def part_of_track(track: Track, kept: BoolArray) -> Track:
    """Leave sweeps of a track out."""
    of = kept[track.sweep]
    returns = {name: getattr(track, name)[of] for name in ("xyz", "stamps", "rings", "is_whole")}
    sweeps = {name: getattr(track, name)[kept] for name in ("times", "points", "directions")}
    return replace(track, **sweeps, **returns, sweep=(np.cumsum(kept) - 1)[track.sweep[of]])


def test_poses_are_chained_through_any_pair() -> None:
    rng = np.random.default_rng(0)
    T = np.concatenate([np.eye(4)[None], np.stack([se3.random(rng) for _ in NAMES[1:]])])
    wrong = Start(np.eye(4), 9.0, 0.1, False)

    def link(i: int, j: int) -> tuple[tuple[int, int], list[Start]]:
        start = Start(se3.inverse(T[i]) @ T[j], AHEAD[j] - AHEAD[i], 0.01, False)
        return (i, j), [wrong, start]

    for links in ([link(0, 1), link(1, 2)], [link(0, 2), link(1, 2)]):
        found = _chained(links, (1, 1))
        np.testing.assert_allclose(found.T, T, atol=1e-12)
        np.testing.assert_allclose(found.offsets, AHEAD, atol=1e-12)


@pytest.mark.full
def test_two_lidars_are_answered_as_a_pair() -> None:
    tracks, _ = all_tracks()
    site = stated(tracks[:2])
    found = calibrate_tracks((tracks[0], tracks[1]), (None, None), RADIUS)
    nothing = Scan(PointCloud(np.ones((1, 3)), np.ones(1)))
    pair = state_walk(found, Placement(nothing, nothing), {}, scene=False)
    assert pair.T_target_source is not None
    assert pair.covariance is not None
    assert pair.walk is not None
    assert site.walk is not None
    np.testing.assert_allclose(site.lidars[1].T_site_lidar, pair.T_target_source, atol=1e-9)
    # But for how unmodelled errors of the target move what is far from it.
    np.testing.assert_allclose(site.lidars[1].covariance, pair.covariance, atol=3e-6)
    own, other = site.walk.lidars[1], pair.walk.of_site.lidars[1]
    assert own.clock_offset_s == pytest.approx(other.clock_offset_s, abs=1e-9)
    assert own.clock_sigma_s == pytest.approx(other.clock_sigma_s, rel=1e-6)
    assert own.found == other.found


@pytest.mark.full
def test_the_order_of_lidars_does_not_matter() -> None:
    tracks, truth = all_tracks()
    answers = [stated(tracks, reference) for reference in (0, 2)]
    shuffled = stated([tracks[k] for k in (1, 2, 0)])
    whole = [(answer, (0, 1, 2)) for answer in answers] + [(shuffled, (2, 0, 1))]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        poses = [relative(answer, places[a], places[b]) for answer, places in whole]
        first, covariance = poses[0]
        off = se3.local(first, se3.inverse(truth[a]) @ truth[b])
        assert off @ np.linalg.solve(covariance, off) < chi2_limit(6, 0.999)
        for T, other in poses[1:]:
            step = se3.local(first, T)
            assert step @ np.linalg.solve(covariance, step) < 0.05
            assert np.trace(other) == pytest.approx(np.trace(covariance), rel=0.1)
    for answer, places in whole:
        assert answer.walk is not None
        clocks = np.array([answer.walk.lidars[k].clock_offset_s for k in places])
        np.testing.assert_allclose(clocks - clocks[0], -AHEAD, atol=3e-3)


@pytest.mark.full
def test_a_lidar_that_sees_the_second_half_alone_is_in_the_answer() -> None:
    tracks, truth = all_tracks()
    late = part_of_track(tracks[2], tracks[2].times + 0.42 > 6.0)
    answer = stated([*tracks[:2], late])
    for a, b in ((0, 2), (1, 2)):
        T, covariance = relative(answer, a, b)
        off = se3.local(T, se3.inverse(truth[a]) @ truth[b])
        assert off @ np.linalg.solve(covariance, off) < chi2_limit(6, 0.999)
    whole = stated(tracks)
    assert np.trace(whole.lidars[2].covariance) < np.trace(answer.lidars[2].covariance)


@pytest.mark.full
def test_a_lidar_may_be_linked_through_another_alone() -> None:
    """The first sees the first half and the third the second: none of it at the same time."""
    tracks, truth = all_tracks()
    early = part_of_track(tracks[0], tracks[0].times < 5.5)
    late = part_of_track(tracks[2], tracks[2].times + 0.42 > 6.0)
    solved = solve_tracks([early, tracks[1], late], 3 * (None,), RADIUS, AHEAD, NAMES)
    best = chosen(solved.solutions, NAMES)
    off = se3.local(best.T[2], se3.inverse(truth[0]) @ truth[2])
    assert off @ np.linalg.solve(best.covariance[7:13, 7:13], off) < chi2_limit(6, 0.999)


@pytest.mark.full
def test_without_a_common_walk_the_lidar_is_named() -> None:
    tracks, _ = all_tracks()
    early = [
        part_of_track(each, each.times - ahead < 5.0)
        for each, ahead in zip(tracks[:2], AHEAD, strict=False)
    ]
    late = part_of_track(tracks[2], tracks[2].times + 0.42 > 10.5)
    with pytest.raises(Refusal, match=r"sweeps of a and b are there in which c sees") as refused:
        solve_tracks([*early, late], 3 * (None,), RADIUS, AHEAD, NAMES)
    assert refused.value.code == "no_common_walk"


@pytest.mark.full
def test_a_clock_that_steps_is_found_and_named() -> None:
    tracks, _ = all_tracks()
    for k in (0, 2):
        late = 0.02 * (tracks[k].stamps - AHEAD[k] > 6.0)
        stepped = [*tracks]
        stepped[k] = replace(tracks[k], stamps=tracks[k].stamps + late)
        with pytest.raises(Refusal, match=f"offset of {NAMES[k]} changes") as refused:
            stated(stepped)
        assert refused.value.code == "clock_jumps"


@pytest.mark.full
def test_what_is_stated_of_all_poses_together_is_how_far_they_are_off() -> None:
    """χ² of all poses of walks with noise is that of as many degrees of freedom."""
    tracks, truth = seen_by_all(6.0)
    T = se3.inverse(truth[0]) @ truth
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        noisy = [with_noise(each, rng) for each in tracks]
        seen = [Seen(rows_of(each, None, RADIUS), Sizes()) for each in noisy]
        found = adjust(Poses(T, AHEAD), noisy, seen, RADIUS)
        own = np.r_[0:6, 7:13]
        step = np.concatenate([se3.local(found.T[k], T[k]) for k in (1, 2)])
        squares.append(step @ np.linalg.solve(found.covariance[np.ix_(own, own)], step))
    # Systematic errors are stated and not simulated, so that it is less.
    assert np.sum(squares) < chi2_limit(12 * len(squares), 0.999)
    assert np.sum(squares) > 0.1 * 12 * len(squares)


def with_noise(track: Track, rng: np.random.Generator) -> Track:
    """Move returns along their beams."""
    ranges = np.linalg.norm(track.xyz, axis=1, keepdims=True)
    return replace(track, xyz=track.xyz * (1 + NOISE * rng.normal(size=ranges.shape) / ranges))
