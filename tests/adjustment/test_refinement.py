"""A place that alone decides a direction is found, left out, and said."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.adjustment.agreement import check_agreement, check_contradiction, check_decisive
from retropole.adjustment.refinement import (
    MAX_SHARE,
    Refinement,
    leverage,
    refine,
    without_moved,
)
from retropole.adjustment.solved import Places
from retropole.alignment.adjustment import BeamAlignment
from retropole.base import se3
from retropole.base.datatypes import Array, Placement, PointCloud, PoseEstimate
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.base.systematic import ErrorModel, Layout, Sizes, sizes_of
from retropole.checking.metrics import e_rt
from retropole.hypotheses.by_place import REGISTRATION_SIGMA
from retropole.hypotheses.placements import align
from retropole.hypotheses.search import choose
from retropole.io import read_cloud
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, SimulatedPair, draw_device, simulate_pair
from retropole.surfaces.consistency import movable_objects
from retropole.surfaces.patch_pairs import (
    by_objects,
    pair_patches,
    prepare_patches,
    without_errors,
)
from retropole.surfaces.patches import surface_patches
from retropole.surfaces.scans import find_poles
from tests.numeric import CHI2_6_95, covariance_of, mahalanobis_sq, numeric_jacobian
from tests.paths import SHARED
from tests.tiers import first_of

SPREAD = np.diag(np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05]) ** 2)


def off_pose(T: Array, seed: int = 0) -> PoseEstimate:
    """A pose off by a draw from `SPREAD`, that says so."""
    rng = np.random.default_rng(seed)
    return PoseEstimate(se3.retract(T, rng.multivariate_normal(np.zeros(6), SPREAD)), SPREAD, 0.01)


def floor(rng: np.random.Generator, count: int = 30_000) -> PointCloud:
    """Flat ground of 20 × 20 m seen from 1.5 m above it."""
    xy = rng.uniform(-10, 10, (count, 2))
    return PointCloud(np.c_[xy, np.full(count, -1.5) + 0.005 * rng.normal(size=count)])


def test_jacobian_equals_finite_differences() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(4))
    patches = surface_patches(pair.target), surface_patches(pair.source)
    layout = Layout((np.unique(patches[0].bands), np.unique(patches[1].bands)))
    sets = prepare_patches(patches[0], patches[1], layout)
    T, tight = pair.T_target_source, 1e-12 * np.eye(6)

    def residuals(step: Array) -> Array:
        found = pair_patches(sets, se3.retract(T, step), tight, False)
        assert found is not None
        return found.residuals

    here = pair_patches(sets, T, tight, False)
    assert here is not None
    derivative = numeric_jacobian(residuals, 6, 1e-8)
    # The normal and the blend of the target's patches change with the pose; where the patches agree
    # that changes the residual by nothing that counts.
    small = np.abs(here.residuals) < 0.005
    error = np.abs(derivative - here.jacobian)[small]
    assert np.all(np.median(error, axis=0) < 1e-2 * np.abs(here.jacobian).max(axis=0).clip(1.0))


@pytest.mark.parametrize("scene", ["street", "harbor"])
@pytest.mark.full
def test_the_scene_sharpens_the_poles(scene: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(21))
    start = off_pose(pair.T_target_source)
    refined = refine(pair.target, pair.source, start)
    assert refined is not None
    before = e_rt(start.T_target_source, pair.T_target_source)
    after = e_rt(refined.pose.T_target_source, pair.T_target_source)
    assert after < 0.05
    assert after < before / 5
    assert refined.mahalanobis_sq < 40


@pytest.mark.full
def test_what_the_scene_does_not_hold_stays_where_the_poles_put_it() -> None:
    """Flat ground fixes height, roll and pitch; it knows nothing of x, y and yaw."""
    rng = np.random.default_rng(3)
    target = floor(rng)
    T_true = se3.from_rt(se3.exp_so3(np.array([0, 0, 0.3])), np.array([0.5, -0.4, 0.2]))
    source = PointCloud(se3.apply(se3.inverse(T_true), floor(rng).xyz))
    start = off_pose(T_true, 5)
    refined = refine(target, source, start)
    assert refined is not None
    assert refined.pose.covariance is not None
    left = se3.local(refined.pose.T_target_source, T_true)
    drawn = se3.local(start.T_target_source, refined.pose.T_target_source)
    assert np.abs(left[[0, 1]]).max() < 0.002
    assert abs(left[5]) < 0.01
    assert np.abs(drawn[[3, 4]]).max() < 0.02
    assert abs(drawn[2]) < 0.005
    sigma = np.sqrt(np.diag(refined.pose.covariance))
    assert np.all(sigma[[2, 3, 4]] > 0.5 * np.sqrt(np.diag(SPREAD))[[2, 3, 4]])
    assert sigma[0] < 0.003


def test_a_scene_with_nothing_in_it_says_nothing() -> None:
    rng = np.random.default_rng(0)
    sparse = PointCloud(rng.uniform(-50, 50, (300, 3)))
    assert refine(sparse, sparse, off_pose(np.eye(4))) is None
    few = PointCloud(rng.normal(size=(5, 3)))
    assert refine(few, few, off_pose(np.eye(4))) is None


def test_surfaces_next_to_each_other_say_nothing() -> None:
    """As near as neighbouring patches of one cloud, and none on the other's surface."""
    x, y = np.mgrid[-4:4:0.06, 2:8:0.06]
    plane = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.5)])
    plane += np.random.default_rng(0).normal(scale=1e-3, size=plane.shape)
    start = PoseEstimate(np.eye(4), 1e-8 * np.eye(6), 0.01)
    for lift, says in ((0.0, True), (0.3, False)):
        found = refine(PointCloud(plane), PointCloud(plane + np.array([0, 0, lift])), start)
        assert (found is not None) is says


def poles_of(pair: SimulatedPair) -> BeamAlignment:
    """Give what the poles say, as the pipeline finds it."""
    sensors = pair.sensors
    target, source = (
        find_poles(cloud, sensor=sensor, threshold=None, radius=0.02)
        for cloud, sensor in zip((pair.target, pair.source), sensors, strict=True)
    )
    chosen = choose([Placement(target, source)], lambda name: nullcontext())
    T = chosen.hypotheses[0].match.T_target_source
    return align(chosen.paired, T, radius=0.02, radius_sigma=0.0)


@pytest.mark.parametrize("scene", first_of(["street", "corridor", "harbor"]))
@pytest.mark.full
def test_other_starts_within_the_poles_uncertainty_end_at_the_same_pose(
    scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Steps end where they are told to; where they lead to is the same.
    monkeypatch.setattr("retropole.adjustment.descent.STEP", 0.001)
    pair = simulate_pair(
        scene, np.random.default_rng(32), sensor_target="VLP-16", sensor_source="VLP-16"
    )
    poles, rng = poles_of(pair), np.random.default_rng(0)
    T, covariance = poles.pose.T_target_source, covariance_of(poles.pose)
    ends = []
    for step in (np.zeros(6), *rng.multivariate_normal(np.zeros(6), covariance, 4)):
        refined = refine(
            pair.target,
            pair.source,
            poles.pose,
            factor=poles.factor,
            model=ErrorModel((sizes_of(pair.sensors[0]), sizes_of(pair.sensors[1]))),
            start=se3.retract(T, step),
        )
        assert refined is not None
        assert refined.converged
        ends.append(refined.pose.T_target_source)
    for end in ends[1:]:
        assert np.abs(se3.local(ends[0], end)).max() < 1e-6


@pytest.mark.full
def test_swapping_and_moving_give_the_same_pose() -> None:
    pair = simulate_pair("street", np.random.default_rng(22))
    T = pair.T_target_source
    start = off_pose(T)
    forth = refine(pair.target, pair.source, start)
    A = se3.random(np.random.default_rng(1), 10.0)
    rotated = np.kron(np.eye(2), A[:3, :3])
    # Rotating the frame also rotates the lever of φ: the start is at the truth to keep it plain.
    moved = refine(
        pair.target.transformed(A),
        pair.source,
        PoseEstimate(A @ start.T_target_source, rotated @ SPREAD @ rotated.T, 0.01),
    )
    assert forth is not None
    assert moved is not None
    back = se3.inverse(A) @ moved.pose.T_target_source
    assert e_rt(back, forth.pose.T_target_source) < 0.02


def test_patches_without_errors_lie_where_the_residuals_by_error_say() -> None:
    pair = simulate_pair("street", np.random.default_rng(23))
    patches = surface_patches(pair.target), surface_patches(pair.source)
    layout = Layout((np.unique(patches[0].bands), np.unique(patches[1].bands)))
    sets = prepare_patches(*patches, layout)
    b = 1e-7 * np.random.default_rng(0).normal(size=layout.size)
    moved = prepare_patches(*without_errors(sets, b), layout)
    # The same places, so that only residuals change.
    moved = replace(moved, clusters=sets.clusters)
    before, after = (
        pair_patches(each, pair.T_target_source, SPREAD, True) for each in (sets, moved)
    )
    assert before is not None
    assert after is not None
    step = after.residuals - before.residuals
    error = np.abs(step - before.by_errors(b))
    # Which patches of the target a surface is blended of changes as well, where they are apart.
    assert np.quantile(error, 0.95) < 0.01 * np.abs(step).max()
    # Not by a few: a patch that is seen at a grazing angle moves most.
    assert np.median(np.abs(step)) > 0.1 * np.quantile(np.abs(step), 0.95)


@pytest.mark.full
def test_scene_and_poles_that_disagree_are_warned_of() -> None:
    pair = simulate_pair("street", np.random.default_rng(23))
    tight = 1e-6 * np.eye(6)
    off = se3.retract(pair.T_target_source, np.array([0.0, 0, 0.01, 0.05, 0, 0]))
    refined = refine(pair.target, pair.source, PoseEstimate(off, tight, 0.01))
    assert refined is not None
    assert [r.code for r in check_agreement(refined)] == ["poles_and_scene_disagree"]
    assert check_agreement(None) == []


@pytest.mark.full
def test_poles_and_scene_that_disagree_state_what_the_poles_alone_do() -> None:
    """In no direction less, and in none much more: `check_contradiction` refuses what is beyond."""
    pair = simulate_pair("street", np.random.default_rng(23))
    tight = 1e-6 * np.eye(6)
    step = np.array([0.0, 0, 0.01, 0.05, 0, 0])
    off = se3.retract(pair.T_target_source, step)
    refined = refine(pair.target, pair.source, PoseEstimate(off, tight, 0.01))
    assert refined is not None
    covariance = covariance_of(refined.pose)
    assert np.linalg.eigvalsh(covariance - tight).min() > -1e-12
    e = se3.local(off, refined.pose.T_target_source)
    assert np.abs(e + step).max() < 0.02
    assert np.linalg.eigvalsh(covariance)[-1] < 10 * 1e-6
    with pytest.raises(Refusal, match="from where the poles have them") as refusal:
        check_contradiction(refined)
    assert refusal.value.code == "poles_scene_contradict"


@pytest.mark.full
def test_swapped_clouds_give_the_inverse_pose() -> None:
    """Where the rings on the ground are far apart, and the poles are unlucky."""
    pair = simulate_pair(
        "street", np.random.default_rng(72), sensor_target="VLP-16", sensor_source="VLP-16"
    )
    T = pair.T_target_source
    forth, back = calibrate(pair.target, pair.source), calibrate(pair.source, pair.target)
    found = []
    for answer, truth in ((forth, T), (back, se3.inverse(T))):
        assert answer.refined is not None
        assert mahalanobis_sq(answer.refined, truth) < CHI2_6_95
        # Not because it would state that it knows nothing.
        assert np.sqrt(np.diag(covariance_of(answer.refined))).max() < 0.01
        found.append(answer.refined.T_target_source)
    apart = se3.difference(found[0] @ found[1], np.eye(4))
    assert apart.rotation < np.radians(0.05)
    assert apart.translation < 0.005


@pytest.mark.full
def test_the_pipeline_reports_both_stages() -> None:
    pair = simulate_pair("street", np.random.default_rng(24))
    answer = calibrate(pair.target, pair.source)
    assert answer.poles is not None
    assert answer.refined is not None
    np.testing.assert_array_equal(answer.T_target_source, answer.refined.T_target_source)
    assert [each.range_m for each in answer.predicted_error] == [1.0, 10.0, 30.0, 60.0]
    alone = calibrate(pair.target, pair.source, options=Options(scene=False))
    assert alone.refined is None
    np.testing.assert_array_equal(alone.T_target_source, answer.poles.T_target_source)


@pytest.mark.full
def test_the_covariance_is_neither_too_small_nor_too_wide() -> None:
    """Six corridors, each recorded by two pairs of LiDARs with all errors of the field.

    The median of 12 squared distances is 3.2; 5.4 is ideal. A covariance of half the σ gives 13,
    one of three times the σ 0.35.
    """
    squares = []
    for seed in range(6):
        pair = simulate_pair(
            "corridor",
            np.random.default_rng(300 + seed),
            sensor_target="VLP-16",
            sensor_source="VLP-16",
            noise=FIELD,
        )
        for k in range(2):
            rng = np.random.default_rng([seed, k])
            target, source = (draw_device(sensor, FIELD, rng) for sensor in pair.sensors)
            again = record_again(replace(pair, devices=(target, source)), rng, poles=False)
            start = off_pose(again.T_target_source, 3 * seed + k)
            refined = refine(again.target, again.source, start)
            assert refined is not None
            squares.append(mahalanobis_sq(refined.pose, again.T_target_source))
    assert 1.5 < np.median(squares) < 10.0


@pytest.mark.full
def test_a_refinement_that_still_moves_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = simulate_pair("street", np.random.default_rng(21))
    start = off_pose(pair.T_target_source)
    whole = refine(pair.target, pair.source, start)
    monkeypatch.setattr("retropole.adjustment.descent.MAX_ITERATIONS", 2)
    short = refine(pair.target, pair.source, start)
    assert whole is not None
    assert short is not None
    assert whole.converged
    assert whole.iterations > 2
    assert not short.converged
    answer = calibrate(pair.target, pair.source)
    assert "not_converged" in [reason.code for reason in answer.reasons]


@pytest.mark.nightly
@pytest.mark.parametrize("scene", ["street", "harbor"])
def test_the_covariance_covers_the_truth(scene: str) -> None:
    """95 % regions of both stages hold the truth in most of 60 scenes, at their stated size."""
    inside: dict[str, list[bool]] = {"poles": [], "refined": []}
    for seed in range(60):
        pair = simulate_pair(scene, np.random.default_rng(1000 + seed))
        answer = calibrate(pair.target, pair.source)
        for name, found in (("poles", answer.poles), ("refined", answer.refined)):
            if found is not None and found.covariance is not None:
                inside[name].append(mahalanobis_sq(found, pair.T_target_source) < CHI2_6_95)
    for name, held in inside.items():
        assert np.mean(held) >= 0.88, name


DATA = SHARED / "pandaset"


@pytest.mark.skipif(not DATA.exists(), reason="no folder ../shared/data")
@pytest.mark.full
def test_real_clouds_come_to_one_pose_from_all_around() -> None:
    target, source = (
        read_cloud(DATA / f"pandaset002_00_{name}.pcd") for name in ("pandar64", "pandargt")
    )
    reference = np.array(
        json.loads((DATA / "pandaset002_reference.json").read_text())["T_pandargt_to_pandar64"]
    )
    # So wide that a start's own prior does not pull.
    spread = np.diag(np.r_[np.full(3, np.radians(5)), np.full(3, 0.5)] ** 2)
    known = ErrorModel((sizes_of(find_sensor("Pandar64")), Sizes()))
    rng, found = np.random.default_rng(0), []
    for _ in range(4):
        rotation, translation = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        step = np.r_[np.radians(3) * rotation, 0.3 * translation]
        start = se3.retract(reference, step)
        refined = refine(target, source, PoseEstimate(start, spread, 0.01), model=known)
        assert refined is not None
        found.append(refined.pose.T_target_source)
        off = se3.local(found[-1], reference)
        # The reference is good to 0.1° and 3 cm (1 σ) about and along each axis.
        assert np.degrees(np.linalg.norm(off[:3])) < 0.25
        assert np.linalg.norm(off[3:]) < 0.075
    for T in found[1:]:
        apart = se3.local(found[0], T)
        assert np.degrees(np.linalg.norm(apart[:3])) < 0.02
        assert np.linalg.norm(apart[3:]) < 0.005


def test_surfaces_without_noise_are_never_thinner_than_nothing() -> None:
    x, y = np.meshgrid(np.arange(-5.0, 5.0, 0.05), np.arange(3.0, 9.0, 0.05))
    plane = np.stack([x, y, np.full_like(x, 1.5)], axis=-1).reshape(-1, 3)
    found = surface_patches(PointCloud(plane))
    assert len(found.centres) > 20
    assert found.tilt.min() > 0
    assert found.tilt.max() < 1e-9


@pytest.mark.parametrize("scene", first_of(["square", "camber", "kerb"]))
@pytest.mark.full
def test_sparse_ground_leads_nowhere(scene: str) -> None:
    """Little stands near, and rings on the ground lie metres apart."""
    squares = []
    for seed in (1, 2, 5):
        pair = simulate_pair(scene, np.random.default_rng(seed), noise=FIELD)
        answer = calibrate(pair.target, pair.source, options=Options(sensors=pair.sensors))
        if answer.refined is None:
            continue
        squares.append(mahalanobis_sq(answer.refined, pair.T_target_source))
        off = se3.difference(answer.refined.T_target_source, pair.T_target_source)
        assert off.rotation < np.radians(0.25)
        assert off.translation < 0.08
    # Neither beyond what is stated, nor stated far too wide.
    assert len(squares) >= 2
    assert max(squares) < CHI2_6_95 * 1.5
    assert max(squares) > 0.3


def plane(rng: np.random.Generator, middle: Array, u: Array, v: Array, count: int) -> Array:
    """Points (N, 3) of a rectangle with 3 mm of noise."""
    a, b = rng.uniform(-1, 1, (2, count, 1))
    noise = 0.003 * rng.normal(size=(count, 1)) * np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    return np.asarray(middle + a * u + b * v + noise)


def place(rng: np.random.Generator, off: float) -> Array:
    """Ground, a front along x, and one small board across it, which may stand elsewhere."""
    x, y, z = np.eye(3)
    return np.concatenate(
        [
            plane(rng, -1.5 * z, 15 * x, 15 * y, 25_000),
            plane(rng, np.array([0.0, 12.0, 2.0]), 15 * x, 3.5 * z, 12_000),
            plane(rng, np.array([7.0 + off, 3.0, -0.5]), 0.7 * y, 0.7 * z, 1_500),
        ]
    )


def refined(off: float) -> Refinement:
    """Refine from poles that leave 0.1 m open along x, where the board is `off` in one cloud."""
    rng = np.random.default_rng(1)
    T = se3.from_rt(se3.exp_so3(np.array([0.02, -0.01, 0.5])), np.array([0.5, 0.2, 0.1]))
    target, source = place(rng, 0.0), se3.apply(se3.inverse(T), place(rng, off))
    sigma = np.r_[np.full(3, 0.002), 0.1, 0.02, 0.02]
    poles = PoseEstimate(T, np.diag(sigma**2), 0.01)
    found = refine(PointCloud(target), PointCloud(source), poles)
    assert found is not None
    return replace(found, from_poles=se3.difference(T, found.pose.T_target_source))


@pytest.mark.full
def test_a_place_that_alone_holds_a_direction_is_found() -> None:
    found = refined(0.0)
    assert found.decisive
    first = found.decisive[0]
    assert MAX_SHARE < first.share <= 1.0
    assert np.linalg.norm(first.at - [7.0, 3.0, -0.5]) < 1.5
    (reason, *_) = check_decisive(found)
    assert reason.code == "one_place_decides"
    assert reason.values["share"] == first.share


@pytest.mark.full
@pytest.mark.parametrize("off", first_of([0.03, -0.06]))
def test_what_is_stated_covers_a_place_that_moved(off: float) -> None:
    """The answer follows the board; the truth is within what is stated all the same."""
    found = refined(off)
    assert found.decisive
    assert found.pose.covariance is not None
    e = found.from_poles.translation
    sigma = np.sqrt(np.diag(found.pose.covariance)[3:])
    assert abs(off) / 3 < e < 3 * np.linalg.norm(sigma)
    # And no more than poles and board allow.
    assert np.linalg.norm(sigma) < 0.3


@pytest.mark.full
def test_shares_have_no_frame_and_no_unit() -> None:
    rng = np.random.default_rng(6)
    roots = rng.normal(size=(5, 6, 3))
    information = roots @ roots.transpose(0, 2, 1)
    marginal = information.sum(axis=0) + np.eye(6)
    one = leverage(places(marginal, information))
    A = rng.normal(size=(6, 6))
    other = leverage(places(A @ marginal @ A.T, A @ information @ A.T))
    np.testing.assert_allclose(one, other, rtol=1e-6)
    assert np.all((one > 0) & (one < 1))
    assert leverage(places(marginal, marginal[None])) == pytest.approx(1.0)


def places(marginal: Array, information: Array) -> Places:
    """Places that do not pull."""
    nothing = np.zeros(information.shape[:2])
    return Places(np.asarray(np.linalg.inv(marginal)), marginal, information, nothing, nothing)


def street(rng: np.random.Generator, car_at: float, count: int = 12_000) -> Array:
    """Ground, two high walls along x, two that face it, and a car's front and rear."""
    ground = np.c_[rng.uniform(-15, 15, (3 * count, 2)), rng.normal(-2, 0.004, 3 * count)]
    parts = [ground]
    for y in (-6.0, 6.0):
        wall = np.c_[rng.uniform(-15, 15, count), np.full(count, y), rng.uniform(-2, 3, count)]
        parts.append(wall)
    for x, y in ((-12.0, 5.0), (11.0, -5.0)):
        face = np.c_[np.full(400, x), y + rng.uniform(-1, 1, 400), rng.uniform(-2, 2, 400)]
        parts.append(face)
    ends = np.c_[
        car_at + 2.0 * rng.choice([-1.0, 1.0], 3000),
        rng.uniform(-1, 1, 3000),
        rng.uniform(-2, -0.5, 3000),
    ]
    cloud = np.concatenate([*parts, ends])
    return cloud + rng.normal(0, 0.004, cloud.shape)


@pytest.mark.full
@pytest.mark.parametrize("moved", first_of([0.2, -0.15, 0.0]))
def test_in_a_map_a_car_that_parked_elsewhere_does_not_draw_the_pose(moved: float) -> None:
    rng = np.random.default_rng(2)
    poles = PoseEstimate(np.eye(4), np.diag(REGISTRATION_SIGMA**2), 0.01)
    found = refine(
        PointCloud(street(rng, 4.0), is_map=True), PointCloud(street(rng, 4.0 + moved)), poles
    )
    assert found is not None
    assert found.pose.covariance is not None
    assert np.linalg.norm(found.pose.T_target_source[:3, 3]) < 0.02
    assert mahalanobis_sq(found.pose, np.eye(4)) < CHI2_6_95


@pytest.mark.full
def test_the_errors_of_a_map_add_to_those_of_the_pose() -> None:
    rng = np.random.default_rng(2)
    poles = PoseEstimate(np.eye(4), np.diag(REGISTRATION_SIGMA**2), 0.01)
    given, seen = PointCloud(street(rng, 4.0), is_map=True), PointCloud(street(rng, 4.0))
    exact, coarse = (refine(replace(given, map_sigma=own), seen, poles) for own in (0.0, 0.03))
    assert exact is not None
    assert coarse is not None
    np.testing.assert_array_equal(exact.pose.T_target_source, coarse.pose.T_target_source)
    assert exact.pose.covariance is not None
    assert coarse.pose.covariance is not None
    more = coarse.pose.covariance - exact.pose.covariance
    np.testing.assert_allclose(more, np.diag(np.repeat([1e-3, 0.03], 3) ** 2), atol=1e-12)


@pytest.mark.full
def test_an_object_that_moved_is_left_out_as_a_whole() -> None:
    rng = np.random.default_rng(2)
    given = PointCloud(street(rng, 4.0), is_map=True)
    patches = surface_patches(given), surface_patches(PointCloud(street(rng, 4.2)))
    sets = prepare_patches(
        *patches, Layout((np.unique(patches[0].bands), np.unique(patches[1].bands)))
    )
    objects = movable_objects(given, patches[1].centres)
    assert set(objects) == {0, 1, 2}
    kept = without_moved(by_objects(sets, objects), np.eye(4), np.diag(REGISTRATION_SIGMA**2))
    assert len(kept.source.centres) == np.count_nonzero(objects == 0)
    same = patches[0], surface_patches(PointCloud(street(rng, 4.0)))
    sets = prepare_patches(*same, Layout((np.unique(same[0].bands), np.unique(same[1].bands))))
    objects = movable_objects(given, same[1].centres)
    kept = without_moved(by_objects(sets, objects), np.eye(4), np.diag(REGISTRATION_SIGMA**2))
    assert len(kept.source.centres) == len(objects)
