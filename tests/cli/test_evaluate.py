"""``retropole evaluate`` as a user runs it: of a transform, and of methods."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole.checking.methods import ALL_METHODS, OURS, RIVALS, missing_extra
from retropole.io import read_cloud, write_pcd
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


def test_evaluate_prefers_the_truth(scene: Path, tmp_path: Path) -> None:
    truth = scene / "truth.json"
    wrong = np.array(json.loads(truth.read_text())["T_target_source"])
    wrong[0, 3] += 0.2
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    np.savetxt(tmp_path / "wrong.txt", wrong)
    scores = []
    for file in (truth, tmp_path / "wrong.txt"):
        done = retropole_here("evaluate", *clouds, "--transform", file, "--truth", truth, "--json")
        assert done.returncode == 0, done.stderr
        scores.append(json.loads(done.stdout))
    right, off = scores
    assert right["e_rt_m"] == pytest.approx(0.0, abs=1e-9)
    assert off["e_rt_m"] == pytest.approx(0.2)
    assert off["translation_error_m"] == pytest.approx(0.2)
    assert right["rqe_sum"] > off["rqe_sum"]
    assert right["plane_residual_m"] < off["plane_residual_m"]
    found = right["confirmation"]
    assert found["agreeing"] > 100
    assert found["contradicted"] == found["contradicting"] / (
        found["agreeing"] + found["contradicting"]
    )
    done = retropole_here("evaluate", *clouds, "--transform", truth)
    assert (
        f"{found['agreeing']:,} patches agree, {found['contradicting']} contradict" in done.stdout
    )


def test_files_of_the_result_the_other_way_round_are_reported(scene: Path, tmp_path: Path) -> None:
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    assert retropole_here("calibrate", *clouds, "--out", tmp_path, "-q").returncode == 0
    for result in (tmp_path, tmp_path / "result.json"):
        done = retropole_here("evaluate", *clouds[::-1], "--transform", result)
        assert done.returncode == 2
        assert "TARGET and SOURCE are swapped" in done.stderr
        assert "exchange them" in done.stderr
    assert retropole_here("evaluate", *clouds, "--transform", tmp_path).returncode == 0


def test_evaluate_refuses_a_transform_that_is_none(scene: Path, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "scaled.txt", np.diag([2.0, 2.0, 2.0, 1.0]))
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("evaluate", *clouds, "--transform", tmp_path / "scaled.txt")
    assert done.returncode == 2
    assert "scaled.txt" in done.stderr


def test_all_methods_in_one_table_next_to_the_truth(scene: Path, tmp_path: Path) -> None:
    done = retropole_here(
        *("evaluate", scene / "lidar0.pcd", scene / "lidar1.pcd"),
        *("--truth", scene / "truth.json", "--methods", ",".join(ALL_METHODS)),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    columns = ("overlap", "RQE", "agree", "conflict", "e_rt m", "time s", "yaw °")
    for word in ("poles+scene", "gicp", *columns):
        assert word in done.stdout
    assert all(len(line) <= 80 for line in done.stdout.splitlines())
    for method in RIVALS:
        words = f"{method}: not installed: pip install 'retropole[{missing_extra(method)}]'"
        assert (words in done.stderr) == (missing_extra(method) is not None)
    assert list(tmp_path.iterdir()) == [], "nothing is written"


def test_json_is_all_of_stdout_and_right(scene: Path) -> None:
    done = retropole_here(
        *("evaluate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--json"),
        *("--truth", scene / "truth.json", "--methods", "poles+scene,poles"),
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "retropole/compare/1"
    with_scene, poles = document["methods"]
    assert (with_scene["method"], poles["method"]) == ("poles+scene", "poles")
    truth = np.array(json.loads((scene / "truth.json").read_text())["T_target_source"])
    for each in (with_scene, poles):
        T = np.array(each["T_target_source"])
        off = float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))
        assert each["translation_error_m"] == pytest.approx(off)
        assert off < 0.1
        assert 0.5 < each["overlap"] <= 1
        assert each["confirmation"]["agreeing"] > 40
        assert each["confirmation"]["contradicted"] < 0.1
        assert each["rqe_log"] == pytest.approx(-np.log(each["rqe_sum"]))
        assert Rotation.from_euler("xyz", each["rpy_deg"], degrees=True).as_matrix() == (
            pytest.approx(T[:3, :3])
        )
    assert with_scene["e_rt_m"] < 0.1


def test_without_a_truth_there_are_no_errors(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("evaluate", *files, "--methods", "poles", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["methods"][0]["e_rt_m"] is None


def test_where_all_refuse_the_exit_code_is_3(scene: Path, tmp_path: Path) -> None:
    few = read_cloud(scene / "lidar0.pcd").select(np.arange(20))
    write_pcd(tmp_path / "few.pcd", few)
    done = retropole_here(
        *("evaluate", "few.pcd", scene / "lidar1.pcd", "--methods", "poles,icp"),
        cwd=tmp_path,
    )
    assert done.returncode == 3
    for code in ("too_few_poles", "too_few_points"):
        assert code in done.stdout
        assert code not in done.stderr


@pytest.mark.skipif(missing_extra("kiss") is None, reason="the extra kiss is installed")
def test_only_what_is_not_installed_is_bad_usage(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("evaluate", *files, "--methods", "kiss")
    assert done.returncode == 2
    assert "retropole[kiss]" in done.stderr


def test_a_truth_that_is_no_transform_is_named(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "T.txt").write_text("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("evaluate", *files, "--truth", "T.txt", "--methods", "icp", cwd=tmp_path)
    assert done.returncode == 2
    assert "T.txt" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("missing.pcd", "missing.pcd", "--methods", "icp"),
        ("a.pcd", "b.pcd"),
        ("a.pcd", "b.pcd", "--methods", "icp", "--transform", "T.txt"),
        ("a.pcd", "b.pcd", "--methods", "icp", "--parent", "a"),
        ("only-one.pcd", "--methods", "icp"),
        ("a.pcd", "b.pcd", "--methods", "nonsense"),
        ("a.pcd", "b.pcd", "--methods", "icp", "--truth", "missing.txt"),
    ],
)
def test_bad_usage_exits_with_2_and_one_reason(words: tuple[str, ...], tmp_path: Path) -> None:
    done = retropole_here("evaluate", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip()
    assert "Traceback" not in done.stderr


def test_help_has_worked_examples_and_every_method() -> None:
    done = retropole_here("evaluate", "--help")
    assert done.returncode == 0
    assert "--methods poles" in done.stdout.split("Examples:")[1]
    listed = done.stdout.split("scored the same")[1].split("way:")[1].split("Examples:")[0]
    for name, title in (OURS | {name: rival.title for name, rival in RIVALS.items()}).items():
        assert any(line.split() == [name, *title.split()] for line in _lines(listed)), name
    assert ", ".join(ALL_METHODS) in " ".join(done.stdout.split())
    for name, rival in RIVALS.items():
        needs = next(line for line in listed.splitlines() if line.split()[:1] == [name])
        assert ("extra" in needs) == (rival.extra is not None)


def _lines(listed: str) -> list[str]:
    """Lines of the list without the extras."""
    return [line.split("; needs")[0] for line in listed.splitlines()]


def test_the_list_of_methods_loads_none_of_them() -> None:
    code = "import sys, retropole.cli.evaluate; print([m for m in %r if m in sys.modules])"
    heavy = [
        "small_gicp",
        "scipy.optimize",
        "retropole.pipeline",
        "retropole.checking.comparison",
    ]
    done = subprocess.run(
        [sys.executable, "-c", code % heavy], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
