"""The command compare as a user runs it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole.evaluation.rivals import ALL_METHODS, OURS, RIVALS, missing_extra
from retropole.io import read_cloud, write_pcd
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    few = "--sensor-target", "VLP-16", "--sensor-source", "VLP-16"
    done = retropole_here("simulate", "corridor", "--seed", 4, *few, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_all_methods_in_one_table_beside_the_truth(scene: Path, tmp_path: Path) -> None:
    done = retropole_here(
        *("compare", scene / "lidar0.pcd", scene / "lidar1.pcd"),
        *("--truth", scene / "truth.json"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    columns = ("overlap", "RQE", "agree", "conflict", "e_rt m", "time s", "yaw °")
    for word in ("poles+scene", "planes", "gicp", *columns):
        assert word in done.stdout
    assert all(len(line) <= 80 for line in done.stdout.splitlines())
    for method in RIVALS:
        words = f"{method}: not installed: pip install 'retropole[{missing_extra(method)}]'"
        assert (words in done.stderr) == (missing_extra(method) is not None)
    assert list(tmp_path.iterdir()) == [], "nothing is written"


def test_json_is_all_of_stdout_and_right(scene: Path) -> None:
    done = retropole_here(
        *("compare", scene / "lidar0.pcd", scene / "lidar1.pcd", "--json"),
        *("--truth", scene / "truth.json", "--methods", "planes,poles"),
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "retropole/compare/1"
    planes, poles = document["methods"]
    assert (planes["method"], poles["method"]) == ("planes", "poles")
    truth = np.array(json.loads((scene / "truth.json").read_text())["T_target_source"])
    for each in (planes, poles):
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
    assert planes["e_rt_m"] < 0.1


def test_without_a_truth_there_are_no_errors(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("compare", *files, "--methods", "poles", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["methods"][0]["e_rt_m"] is None


def test_where_all_refuse_the_exit_code_is_3(scene: Path, tmp_path: Path) -> None:
    few = read_cloud(scene / "lidar0.pcd").select(np.arange(20))
    write_pcd(tmp_path / "few.pcd", few)
    done = retropole_here(
        *("compare", "few.pcd", scene / "lidar1.pcd", "--methods", "poles,planes,icp"),
        cwd=tmp_path,
    )
    assert done.returncode == 3
    for code in ("too_few_poles", "too_few_planes", "too_few_points"):
        assert code in done.stdout
        assert code not in done.stderr


@pytest.mark.skipif(missing_extra("kiss") is None, reason="the extra kiss is installed")
def test_only_what_is_not_installed_is_bad_usage(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("compare", *files, "--methods", "kiss")
    assert done.returncode == 2
    assert "retropole[kiss]" in done.stderr


def test_a_truth_that_is_no_transform_is_named(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "T.txt").write_text("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("compare", *files, "--truth", "T.txt", cwd=tmp_path)
    assert done.returncode == 2
    assert "T.txt" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("missing.pcd", "missing.pcd"),
        ("only-one.pcd",),
        ("a.pcd", "b.pcd", "--methods", "nonsense"),
        ("a.pcd", "b.pcd", "--truth", "missing.txt"),
    ],
)
def test_bad_usage_exits_with_2_and_one_reason(words: tuple[str, ...], tmp_path: Path) -> None:
    done = retropole_here("compare", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip()
    assert "Traceback" not in done.stderr


def test_help_has_worked_examples_and_every_method() -> None:
    done = retropole_here("compare", "--help")
    assert done.returncode == 0
    assert "retropole compare " in done.stdout.split("Examples:")[1]
    listed = done.stdout.split("Methods:")[1].split("Examples:")[0]
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
    code = "import sys, retropole.cli.compare; print([m for m in %r if m in sys.modules])"
    heavy = [
        "small_gicp",
        "scipy.optimize",
        "retropole.pipeline",
        "retropole.evaluation.comparison",
    ]
    done = subprocess.run(
        [sys.executable, "-c", code % heavy], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
