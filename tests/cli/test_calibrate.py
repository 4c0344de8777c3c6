"""``retropole calibrate`` as a user runs it: what it prints, writes and exits with."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.io import write_pcd
from retropole.simulation import place_again, simulate_pair
from retropole.simulation.writing import write_pair
from tests.cli.commands import retropole_here, transform_of


def assert_close(T: Array, T_true: Array, degrees: float = 1.0, metres: float = 0.15) -> None:
    assert np.degrees(se3.rotation_angle(T[:3, :3] @ T_true[:3, :3].T)) < degrees
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < metres


@pytest.mark.full
def test_two_files_in_one_extrinsic_out(scene: Path, truth: Array, tmp_path: Path) -> None:
    done = retropole_here(
        "calibrate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--out", tmp_path / "r"
    )
    assert done.returncode == 0, done.stderr
    for word in ("T_target_source", "predicted error", "pole", "verdict: "):
        assert word in done.stdout
    assert_close(transform_of(tmp_path / "r"), truth)
    assert (tmp_path / "r" / "report.html").stat().st_size > 1000
    assert sorted(p.name for p in (tmp_path / "r").iterdir()) == ["report.html", "result.json"]


@pytest.mark.full
def test_result_document_is_whole(scene: Path, tmp_path: Path) -> None:
    done = retropole_here(
        "calibrate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--out", tmp_path, "--json"
    )
    assert done.returncode == 0
    result = json.loads(done.stdout)
    assert result == json.loads((tmp_path / "result.json").read_text())
    assert result["schema"] == "retropole/result/1"
    assert [len(document["sha256"]) for document in result["inputs"]] == [64, 64]
    chosen = [h for h in result["hypotheses"] if h["chosen"]]
    assert len(chosen) == 1
    assert chosen[0]["score"] == max(h["score"] for h in result["hypotheses"] if h["exact"])
    assert set(result["seconds"]) >= {"read", "extract", "match", "disambiguate"}


@pytest.mark.parametrize("moved", ["target", "source"])
@pytest.mark.parametrize("origin", ["kept", "lost"])
@pytest.mark.full
def test_moving_a_cloud_moves_the_answer(
    clouds: tuple[PointCloud, PointCloud], truth: Array, tmp_path: Path, moved: str, origin: str
) -> None:
    T = se3.random(np.random.default_rng(5), 20.0)
    target, source = clouds
    expected = truth
    if moved == "target":
        target, expected = target.transformed(T), T @ truth
    else:
        source, expected = source.transformed(T), truth @ se3.inverse(T)
    if origin == "lost":
        target = PointCloud(target.xyz, target.intensity)
        source = PointCloud(source.xyz, source.intensity)
    write_pcd(tmp_path / "target.pcd", target)
    write_pcd(tmp_path / "source.pcd", source)
    done = retropole_here("calibrate", "target.pcd", "source.pcd", "--out", "r", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # Compare where both LiDARs are, not at an origin metres away that any rotation would move far.
    A, B = transform_of(tmp_path / "r"), expected
    assert np.degrees(se3.rotation_angle(A[:3, :3] @ B[:3, :3].T)) < 1.0
    here = np.median(source.xyz, axis=0)[None]
    assert np.linalg.norm(se3.apply(A, here) - se3.apply(B, here)) < 0.15


@pytest.mark.full
def test_swapping_the_clouds_inverts_the_answer(scene: Path, truth: Array, tmp_path: Path) -> None:
    done = retropole_here(
        "calibrate", scene / "lidar1.pcd", scene / "lidar0.pcd", "--out", tmp_path, "-q"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert_close(transform_of(tmp_path), se3.inverse(truth))


def test_a_refusal_exits_with_3_and_leaves_its_reason(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here(
        "calibrate", *files, "--threshold", "auto", "--threshold", 1e9, "--out", "r", cwd=tmp_path
    )
    assert done.returncode == 3
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["status"] == "refused"
    assert result["T_target_source"] is None
    assert result["reasons"][0]["code"] == "too_few_poles"
    assert "too_few_poles" in done.stderr
    assert (tmp_path / "r" / "report.html").exists()


@pytest.mark.full
def test_placements_give_one_answer(scene: Path, truth: Array, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    other = place_again(rp.simulate("street", 1), np.random.default_rng(3))
    again = tmp_path / "front.pcd", tmp_path / "rear.pcd"
    for path, cloud in zip(again, (other.target, other.source), strict=True):
        write_pcd(path, cloud)
    done = retropole_here(
        "calibrate", "--placement", *files, "--placement", *again, "--out", tmp_path / "r"
    )
    assert done.returncode == 0, done.stderr
    assert_close(transform_of(tmp_path / "r"), truth)
    assert "pose without each placement" in done.stdout
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert len(result["inputs"]) == 4
    assert len(result["placements"]) == 2


@pytest.mark.full
def test_a_prior_is_taken_and_a_wrong_one_refused(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("calibrate", *files, "--up", "--out", "up", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = retropole_here(
        *("calibrate", *files, "--prior-rpy-deg", 0, 0, 170, "--prior-sigma-deg", 5),
        *("--out", "wrong", "-q"),
        cwd=tmp_path,
    )
    assert done.returncode == 3
    assert "prior_contradicted" in done.stderr or "no_overlap" in done.stderr


def test_arguments_that_contradict_each_other(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    for words in (
        ("calibrate", files[0]),
        ("calibrate",),
        ("calibrate", *files, "--placement", *files),
        ("calibrate", *files, "--up", "--prior-rpy-deg", 0, 0, 0),
    ):
        done = retropole_here(*words)
        assert done.returncode == 2
        assert "Error" in done.stderr or "retropole:" in done.stderr


@pytest.mark.full
def test_two_topics_of_a_bag_give_what_their_files_give(
    scene: Path, bag: Path, tmp_path: Path
) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    topics = "--topic", "/front", "--topic", "/rear"
    assert retropole_here("calibrate", *files, "--out", tmp_path / "files", "-q").returncode == 0
    done = retropole_here("calibrate", bag, bag, *topics, "--out", tmp_path / "bag", "-q")
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(transform_of(tmp_path / "bag"), transform_of(tmp_path / "files"))
    result = json.loads((tmp_path / "bag" / "result.json").read_text())
    assert result["config"]["target_topic"] == "/front"
    assert len({document["sha256"] for document in result["inputs"]}) == 1
    clouds = bag, bag, *topics
    done = retropole_here("evaluate", *clouds, "--transform", tmp_path / "bag", "--json")
    assert json.loads(done.stdout)["overlap"] > 0.5
    done = retropole_here("evaluate", *clouds, "--methods", "poles", "--json")
    assert json.loads(done.stdout)["methods"][0]["status"] == "ok"
    # Topics are those of each placement.
    two = [word for _ in range(2) for word in ("--placement", bag, bag)]
    done = retropole_here(
        "calibrate", *two, *topics, "--no-refine", "--out", tmp_path / "two", "-q"
    )
    assert done.returncode == 3
    assert "TARGET of placement 1 and TARGET of placement 2 are both topic /front" in done.stderr


@pytest.mark.full
def test_poles_that_the_user_trusts_are_recorded(tmp_path: Path) -> None:
    done = retropole_here("simulate", "bare", "--seed", 3, "--out", tmp_path / "bare")
    assert done.returncode == 0, done.stderr
    files = tmp_path / "bare" / "lidar0.pcd", tmp_path / "bare" / "lidar1.pcd"
    codes, config = {}, {}
    for words in ((), ("--trust-poles",)):
        done = retropole_here("calibrate", *files, *words, "--out", tmp_path / "r", "--json")
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
        codes[words] = {reason["code"] for reason in result["reasons"]}
        config[words] = result["config"]["trust_poles"], result["confirmation"]["trusted"]
    assert codes[()] - codes["--trust-poles",] == {"not_confirmed"}
    assert list(config.values()) == [(False, False), (True, True)]


@pytest.mark.full
def test_ambiguous_is_no_dead_end(tmp_path: Path) -> None:
    pair = simulate_pair("harbor", np.random.default_rng(5), symmetric=True)
    write_pair(pair, tmp_path)
    files = tmp_path / "lidar0.pcd", tmp_path / "lidar1.pcd"
    done = retropole_here("calibrate", *files, "--out", tmp_path / "r")
    assert done.returncode == 3
    assert "source turned by 180° about the vertical" in done.stdout
    # Both stand upright: what is named is what decides.
    assert "--up" not in done.stdout
    assert "--hypothesis a | b" in done.stdout
    listed = json.loads((tmp_path / "r" / "result.json").read_text())["hypotheses"]
    (right,) = (
        letter
        for letter, each in zip("abcdefgh", listed, strict=False)
        if np.allclose(each["T_target_source"], pair.T_target_source, atol=0.1)
    )
    done = retropole_here("calibrate", *files, "--hypothesis", right, "--out", tmp_path / "r")
    assert done.returncode == 0, done.stderr
    assert "chosen_by_hand" in done.stdout
    np.testing.assert_allclose(transform_of(tmp_path / "r"), pair.T_target_source, atol=0.03)
    assert json.loads((tmp_path / "r" / "result.json").read_text())["config"]["hypothesis"] == right
    done = retropole_here("calibrate", *files, "--hypothesis", "z", "--out", tmp_path / "r")
    assert done.returncode == 2
    assert "those that fit are a, b, c, d" in done.stderr


def test_topics_that_cannot_be_distinguished(bag: Path, tmp_path: Path) -> None:
    done = retropole_here("calibrate", bag, bag, cwd=tmp_path)
    assert done.returncode == 2
    assert "/front (1 message), /rear (1 message)" in done.stderr
    same = "--topic", "/front"
    assert list(tmp_path.iterdir()) == []
    done = retropole_here("calibrate", bag, bag, *same, cwd=tmp_path)
    assert done.returncode == 3
    assert "same_recording: TARGET and SOURCE are both topic /front" in done.stdout + done.stderr
    assert "--topic" in done.stdout + done.stderr


@pytest.mark.full
def test_the_command_writes_what_python_saves(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    named = "--sensor", "Pandar64", "--sensor", "auto"
    words = "--radius", 0.021, "--poles", 2, "--no-refine", *named
    done = retropole_here("calibrate", *files, *words, "--out", tmp_path / "r", "--json")
    assert done.returncode == 0, done.stderr
    result = rp.calibrate(
        *files,
        radius=0.021,
        poles=2,
        sensor=("Pandar64", "auto"),
        options=rp.RunConfig(refine=False),
    )
    result.save(tmp_path / "python")
    theirs, ours = (
        json.loads((tmp_path / name / "result.json").read_text()) for name in ("r", "python")
    )
    for document in (theirs, ours):
        # Only the clock differs.
        del document["created"], document["seconds"]
    assert theirs == ours
    assert json.loads(done.stdout)["inputs"] == ours["inputs"]


@pytest.mark.full
def test_a_need_is_answered_and_the_next_commands_can_be_typed(scene: Path, tmp_path: Path) -> None:
    files, out = (scene / "lidar0.pcd", scene / "lidar1.pcd"), tmp_path / "it's here"
    done = retropole_here("calibrate", *files, "--need-cm", 5, "--strict", "--out", out)
    assert done.returncode == 0, done.stdout
    assert "within 5 cm at 30 m: yes, 9" in done.stdout
    result = json.loads((out / "result.json").read_text())
    assert (result["config"]["need_m"], result["config"]["at_m"]) == (0.05, None)
    assert (result["fitness"]["within_m"], result["fitness"]["at_m"]) == (0.05, 30.0)
    assert result["fitness"]["answer"] == "yes"
    commands = [line.split(": ", 1)[1] for line in done.stdout.splitlines()[-2:]]
    for command, word in zip(commands, ("export", "check"), strict=True):
        name, *words = shlex.split(command)
        assert (name, words[0]) == ("retropole", word)
        given = dict(zip(("TARGET", "SOURCE"), files, strict=True))
        assert retropole_here(*(given.get(each, each) for each in words)).returncode == 0


@pytest.mark.full
def test_a_need_that_is_not_met_warns_also_when_quiet(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    asked = "calibrate", *files, "--need-cm", 0.6, "--at-m", 60, "--out", tmp_path
    done = retropole_here(*asked)
    assert done.returncode == 0
    assert "verdict: warn" in done.stdout
    assert "not_fit_for_purpose: within 0.6 cm at 60 m: " in done.stdout
    assert done.stderr == ""
    for quietly in ("-q", "--json"):
        process = retropole_here(*asked, quietly, "--strict")
        assert process.returncode == 1
        assert process.stderr.startswith("retropole: warning (not_fit_for_purpose): within 0.6 cm")
        assert (process.stdout == "") == (quietly == "-q")


@pytest.mark.full
def test_a_refusal_says_what_to_do_and_where_to_read_on(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    asked = "calibrate", *files, "--poles", 7, "--strict", "--out", tmp_path
    for words in (asked, (*asked, "-q")):
        done = retropole_here(*words)
        assert done.returncode == 3
        said = done.stdout + done.stderr
        assert "what to do: " in said
        assert "read on: docs/reasons.md#too_few_poles" in said
        assert "next: " not in said


@pytest.mark.full
def test_without_poles_the_place_gives_the_pose(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("calibrate", *files, "--poles", 0, "-q", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["stages"]["poles"] is None
    assert result["radius"] is None
    assert [reason["code"] for reason in result["reasons"]] == ["without_poles"]
    assert "Without poles, the ground of one" in (tmp_path / "report.html").read_text()
    done = retropole_here("calibrate", *files, "--poles", 0, "--no-refine")
    assert done.returncode == 2
    assert "the scene must determine the pose" in done.stderr


def test_a_distance_without_a_need_is_no_question(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    for words in (("--at-m", 30), ("--need-cm", 0), ("--need-cm", "nan")):
        assert retropole_here("calibrate", *files, *words).returncode == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("calibrate", "a", "b", "--carried", "--plan", "p"), "--plan is for fixed poles"),
        (("calibrate", "a", "b", "--carried", "--up"), "up cannot be used with"),
        (("simulate", "street", "--carried", "--poles", "3"), "without --poles"),
        (("simulate", "street", "--lidars", "3"), "--lidars needs --carried"),
        (("simulate", "street", "--sweeps", "300"), "200 at most without --carried"),
        (("simulate", "paper", "--carried"), "no walk in 'paper'"),
    ],
)
def test_a_carried_pole_goes_with_nothing_of_standing_ones(
    words: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    done = retropole_here(*words, "--out", tmp_path / "r")
    assert done.returncode == 2
    assert said in done.stderr


@pytest.mark.full
def test_a_simulated_walk_is_calibrated_as_the_help_says(tmp_path: Path) -> None:
    made = retropole_here(
        "simulate", "street", "--carried", "--sweeps", "100", "--seed", "2", "--out", tmp_path / "w"
    )
    assert made.returncode == 0, made.stderr
    done = retropole_here(
        "calibrate",
        tmp_path / "w" / "lidar0",
        tmp_path / "w" / "lidar1",
        "--carried",
        "--out",
        tmp_path / "r",
    )
    assert done.returncode == 0, done.stderr
    assert "clocks: t_target = t_source" in done.stdout
    truth = json.loads((tmp_path / "w" / "truth.json").read_text())
    assert_close(transform_of(tmp_path / "r"), np.array(truth["T_target_source"]))
    walk = json.loads((tmp_path / "r" / "result.json").read_text())["walk"]
    assert abs(walk["clock_offset_s"] - truth["clock_offset_s"]) < 5 * walk["clock_sigma_s"]
