"""Same, moved, or cannot tell: laws of the test, and what becomes of a site recorded anew."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, PointCloud, PoseEstimate
from retropole.errors import UsageError
from retropole.export.transform import Transform, inverted
from retropole.monitoring.drift import (
    FALSE_ALARM,
    MIN_POWER,
    TOLERANCE_ROTATION,
    TOLERANCE_TRANSLATION,
    CheckResult,
    check,
    compare,
    detection_power,
)
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, record_again, simulate_pair, write_pair

TOLERANCE = TOLERANCE_ROTATION, TOLERANCE_TRANSLATION
SMALL_TURN = np.r_[0.0, 0, np.radians(0.3), 0, 0, 0]
SMALL_SHIFT = np.r_[0.0, 0, 0, 0.03, 0, 0]


def covariance(rng: np.random.Generator, turn: float = 3e-4, shift: float = 2e-3) -> Array:
    """Draw a covariance of about these sigmas, with correlations."""
    A = rng.normal(size=(6, 6)) * np.repeat([turn, shift], 3)[:, None] / np.sqrt(6)
    return np.asarray(A @ A.T + np.diag(np.repeat([turn, shift], 3) ** 2) / 10)


def drawn(T: Array, spread: Array, rng: np.random.Generator) -> PoseEstimate:
    return PoseEstimate(se3.retract(T, rng.multivariate_normal(np.zeros(6), spread)), spread, 0.0)


# The test


def test_equal_poses_are_the_same() -> None:
    rng = np.random.default_rng(0)
    T, spread = se3.random(rng), covariance(rng)
    answer = compare(PoseEstimate(T, spread, 0.0), PoseEstimate(T, spread, 0.0), "poles")
    assert answer.status == "same"
    assert answer.chi2 == pytest.approx(0.0, abs=1e-12)
    assert answer.p_value == pytest.approx(1.0)
    np.testing.assert_allclose(answer.covariance, 2 * spread)


def test_stored_and_new_may_change_places() -> None:
    rng = np.random.default_rng(1)
    T = se3.random(rng)
    one, other = drawn(T, covariance(rng), rng), drawn(T, covariance(rng), rng)
    forth, back = compare(one, other, "poles"), compare(other, one, "poles")
    assert forth.chi2 is not None
    assert forth.chi2 == pytest.approx(back.chi2)
    assert forth.power == pytest.approx(back.power)
    assert forth.status == back.status


def test_a_turn_of_the_targets_frame_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    T, C, D = se3.random(rng), covariance(rng), covariance(rng)
    one, other = drawn(T, C, rng), drawn(T, D, rng)
    A = se3.random(rng)
    turn = np.kron(np.eye(2), A[:3, :3])
    plain = compare(one, other, "scene")
    moved = compare(
        PoseEstimate(A @ one.T_target_source, turn @ C @ turn.T, 0.0),
        PoseEstimate(A @ other.T_target_source, turn @ D @ turn.T, 0.0),
        "scene",
    )
    assert moved.chi2 == pytest.approx(plain.chi2)
    assert moved.power == pytest.approx(plain.power)
    np.testing.assert_allclose(moved.turned, plain.turned)
    np.testing.assert_allclose(moved.shifted, plain.shifted)


def test_exchanging_the_lidars_changes_nothing_to_first_order() -> None:
    rng = np.random.default_rng(3)
    T = se3.random(rng, 2.0)
    C, D = covariance(rng), covariance(rng)
    one, other = drawn(T, C, rng), drawn(T, D, rng)

    def turned_round(stage: PoseEstimate) -> PoseEstimate:
        back = inverted(Transform(stage.T_target_source, "a", "b", stage.covariance))
        return PoseEstimate(back.T_parent_child, back.covariance, 0.0)

    forth = compare(one, other, "poles")
    back = compare(turned_round(one), turned_round(other), "poles")
    assert forth.chi2 is not None
    assert back.chi2 == pytest.approx(forth.chi2, rel=0.02)


def test_the_false_alarm_rate_is_as_stated() -> None:
    rng = np.random.default_rng(4)
    T, C, D = se3.random(rng), covariance(rng), covariance(rng)
    runs = 2000
    # Of a tolerance of nothing, no movement is below it.
    alarms = sum(
        compare(drawn(T, C, rng), drawn(T, D, rng), "poles", (1e-9, 1e-9)).status == "moved"
        for _ in range(runs)
    )
    assert alarms / runs == pytest.approx(FALSE_ALARM, abs=4 * np.sqrt(FALSE_ALARM / runs))


@pytest.mark.parametrize("part", [0, 1])
def test_the_power_is_what_sampling_gives_in_the_worst_direction(part: int) -> None:
    rng = np.random.default_rng(5 + part)
    # One part sure, the other just not sure enough.
    spread = covariance(rng, *((1.0e-3, 1e-4) if part == 0 else (1e-5, 6e-3)))
    own = slice(3 * part, 3 * part + 3)
    values, vectors = np.linalg.eigh(spread[own, own])
    # Of all movements with this part, the one that the covariance most likes.
    worst = spread[:, own] @ vectors[:, -1] / values[-1] * TOLERANCE[part]
    assert np.linalg.norm(worst[own]) == pytest.approx(TOLERANCE[part])
    power = detection_power(spread, TOLERANCE)
    assert 0.1 < power < 0.98
    runs = 20_000
    seen = rng.multivariate_normal(worst, spread, runs)
    chi2 = np.einsum("ni,ij,nj->n", seen, np.linalg.inv(spread), seen)
    limit = 16.811893829770927
    assert np.mean(chi2 > limit) == pytest.approx(power, abs=4 * np.sqrt(0.25 / runs))
    for _ in range(20):
        any_other = rng.normal(size=6) * np.repeat([1e-2, 1e-1], 3)
        any_other *= TOLERANCE[part] / np.linalg.norm(any_other[own])
        least = worst @ np.linalg.solve(spread, worst)
        assert any_other @ np.linalg.solve(spread, any_other) >= least * (1 - 1e-9)


def test_the_power_has_its_limits() -> None:
    assert detection_power(1e-12 * np.eye(6), TOLERANCE) == pytest.approx(1.0)
    assert detection_power(1e6 * np.eye(6), TOLERANCE) == pytest.approx(FALSE_ALARM, rel=1e-3)
    powers = [detection_power(s * np.diag([1e-6] * 3 + [1e-4] * 3), TOLERANCE) for s in (1, 2, 4)]
    assert powers == sorted(powers, reverse=True)


def test_a_test_that_could_not_see_a_movement_does_not_say_same() -> None:
    rng = np.random.default_rng(7)
    T = se3.random(rng)
    sure, unsure = (
        PoseEstimate(T, covariance(rng), 0.0),
        PoseEstimate(T, covariance(rng, 0.01, 0.05), 0.0),
    )
    for stored, new, blamed in ((sure, unsure, "new"), (unsure, sure, "stored")):
        answer = compare(stored, new, "poles")
        assert answer.status == "cannot_tell"
        assert answer.power is not None
        assert answer.power < MIN_POWER
        assert [r.code for r in answer.reasons] == ["too_weak"]
        assert f"the {blamed} " in answer.reasons[0].message
    # A wider tolerance asks for less; a movement that sticks out is one all the same.
    assert compare(sure, unsure, "poles", (0.3, 1.0)).status == "same"
    far = PoseEstimate(se3.retract(T, np.r_[0, 0, 0, 1.0, 0, 0]), unsure.covariance, 0.0)
    answer = compare(sure, far, "poles")
    assert answer.status == "moved"
    assert [r.code for r in answer.reasons] == ["size_unsure"]


def test_a_movement_below_the_tolerance_is_told_as_such() -> None:
    rng = np.random.default_rng(8)
    T, spread = se3.random(rng), covariance(rng, 1e-6, 1e-5)
    near = PoseEstimate(se3.retract(T, np.r_[0, 0, 1e-4, 0.001, 0, 0]), spread, 0.0)
    answer = compare(PoseEstimate(T, spread, 0.0), near, "poles")
    assert answer.status == "same"
    assert [r.code for r in answer.reasons] == ["within_tolerance"]
    assert answer.p_value is not None
    assert answer.p_value < FALSE_ALARM
    assert compare(PoseEstimate(T, spread, 0.0), near, "poles", (1e-5, 1e-3)).status == "moved"


# Sites recorded anew


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.fixture(scope="module")
def stored(street: SimulatedPair) -> PoseEstimate:
    answer = calibrate(street.target, street.source)
    assert answer.refined is not None
    return answer.refined


@pytest.mark.parametrize(
    ("moved", "status", "poles"),
    [
        (np.zeros(6), "same", True),
        (np.zeros(6), "same", False),
        (SMALL_TURN, "moved", True),
        (SMALL_SHIFT, "moved", False),
    ],
)
def test_small_movements_are_found(
    street: SimulatedPair, stored: PoseEstimate, moved: Array, status: str, poles: bool
) -> None:
    again = record_again(street, np.random.default_rng(11), moved=moved, poles=poles)
    answer = check(stored, again.target, again.source)
    assert answer.status == status
    assert answer.used == ("poles" if poles else "scene")
    assert answer.step is not None
    assert answer.covariance is not None
    off = answer.step - moved
    assert off @ np.linalg.solve(answer.covariance, off) < 25.0


def test_the_recording_itself_is_the_same(street: SimulatedPair, stored: PoseEstimate) -> None:
    answer = check(stored, street.target, street.source)
    assert answer.status == "same"
    assert answer.used == "poles"
    np.testing.assert_allclose(answer.step, 0.0, atol=1e-9)


def test_clouds_without_intensity_are_checked_by_the_scene(
    street: SimulatedPair, stored: PoseEstimate
) -> None:
    again = record_again(street, np.random.default_rng(12))
    bare = [PointCloud(cloud.xyz) for cloud in (again.target, again.source)]
    answer = check(stored, *bare)
    assert (answer.status, answer.used) == ("same", "scene")
    assert "poles_no_intensity" in [reason.code for reason in answer.reasons]


def test_gross_movements_are_found_with_poles_and_never_called_same_without(
    street: SimulatedPair, stored: PoseEstimate
) -> None:
    rng = np.random.default_rng(13)
    turned = np.r_[np.radians(40.0) * street.T_world_target[2, :3], 0, 0, 0]
    there = record_again(street, rng, moved=turned)
    answer = check(stored, there.target, there.source)
    assert answer.status == "moved"
    assert answer.turned is not None
    assert np.degrees(answer.turned[0]) == pytest.approx(40.0, abs=0.1)
    gone = record_again(street, rng, moved=turned, poles=False)
    assert check(stored, gone.target, gone.source).status != "same"
    assert check(stored, gone.source, gone.target).status != "same"


def test_another_place_is_never_called_same(stored: PoseEstimate) -> None:
    other = simulate_pair("harbor", np.random.default_rng(14))
    assert check(stored, other.target, other.source).status != "same"
    bare = record_again(other, np.random.default_rng(15), poles=False)
    assert check(stored, bare.target, bare.source).status != "same"


@pytest.mark.parametrize("left", [0, 10])
def test_hardly_any_points_cannot_tell(
    street: SimulatedPair, stored: PoseEstimate, left: int
) -> None:
    answer = check(stored, street.target, street.source.select(np.arange(left)))
    assert answer.status == "cannot_tell"
    assert answer.step is None
    assert answer.turned is None
    assert answer.reasons


def test_a_pose_without_covariance_is_refused(street: SimulatedPair, stored: PoseEstimate) -> None:
    with pytest.raises(UsageError):
        check(replace(stored, covariance=None), street.target, street.source)


def test_recording_again_moves_the_source_alone(street: SimulatedPair) -> None:
    again = record_again(street, np.random.default_rng(16), moved=SMALL_SHIFT, poles=False)
    step = se3.local(street.T_target_source, again.T_target_source)
    np.testing.assert_allclose(step, SMALL_SHIFT, atol=1e-12)
    np.testing.assert_array_equal(again.T_world_target, street.T_world_target)
    assert again.poles == ()
    assert len(again.surfaces) == len(street.surfaces) - len(street.poles)


# The command


def retropole(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "retropole", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=120)


@pytest.fixture(scope="module")
def site(street: SimulatedPair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    rng = np.random.default_rng(17)
    write_pair(street, folder / "first")
    write_pair(record_again(street, rng, poles=False), folder / "same")
    write_pair(record_again(street, rng, moved=SMALL_TURN, poles=False), folder / "moved")
    done = retropole(
        "calibrate", "first/lidar0.pcd", "first/lidar1.pcd", "--out", "r", "-q", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return folder


def run(site: Path, result: str, recording: str, *words: str) -> tuple[int, str]:
    files = f"{recording}/lidar0.pcd", f"{recording}/lidar1.pcd"
    done = retropole("check", result, *files, *words, cwd=site)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout


def test_exit_codes_and_words(site: Path) -> None:
    code, text = run(site, "r", "same")
    assert code == 0, text
    assert text.startswith("verdict: same\n")
    code, text = run(site, "r/result.json", "moved")
    assert code == 4, text
    assert "about the target's +z (yaw)" in text
    assert "found by the scene alone" in text
    assert run(site, "r", "missing") == (2, "")
    assert run(site, "missing", "same") == (2, "")
    assert run(site, "r", "same", "--sigma-deg", "1")[0] == 2
    assert run(site, "r", "same", "-q") == (0, "")


@pytest.mark.parametrize(("recording", "status"), [("same", "same"), ("moved", "moved")])
def test_json_is_one_line(site: Path, recording: str, status: str) -> None:
    _, text = run(site, "r", recording, "--json")
    assert text.count("\n") == 1
    answer = json.loads(text)
    assert answer["status"] == status
    assert answer["used"] == "scene"
    assert 0 <= answer["p_value"] <= 1
    assert answer["sigma_deg"] > 0
    assert answer["sigma_m"] > 0
    assert answer["moved_deg"] == pytest.approx(0.3 if status == "moved" else 0.0, abs=0.05)


def test_a_transform_without_covariance_needs_its_sigmas(site: Path) -> None:
    words = ("--parent", "front", "--child", "rear", "--out", "r.urdf")
    assert retropole("export", "r", "--to", "urdf", *words, cwd=site).returncode == 0
    code, text = run(site, "r.urdf", "same", "--json")
    assert code == 3
    answer = json.loads(text)
    assert answer["status"] == "cannot_tell"
    assert answer["moved_deg"] is None
    assert [reason["code"] for reason in answer["reasons"]] == ["stored_no_covariance"]
    assert run(site, "r.urdf", "same", "--sigma-deg", "0.01", "--sigma-m", "0.002", "-q")[0] == 0
    assert run(site, "r.urdf", "same", "--sigma-deg", "1", "--sigma-m", "0.1", "-q")[0] == 3


def test_an_inverted_export_is_turned_back(site: Path) -> None:
    words = ("--to", "json", "--invert", "--out", "inverted.json")
    assert retropole("export", "r", *words, cwd=site).returncode == 0
    assert run(site, "inverted.json", "same", "-q")[0] == 0


def test_a_refused_result_cannot_tell(site: Path) -> None:
    files = "same/lidar0.pcd", "same/lidar1.pcd"
    assert retropole("calibrate", *files, "--out", "refused", "-q", cwd=site).returncode == 3
    code, text = run(site, "refused", "same", "--json")
    assert code == 3
    assert json.loads(text)["reasons"][0]["code"].startswith("stored_")


def test_the_stored_run_says_what_it_was_told_and_warned_of(site: Path) -> None:
    result = json.loads((site / "r" / "result.json").read_text())
    # A topic is of bags: it is left alone where the new recordings are files.
    result["config"]["target_topic"] = "/front"
    result["reasons"] = [{"code": "small_margin", "message": "leads by 0.05", "values": {}}]
    (site / "told.json").write_text(json.dumps(result))
    code, text = run(site, "told.json", "same")
    assert code == 0, text
    assert "stored_small_margin: leads by 0.05" in text
    result["config"]["sensor_source"] = "nonsense"
    (site / "wrong.json").write_text(json.dumps(result))
    assert run(site, "wrong.json", "same") == (2, "")
    assert run(site, "r", "same", "--target-topic", "/front") == (2, "")


def test_help_has_worked_examples(site: Path) -> None:
    done = retropole("check", "--help", cwd=site)
    assert done.returncode == 0
    assert "retropole check " in done.stdout.split("Examples:")[1]


def test_properties_of_an_answer_without_pose() -> None:
    nothing = CheckResult("cannot_tell", ())
    assert nothing.turned is None
    assert nothing.shifted is None
