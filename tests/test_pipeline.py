"""The whole method: right where it can be, refused where it cannot."""

import gc
import time
import weakref
from contextlib import nullcontext
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import chi2

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import Sensor
from retropole.base.systematic import sizes_of
from retropole.base.uncertainty import predicted_error
from retropole.hypotheses import icp_refinement
from retropole.hypotheses.placements import Chosen, PlacementHypotheses
from retropole.hypotheses.search import choose_after_icp
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from tests.tiers import first_of


@pytest.fixture(scope="module")
def corridor() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(3))


@pytest.mark.full
@pytest.mark.parametrize("rings", [True, False])
def test_recordings_are_freed_after_a_calibration(rings: bool) -> None:
    """A process that calibrates for weeks does not grow by each recording."""
    pair = simulate_pair("bare", np.random.default_rng(3))
    clouds = [
        replace(cloud, ring=cloud.ring if rings else None) for cloud in (pair.target, pair.source)
    ]
    left = [weakref.ref(cloud) for cloud in clouds]
    assert calibrate(*clouds).placements
    del clouds
    gc.collect()
    assert [cloud() for cloud in left] == [None, None]


def off_by(T: Array, T_true: Array, at: Array) -> tuple[float, float]:
    """Angle in degrees, and distance of where both put points (N, 3), between two transforms."""
    turn = np.degrees(se3.rotation_angle(T[:3, :3] @ T_true[:3, :3].T))
    return turn, float(np.linalg.norm(se3.apply(T, at) - se3.apply(T_true, at), axis=1).max())


def assert_refused(answer: Calibration, *codes: str) -> None:
    assert answer.status == "refused"
    assert answer.T_target_source is None
    assert answer.covariance is None
    assert answer.reasons[0].code in codes, answer.reasons[0]
    assert any(character.isdigit() for character in answer.reasons[0].message)


@pytest.mark.parametrize("scene", first_of(["street", "corridor", "harbor"]))
@pytest.mark.parametrize("seed", first_of([12, 13]))
def test_finds_the_truth(scene: str, seed: int) -> None:
    pair = simulate_pair(scene, np.random.default_rng(seed))
    answer = calibrate(pair.target, pair.source)
    assert answer.status in ("ok", "warn"), answer.reasons
    assert answer.T_target_source is not None
    degrees, metres = off_by(answer.T_target_source, pair.T_target_source, np.zeros((1, 3)))
    assert degrees < 2.0
    assert metres < 0.2
    assert answer.margin is not None
    assert answer.margin > 0


@pytest.mark.full
def test_an_answer_carries_what_the_scene_says(corridor: SimulatedPair) -> None:
    answer = calibrate(corridor.target, corridor.source)
    assert answer.confirmation is not None
    assert answer.confirmation.agreeing > 40
    assert answer.confirmation.contradicted < 0.05


@pytest.mark.full
def test_a_refusal_carries_what_the_scene_says_once_it_was_requested() -> None:
    pair = simulate_pair("harbor", np.random.default_rng(1))
    on_poles = pair.labels[1] >= len(pair.surfaces) - len(pair.poles)
    xyz = pair.source.xyz.copy()
    xyz[on_poles] += [3.0, -2.0, 0.0]
    carried = calibrate(pair.target, replace(pair.source, xyz=xyz))
    assert_refused(carried, "scene_contradicts")
    assert carried.confirmation is not None
    values = carried.reasons[0].values
    assert carried.confirmation.contradicting == values["contradicting"]
    assert carried.confirmation.agreeing == values["agreeing"]
    earlier = calibrate(pair.target, PointCloud(pair.source.xyz))
    assert_refused(earlier, "no_intensity")
    assert earlier.confirmation is None


def stated_with(pair: SimulatedPair, sensors: tuple[Sensor, Sensor]) -> float:
    """1 σ at 30 m of an answer whose stated region holds the truth, metres."""
    refined = calibrate(pair.target, pair.source, options=Options(sensors=sensors)).refined
    assert refined is not None
    assert refined.covariance is not None
    off = se3.local(refined.T_target_source, pair.T_target_source)
    assert off @ np.linalg.solve(refined.covariance, off) < chi2.isf(0.001, 6)
    return predicted_error(refined.covariance, (30.0,))[0].sigma_m


def measured(sensor: Sensor, share: float) -> Sensor:
    """The same, with errors that were measured to be a part of what is usual."""
    sizes = asdict(sizes_of(sensor))
    return replace(sensor, errors={name: share * size for name, size in sizes.items()})


@pytest.mark.full
def test_the_smaller_errors_were_measured_the_less_is_stated(corridor: SimulatedPair) -> None:
    of = corridor.sensors
    whole, half = (
        stated_with(corridor, (measured(of[0], k), measured(of[1], k))) for k in (1, 0.5)
    )
    assert 1.1 < whole / half < 2.0
    assert stated_with(corridor, of) == pytest.approx(whole, rel=1e-9)


@pytest.mark.full
def test_moving_both_clouds_moves_the_answer(corridor: SimulatedPair) -> None:
    rng = np.random.default_rng(0)
    A, B = se3.random(rng), se3.random(rng)
    plain = calibrate(corridor.target, corridor.source)
    moved = calibrate(corridor.target.transformed(A), corridor.source.transformed(B))
    assert plain.T_target_source is not None
    assert moved.T_target_source is not None
    expected = A @ plain.T_target_source @ se3.inverse(B)
    degrees, metres = off_by(moved.T_target_source, expected, se3.apply(B, np.eye(3)))
    assert degrees < 0.05
    assert metres < 0.005


@pytest.mark.full
def test_swapping_the_clouds_inverts_the_answer(corridor: SimulatedPair) -> None:
    forth = calibrate(corridor.target, corridor.source)
    back = calibrate(corridor.source, corridor.target)
    assert forth.T_target_source is not None
    assert back.T_target_source is not None
    degrees, metres = off_by(se3.inverse(back.T_target_source), forth.T_target_source, np.eye(3))
    assert degrees < 0.3
    assert metres < 0.03


def sigmas_apart(answer: Calibration, T: Array, stage: str) -> float:
    """Distance of a pose from the answer's own, in what the answer states."""
    pose = getattr(answer, stage)
    step = se3.local(pose.T_target_source, T)
    return float(np.sqrt(step @ np.linalg.solve(pose.covariance, step)))


@pytest.mark.full
def test_frames_and_order_of_the_clouds_move_the_answer_by_less_than_its_uncertainty(
    corridor: SimulatedPair,
) -> None:
    """The poles are one and the same; surfaces are sampled anew, by cells of another raster.

    Frames keep their vertical, which the errors of rings and of the encoder refer to. Half of all
    answers with an honest uncertainty lie further than 2.3 from the truth.
    """
    rng = np.random.default_rng(0)
    A, B = (
        se3.from_rt(se3.exp_so3(np.array([0, 0, rng.uniform(-3, 3)])), rng.uniform(-5, 5, 3))
        for _ in range(2)
    )
    plain = calibrate(corridor.target, corridor.source)
    moved = calibrate(corridor.target.transformed(A), corridor.source.transformed(B))
    swapped = calibrate(corridor.source, corridor.target)
    for stage, most in (("poles", 0.2), ("refined", 2.3)):
        back = se3.inverse(A) @ getattr(moved, stage).T_target_source @ B
        assert sigmas_apart(plain, back, stage) < most
        inverse = se3.inverse(getattr(swapped, stage).T_target_source)
        assert sigmas_apart(plain, inverse, stage) < most


@pytest.mark.full
def test_the_order_of_the_points_does_not_matter(corridor: SimulatedPair) -> None:
    rng = np.random.default_rng(1)
    shuffled = [
        cloud.select(rng.permutation(len(cloud))) for cloud in (corridor.target, corridor.source)
    ]
    plain, other = calibrate(corridor.target, corridor.source), calibrate(*shuffled)
    assert plain.T_target_source is not None
    assert other.T_target_source is not None
    degrees, metres = off_by(other.T_target_source, plain.T_target_source, np.eye(3))
    assert degrees < 1e-3
    assert metres < 1e-4


@pytest.mark.full
def test_three_poles_are_solved_together() -> None:
    pair = simulate_pair("harbor", np.random.default_rng(2), poles=3)
    answer = calibrate(pair.target, pair.source)
    assert answer.T_target_source is not None
    assert len(answer.hypotheses[0].match.pairs) == 3
    degrees, metres = off_by(answer.T_target_source, pair.T_target_source, np.zeros((1, 3)))
    assert degrees < 1.0
    assert metres < 0.1
    assert calibrate(pair.target, pair.source, options=Options(poles=3)).status == answer.status
    assert_refused(calibrate(pair.target, pair.source, options=Options(poles=4)), "too_few_poles")


def without_poles(pair: SimulatedPair, which: tuple[int, ...]) -> PointCloud:
    first = len(pair.surfaces) - len(pair.poles)
    return pair.source.select(~np.isin(pair.labels[1], [first + k for k in which]))


@pytest.mark.parametrize("which", [(0,), pytest.param((0, 1), marks=pytest.mark.full)])
@pytest.mark.full
def test_a_hidden_pole_is_refused_where_two_are_requested(
    corridor: SimulatedPair, which: tuple[int, ...]
) -> None:
    source = without_poles(corridor, which)
    answer = calibrate(corridor.target, source, options=Options(poles=2))
    assert_refused(answer, "too_few_poles")
    assert answer.reasons[0].values["lidar"] == "source"
    answer = calibrate(corridor.target, source)
    if len(which) == 2:
        assert_refused(answer, "too_few_poles")
        return
    assert answer.T_target_source is not None
    assert "by_place" in {note.code for note in answer.notes}
    degrees, metres = off_by(answer.T_target_source, corridor.T_target_source, np.zeros((1, 3)))
    assert degrees < 0.5
    assert metres < 0.1


@pytest.mark.full
@pytest.mark.parametrize(("scene", "seed"), [("harbor", 2), ("bare", 2)])
def test_without_intensity_the_place_is_named_where_it_gives_an_answer(
    scene: str, seed: int
) -> None:
    pair = simulate_pair(scene, np.random.default_rng(seed))
    clouds = [replace(cloud, intensity=None) for cloud in (pair.target, pair.source)]
    answer = calibrate(*clouds)
    assert_refused(answer, "no_intensity")
    by_place = calibrate(*clouds, options=Options(poles=0))
    assert (by_place.T_target_source is not None) == (scene == "harbor")
    assert ("--poles 0" in answer.reasons[0].message) == (scene == "harbor")
    assert len(answer.reasons[0].message) <= 300


@pytest.mark.full
def test_no_intensity_is_refused(corridor: SimulatedPair) -> None:
    for value in (None, np.full(len(corridor.source), 7.0)):
        answer = calibrate(corridor.target, replace(corridor.source, intensity=value))
        assert_refused(answer, "no_intensity")


@pytest.mark.parametrize("seed", first_of(range(2)))
@pytest.mark.full
def test_parallel_poles_are_refused_unless_the_place_tells(seed: int) -> None:
    pair = simulate_pair(
        "street",
        np.random.default_rng(seed),
        min_pole_angle=0.0,
        max_pole_angle=float(np.radians(3)),
        sensor_target="VLP-16",
        sensor_source="VLP-16",
    )
    by_poles = calibrate(pair.target, pair.source, options=Options(scene=False))
    assert_refused(by_poles, "parallel_poles", "no_match", "no_overlap")
    answer = calibrate(pair.target, pair.source)
    if answer.T_target_source is not None:
        assert "by_place" in {note.code for note in answer.notes}
        degrees, metres = off_by(answer.T_target_source, pair.T_target_source, np.zeros((1, 3)))
        assert degrees < 0.5
        assert metres < 0.1


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.full
def test_scenes_that_have_nothing_in_common_are_refused(seed: int) -> None:
    one = simulate_pair("street", np.random.default_rng(seed))
    other = simulate_pair("harbor", np.random.default_rng(seed + 50))
    answer = calibrate(one.target, other.source)
    assert_refused(answer, "no_match", "no_overlap", "ambiguous")


@pytest.mark.parametrize("scene", first_of(["corridor", "harbor", "bare"]))
@pytest.mark.full
def test_symmetric_surroundings_are_refused_as_ambiguous(scene: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(5), symmetric=True)
    assert_refused(calibrate(pair.target, pair.source), "ambiguous")


@pytest.mark.full
def test_an_empty_cloud_is_refused(corridor: SimulatedPair) -> None:
    nothing = corridor.source.select(np.zeros(0, dtype=np.int64))
    assert_refused(calibrate(corridor.target, nothing), "no_intensity")


@pytest.mark.full
def test_progress_names_the_steps(corridor: SimulatedPair) -> None:
    steps: list[str] = []
    answer = calibrate(corridor.target, corridor.source, progress=steps.append)
    assert steps[:4] == ["extract", "check", "match", "disambiguate"]
    assert set(answer.seconds) == set(steps)


@pytest.mark.full
def test_a_registration_that_fails_is_no_choice(
    corridor: SimulatedPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise Refusal("registration_failed", "left the finite numbers", {})

    monkeypatch.setattr(icp_refinement, "register", fails)
    answer = calibrate(corridor.target, corridor.source)
    scored = PlacementHypotheses(answer.placements[0], answer.hypotheses)
    chosen = Chosen(answer.hypotheses, (), scored=(scored,))
    settled = choose_after_icp(chosen, lambda step: nullcontext())
    assert settled.refusal is not None
    assert settled.refusal.code == "registration_failed"
    assert not settled.paired


@pytest.mark.parametrize("poles", [2, 1])
@pytest.mark.full
def test_every_second_is_in_a_step(poles: int) -> None:
    """Of an answer, and of a refusal after which candidate poles were looked for."""
    pair = simulate_pair("harbor", np.random.default_rng(3))
    target = pair.target
    if poles == 1:
        first = calibrate(pair.target, pair.source).placements[0].target.poles[0]
        target = target.select(np.setdiff1d(np.arange(len(target)), first.index))
    start = time.perf_counter()
    answer = calibrate(target, pair.source, options=Options(poles=2))
    seconds = time.perf_counter() - start
    assert (answer.status == "refused") == (poles == 1)
    assert sum(answer.seconds.values()) == pytest.approx(seconds, rel=0.1)
