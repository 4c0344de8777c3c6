"""The commands as a user runs them: what they print, write and exit with."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, PointCloud
from retropole.io import read_cloud, write_pcd
from retropole.result import decode


def retropole(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "retropole", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=120)


def transform_of(folder: Path) -> Array:
    result = decode((folder / "result.json").read_bytes())
    assert result.T_target_source is not None
    return np.array(result.T_target_source)


def assert_close(T: Array, T_true: Array, degrees: float = 1.0, metres: float = 0.15) -> None:
    assert np.degrees(se3.rotation_angle(T[:3, :3] @ T_true[:3, :3].T)) < degrees
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < metres


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    done = retropole("simulate", "street", "--seed", 1, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def truth(scene: Path) -> Array:
    return np.array(json.loads((scene / "truth.json").read_text())["T_target_source"])


@pytest.fixture(scope="module")
def clouds(scene: Path) -> tuple[PointCloud, PointCloud]:
    return read_cloud(scene / "lidar0.pcd"), read_cloud(scene / "lidar1.pcd")


def test_two_files_in_one_extrinsic_out(scene: Path, truth: Array, tmp_path: Path) -> None:
    done = retropole(
        "calibrate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--out", tmp_path / "r"
    )
    assert done.returncode == 0, done.stderr
    for word in ("T_target_source", "hypothesis", "margin", "pole", "verdict: "):
        assert word in done.stdout
    assert_close(transform_of(tmp_path / "r"), truth)
    assert (tmp_path / "r" / "report.html").stat().st_size > 1000
    assert sorted(p.name for p in (tmp_path / "r").iterdir()) == ["report.html", "result.json"]


def test_result_document_is_whole(scene: Path, tmp_path: Path) -> None:
    done = retropole(
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
    done = retropole("calibrate", "target.pcd", "source.pcd", "--out", "r", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # Compare where both LiDARs are, not at an origin metres away that any turn would throw about.
    A, B = transform_of(tmp_path / "r"), expected
    assert np.degrees(se3.rotation_angle(A[:3, :3] @ B[:3, :3].T)) < 1.0
    here = np.median(source.xyz, axis=0)[None]
    assert np.linalg.norm(se3.apply(A, here) - se3.apply(B, here)) < 0.15


def test_swapping_the_clouds_inverts_the_answer(scene: Path, truth: Array, tmp_path: Path) -> None:
    done = retropole(
        "calibrate", scene / "lidar1.pcd", scene / "lidar0.pcd", "--out", tmp_path, "-q"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert_close(transform_of(tmp_path), se3.inverse(truth))


def test_a_refusal_exits_with_3_and_leaves_its_reason(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole("calibrate", *files, "--threshold-source", 1e9, "--out", "r", cwd=tmp_path)
    assert done.returncode == 3
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["status"] == "refused"
    assert result["T_target_source"] is None
    assert result["reasons"][0]["code"] == "too_few_poles"
    assert "too_few_poles" in done.stderr
    assert (tmp_path / "r" / "report.html").exists()


def test_no_intensity_never_gives_a_transform(
    clouds: tuple[PointCloud, PointCloud], tmp_path: Path
) -> None:
    write_pcd(tmp_path / "a.pcd", PointCloud(clouds[0].xyz))
    write_pcd(tmp_path / "b.pcd", clouds[1])
    done = retropole("calibrate", "a.pcd", "b.pcd", cwd=tmp_path)
    assert done.returncode == 3
    assert "no_intensity" in done.stderr
    assert retropole("detect", "a.pcd", cwd=tmp_path).returncode == 3


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "missing.pcd", "missing.pcd"),
        ("calibrate", "only-one.pcd"),
        ("calibrate", "a.pcd", "b.pcd", "--radius", "-1"),
        ("calibrate", "a.pcd", "b.pcd", "--poles", "1"),
        ("calibrate", "a.pcd", "b.pcd", "--sensor-target", "nonsense"),
        ("detect", "missing.pcd"),
        ("info", "missing.bag"),
        ("info", "missing.pcd", "--frames", "1:x"),
        ("detect", "missing.pcd", "--frames", "::0"),
        ("nonsense",),
    ],
)
def test_bad_usage_exits_with_2_and_one_reason(words: tuple[str, ...], tmp_path: Path) -> None:
    done = retropole(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip()
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == [], "nothing is written"


def test_detect_prints_a_table_and_draws(scene: Path, tmp_path: Path) -> None:
    done = retropole("detect", scene / "lidar0.pcd", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 poles" in done.stdout
    assert (tmp_path / "detect.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    as_json = retropole("detect", scene / "lidar0.pcd", "--out", tmp_path, "--json")
    assert len(json.loads(as_json.stdout)["poles"]) == 2


@pytest.mark.parametrize("command", ["calibrate", "detect", "info", "simulate"])
def test_help_has_worked_examples(command: str) -> None:
    done = retropole(command, "--help")
    assert done.returncode == 0
    assert f"retropole {command} " in done.stdout.split("Examples:")[1]


def test_placements_give_one_answer(scene: Path, truth: Array, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole(
        "calibrate", "--placement", *files, "--placement", *files, "--out", tmp_path / "r"
    )
    assert done.returncode == 0, done.stderr
    assert_close(transform_of(tmp_path / "r"), truth)
    assert "without it" in done.stdout
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert len(result["inputs"]) == 4
    assert len(result["placements"]) == 2


def test_a_prior_is_taken_and_a_wrong_one_refused(scene: Path, tmp_path: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole("calibrate", *files, "--up", "--out", "up", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = retropole(
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
        done = retropole(*words)
        assert done.returncode == 2
        assert "Error" in done.stderr or "retropole:" in done.stderr


def test_evaluate_prefers_the_truth(scene: Path, tmp_path: Path) -> None:
    truth = scene / "truth.json"
    wrong = np.array(json.loads(truth.read_text())["T_target_source"])
    wrong[0, 3] += 0.2
    np.savetxt(tmp_path / "wrong.txt", wrong)
    scores = []
    for file in (truth, tmp_path / "wrong.txt"):
        clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
        done = retropole("evaluate", *clouds, "--transform", file, "--truth", truth, "--json")
        assert done.returncode == 0, done.stderr
        scores.append(json.loads(done.stdout))
    right, off = scores
    assert right["e_rt_m"] == pytest.approx(0.0, abs=1e-9)
    assert off["e_rt_m"] == pytest.approx(0.2)
    assert off["translation_error_m"] == pytest.approx(0.2)
    assert right["rqe_sum"] > off["rqe_sum"]
    assert right["plane_residual_m"] < off["plane_residual_m"]


def test_evaluate_refuses_a_transform_that_is_none(scene: Path, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "scaled.txt", np.diag([2.0, 2.0, 2.0, 1.0]))
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole("evaluate", *clouds, "--transform", tmp_path / "scaled.txt")
    assert done.returncode == 2
    assert "scaled.txt" in done.stderr


@pytest.fixture(scope="module")
def bag(clouds: tuple[PointCloud, PointCloud], tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")
    from tests.bags import points_of, write_bag

    points = [points_of(cloud) for cloud in clouds]
    folder = tmp_path_factory.mktemp("bag")
    return write_bag(folder, "mcap", {"/front": points[:1], "/rear": points[1:]})


def test_two_topics_of_a_bag_give_what_their_files_give(
    scene: Path, bag: Path, tmp_path: Path
) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    topics = "--target-topic", "/front", "--source-topic", "/rear"
    assert retropole("calibrate", *files, "--out", tmp_path / "files", "-q").returncode == 0
    done = retropole("calibrate", bag, bag, *topics, "--out", tmp_path / "bag", "-q")
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(transform_of(tmp_path / "bag"), transform_of(tmp_path / "files"))
    result = json.loads((tmp_path / "bag" / "result.json").read_text())
    assert result["config"]["target_topic"] == "/front"
    assert len({document["sha256"] for document in result["inputs"]}) == 1
    clouds = bag, bag, *topics
    done = retropole("evaluate", *clouds, "--transform", tmp_path / "bag", "--json")
    assert json.loads(done.stdout)["overlap"] > 0.5
    done = retropole("compare", *clouds, "--methods", "poles", "--json")
    assert json.loads(done.stdout)["methods"][0]["status"] == "ok"
    # Topics are those of each placement.
    two = [word for _ in range(2) for word in ("--placement", bag, bag)]
    done = retropole("calibrate", *two, *topics, "--no-refine", "--out", tmp_path / "two", "-q")
    assert done.returncode == 0, done.stderr


def test_topics_that_cannot_be_told_apart(bag: Path, tmp_path: Path) -> None:
    done = retropole("calibrate", bag, bag, cwd=tmp_path)
    assert done.returncode == 2
    assert "/front (1 messages), /rear (1 messages)" in done.stderr
    same = "--target-topic", "/front", "--source-topic", "/front"
    done = retropole("calibrate", bag, bag, *same, cwd=tmp_path)
    assert done.returncode == 2
    assert "are both topic /front" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_detect_and_info_take_a_topic(bag: Path, tmp_path: Path) -> None:
    done = retropole("detect", bag, "--topic", "/front", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 poles" in done.stdout
    done = retropole("info", bag)
    assert done.returncode == 0, done.stderr
    assert "/front" in done.stdout
    assert "/rear" in done.stdout
    document = json.loads(retropole("info", bag, "--topic", "/rear", "--json").stdout)
    assert document["schema"] == "retropole/info/1"
    assert [cloud["topic"] for cloud in document["clouds"]] == ["/rear"]


def test_what_is_left_out_of_a_long_recording_is_said(
    clouds: tuple[PointCloud, PointCloud], tmp_path: Path
) -> None:
    for k in range(24):
        write_pcd(tmp_path / "many" / f"{k}.pcd", clouds[0])
    done = retropole("detect", "many", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    read = -(-24 // -(-24 * len(clouds[0]) // 1_000_000))
    assert read < 24, "the clouds are large enough for frames to be left out"
    assert f"read {read} of 24 frames" in done.stderr
    assert json.loads(done.stdout)["input"]["points"] == read * len(clouds[0])
    done = retropole("detect", "many", "--json", "--frames", "3:5", cwd=tmp_path)
    assert json.loads(done.stdout)["input"]["points"] == 2 * len(clouds[0])
    assert "frames" not in done.stderr
